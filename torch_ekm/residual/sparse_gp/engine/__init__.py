"""What computes updates and queries of a sparse online GP: torch, or compiled loops where they can."""
