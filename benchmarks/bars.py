"""Bars that were set before the figures were known, and which of them are missed."""

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
    """The targets that are missed, and by how much: no rows where all are met."""
    columns: dict[Column, Callable[[Target], Cell]] = {
        Column("measured", ".3g"): lambda target: target.measured,
        Column("bar", "g"): lambda target: target.least if target.most is None else target.most,
        Column("missed by", ".3g"): lambda target: target.missed_by,
    }
    missed = {target.what: target for target in targets if target.missed_by > 0}
    note = f"Of {len(targets)} bars, set before the measurements, these are missed."
    return Table.of("targets", "Missed bars", "figure", missed, columns, note)
