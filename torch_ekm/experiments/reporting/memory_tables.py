"""Tables of the object memory: what each way of keeping knowledge predicts, compared on the same motions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..protocols.object_memory import judge_assignment
from .metrics import bootstrap_mean
from .report import Table
from .statistics import Record, bootstrap_ratio, compare
from .tables import percent, text

Array = NDArray[np.float64]
Session = list[Record]

#: Motions of a turn before the learner of a wrong object could have been corrected.
FIRST = 5


def memory_comparison(sessions: Sequence[Session]) -> Table:
    """Ratios of mean prediction errors, paired by sequence: the sequence is the independent unit."""
    rows = []
    pairs = [("bank", other) for other in ("labelled", "one model", "fresh", "none")]
    for ours, theirs in [*pairs, ("one model", "labelled")]:
        row = [f"{ours} : {theirs}"]
        for first in (None, FIRST):
            a, b = (_means(sessions, name, first) for name in (ours, theirs))
            tests = compare(a, b)
            p = "-" if tests is None else f"{tests.paired_p:.1g}"
            row += [percent(bootstrap_ratio(a, b)), p]
        rows.append(row)
    header = ["memories", "all motions [%]", "paired p", f"first {FIRST} of a turn [%]", "paired p"]
    note = (
        "Ratio of mean one-step prediction errors with 95 % bootstrap interval over sequences "
        f"({len(sessions)}); p of the paired t-test. Right model: {recognition(sessions)}."
    )
    return Table("memory_comparison", "The same motions, other memories", header, rows, note)


def recognition(sessions: Sequence[Session]) -> str:
    """Share of judged turns that went to the right model, with its interval over sequences."""
    judged = [judge_assignment(list(records)) for records in sessions]
    right = np.array([a.right for a in judged], dtype=float)
    of = np.array([a.judged for a in judged], dtype=float)
    if not of.sum():
        return "none judged"
    models = np.array([a.n_models for a in judged], dtype=float)
    share = f"{right.sum():.0f} of {of.sum():.0f} turns, {percent(bootstrap_ratio(right, of))} %"
    return f"{share}; models {text(bootstrap_mean(models), 1)}, at most {models.max():.0f}"


def _means(sessions: Sequence[Session], memory: str, first: int | None) -> Array:
    def mean(records: Session) -> float:
        return float(np.mean([e for r in records for e in r["memory_errors_deg"][memory][:first]]))

    return np.array([mean(records) for records in sessions])
