"""Poses fitted: to surfels, then to raw points, and how uncertain they then are."""
