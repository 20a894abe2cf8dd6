"""The enhanced model f + g."""
