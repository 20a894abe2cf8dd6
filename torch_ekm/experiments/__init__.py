"""Claims: protocols, metrics, figures, reports."""

from .learner_comparison.compare import compare as compare

__all__ = ["compare"]
