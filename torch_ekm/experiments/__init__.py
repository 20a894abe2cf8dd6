"""Experiments: comparisons of learners, the paper's protocols, metrics, figures, reports."""

from .learner_comparison.compare import compare
from .learner_comparison.own_recording import Columns, load_own

__all__ = ["Columns", "compare", "load_own"]
