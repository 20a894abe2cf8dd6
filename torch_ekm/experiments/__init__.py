"""Experiments: comparisons of learners, the paper's protocols, metrics, figures, reports."""

from .learner_comparison.run import compare
from .learner_comparison.stream import Columns, load_own

__all__ = ["Columns", "compare", "load_own"]
