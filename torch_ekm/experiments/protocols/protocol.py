from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Self

from ..config import Setting
from ..records import TrialRecord
from ..reporting.report import Report
from ..reporting.statistics import DataFrame


class Protocol(ABC):
    """An experiment: what is run, and what is made of the results.

    Protocols are frozen dataclasses: their fields are the configuration. A job is a session with its
    arguments; its name holds all that decides its result, the seed included.
    """

    setting: Setting

    @abstractmethod
    def quick(self) -> Self:
        """The same with a few small turns: to see that it works, not to claim anything."""

    @abstractmethod
    def jobs(self, seeds: Sequence[int]) -> dict[str, tuple[Any, ...]]:
        """The jobs of these seeds: name -> arguments of :meth:`session`."""

    @abstractmethod
    def session(self, *arguments: Any) -> Iterable[TrialRecord]:
        """Trials that belong together, one after the other; the results of different sessions are
        independent."""

    @abstractmethod
    def report(self, seeds: Sequence[int], trials: DataFrame, folder: Path) -> Report:
        """Summary, tables, and figures in ``folder``.

        Args:
            trials: of all sessions, see :func:`~torch_ekm.experiments.reporting.statistics.trial_frame`.
        """

    def __str__(self) -> str:
        """Which plant, for the summary of a report."""
        return str(self.setting)

    def configuration(self) -> dict[str, Any]:
        """All that decides the results, but the seeds."""
        return {"experiment": dataclasses.asdict(self), **self.setting.figures()}  # pyright: ignore[reportArgumentType]

    def run(self, *arguments: Any) -> list[dict[str, Any]]:
        """Run :meth:`session`; its records in terms that JSON can keep."""
        return [vars(record) for record in self.session(*arguments)]
