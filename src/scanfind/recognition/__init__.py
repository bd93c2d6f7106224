"""The search of a scene held together: rounds of hypotheses, what is believed, models of several sizes."""
