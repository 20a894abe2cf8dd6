"""Pinches, planned by least squares."""
