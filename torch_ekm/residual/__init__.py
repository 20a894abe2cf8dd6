"""Learners g(x) of a model's residual; nothing here knows about robots."""
