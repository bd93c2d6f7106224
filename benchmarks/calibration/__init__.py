"""How often a pose with a score is right: candidates of simulated scenes, a map from score to probability, its error."""
