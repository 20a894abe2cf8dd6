"""Ground truth: a simulated hand, and the plant contract."""
