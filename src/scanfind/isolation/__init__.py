"""The raw points of each detection, and how far they are from its model."""
