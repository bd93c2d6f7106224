"""How often a pose of some score is right: candidates of simulated scenes, the curve they make, and how it holds."""
