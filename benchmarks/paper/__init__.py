"""The paper's Tables 5 to 12 (Sharif, Nahangi, Haas & West 2017), on scenes anybody can make again from a seed."""
