"""SAPIEN: bodies, contacts, time."""
