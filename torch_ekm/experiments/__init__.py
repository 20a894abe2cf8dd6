"""Experiments: comparisons of learners, the paper's protocols, metrics, figures, reports."""

from .learner_comparison.own_recording import Columns, load_own
from .learner_comparison.run import compare

__all__ = ["Columns", "compare", "load_own"]
