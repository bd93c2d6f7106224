"""The scene as a surfel grid: moments of points, what each scanner saw, surfels at every level."""
