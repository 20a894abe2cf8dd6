"""Camera images: marker boards and their poses."""
