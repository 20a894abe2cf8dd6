"""What an experiment is made of."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

from ..config import Setting
from ..records import Record, TrialRecord
from ..reporting.report import Report
from ..reporting.tables import Target

R = TypeVar("R")
#: Name of a job -> what its session left.
Results = Mapping[str, Sequence[R]]


class Protocol(ABC):
    """An experiment: what is run, what was aimed at, and what is made of the results.

    Protocols are frozen dataclasses: their fields are the configuration. A job is a session with its
    arguments; its name holds all that decides its result, the seed included.
    """

    setting: Setting
    record: ClassVar[type[TrialRecord]] = TrialRecord
    """What a session leaves of each grasped object."""
    quick_seeds: ClassVar[int] = 2
    """As many show that it works."""

    @abstractmethod
    def quick(self) -> Self:
        """The same with a few small turns: to see that it works, not to claim anything."""

    @abstractmethod
    def jobs(self, seeds: Sequence[int]) -> dict[str, tuple[Any, ...]]:
        """Name -> arguments of :meth:`session`."""

    @abstractmethod
    def session(self, *arguments: Any) -> Sequence[Record]:
        """Trials that belong together, one after the other; the results of different sessions are
        independent."""

    @abstractmethod
    def report(self, seeds: Sequence[int], results: Results, folder: Path) -> Report:
        """Summary, tables, and figures in ``folder``."""

    def targets(self, results: Results) -> list[Target]:
        """What was aimed at before the figures were known; nothing by default."""
        return []

    def run(self, *arguments: Any) -> list[dict[str, Any]]:
        """:meth:`session`, as JSON keeps it."""
        return [record.to_json() for record in self.session(*arguments)]


def records_of(results: Results[R]) -> list[R]:
    """The records of all sessions."""
    return [record for session in results.values() for record in session]
