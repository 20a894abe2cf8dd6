"""Tendons, springs and motors."""
