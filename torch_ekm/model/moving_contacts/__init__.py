"""Contacts that stick, slide, open and close, and links that bear on the object."""
