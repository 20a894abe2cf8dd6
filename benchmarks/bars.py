"""What was aimed at before the figures were known, and whether it was met: for us, not for users."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch_ekm.experiments.reporting.report import Cell, Column, Table


@dataclass(frozen=True)
class Target:
    """What was aimed at, and what was measured."""

    what: str
    """With its unit."""
    measured: float
    most: float | None = None
    least: float | None = None

    @property
    def missed_by(self) -> float:
        """0 if it is met."""
        above = 0.0 if self.most is None else self.measured - self.most
        below = 0.0 if self.least is None else self.least - self.measured
        return max(above, below, 0.0)


def targets_table(targets: Sequence[Target]) -> Table:
    """Each target: met, or by how much not."""
    columns: dict[Column, Callable[[Target], Cell]] = {
        Column("at least", "g"): lambda target: target.least,
        Column("at most", "g"): lambda target: target.most,
        Column("measured", ".3g"): lambda target: target.measured,
        Column("met"): lambda target: target.missed_by == 0,
        Column("missed by", ".3g"): lambda target: target.missed_by or None,
    }
    note = "Targets were set before the figures were known."
    return Table.of("targets", "Targets", "target", {t.what: t for t in targets}, columns, note)
