"""Stiffness D: springs, weights, and the geometry of constant forces."""
