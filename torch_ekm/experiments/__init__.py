"""Experiments: comparisons of learners, the paper's protocols, metrics, figures, reports."""

from .learner_comparison.compare import compare

__all__ = ["compare"]
