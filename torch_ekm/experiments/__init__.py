"""Claims: protocols, metrics, figures, reports."""

from .learner_comparison.compare import compare

__all__ = ["compare"]
