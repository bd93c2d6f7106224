"""Hypotheses: pairs drawn from the scene, looked up, posed and tested; of surface and of lines."""
