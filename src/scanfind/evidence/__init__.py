"""What speaks for a pose and against it: surface explained, beams that went through, conflicts."""
