"""The sparse online Gaussian process and its parts."""
