"""WHICH motor increment to command."""
