"""A folder of trials that survives a kill at any moment."""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from .._versions import versions_of
from ..exceptions import DescriptionError, ParameterError
from .trajectory import Trajectory, plain, publish

_NAME = re.compile(r"trial_(\d{6,})\.h5")
_PACKAGES = ("torch_ekm", "torch", "numpy", "sapien", "opencv-python")


class TrialEntry(NamedTuple):
    """One line of the index."""

    trial: int
    seed: int
    commands: int
    """How many were given."""
    time: float
    """Simulated, at the end [s]."""
    status: str
    """"held", "lost", "not_seen", or "not grasped"."""
    reason: str
    """Why the trial ended: ``outcome["reason"]``, if there is one."""

    @classmethod
    def of(cls, trial: int, trajectory: Trajectory) -> TrialEntry:
        last = trajectory.observations[-1] if trajectory.observations else None
        return cls(
            trial,
            trajectory.seed,
            len(trajectory.commands),
            0.0 if last is None else round(last.time, 6),
            "not grasped" if last is None else last.status.value,
            str(trajectory.about.get("outcome", {}).get("reason", "")),
        )


class TrialLog:
    """One HDF5 file for each trial, ``trial_000012.h5``, and ``index.csv``.

    A trial's file appears whole or not at all, so a run that is killed loses the current trial and
    nothing else; started again it asks for :meth:`missing` trials and ends with the same bytes as a run
    that was never stopped, if a trial depends on its configuration and seeds alone. The index is made
    from the files, and made again whenever it does not list exactly those.

    Args:
        folder: made if it is not there.
        configuration: what decides the trials, as JSON can hold it; written into every file. An
            existing log goes on with its own configuration only.

    Raises:
        ParameterError: the log in ``folder`` is of another configuration; the message says where.
        DescriptionError: ``folder`` is a file, or its log is damaged.
    """

    def __init__(self, folder: str | Path, configuration: Mapping[str, Any]) -> None:
        self.folder = Path(folder)
        self.configuration: dict[str, Any] = plain(dict(configuration))
        if self.folder.exists() and not self.folder.is_dir():
            raise DescriptionError(self.folder, "this is a file; a log is a folder")
        self.folder.mkdir(parents=True, exist_ok=True)
        trials = self.trials
        if trials:
            _compare(self.read(trials[0]).about.get("configuration", {}), self.configuration, self.folder)
        self._index = self._reconciled(trials)

    @classmethod
    def open(cls, folder: str | Path) -> TrialLog:
        """A log that is there already, with its own configuration.

        Raises:
            DescriptionError: there is none, or it is damaged.
        """
        folder = Path(folder)
        if not folder.is_dir():
            raise DescriptionError(folder, "no such log: it is a folder with files named trial_000000.h5 ...")
        first = next(iter(_trials(folder)), None)
        if first is None:
            raise DescriptionError(folder, "no log: there is no file named trial_000000.h5 or the like in it")
        return cls(folder, Trajectory.load(_path(folder, first)).about.get("configuration", {}))

    @property
    def trials(self) -> tuple[int, ...]:
        """Numbers of all trials that are there, in order."""
        return _trials(self.folder)

    @property
    def index(self) -> tuple[TrialEntry, ...]:
        """A line for each trial, in order."""
        if tuple(sorted(self._index)) != self.trials:  # another process wrote, too
            self._index = self._reconciled(self.trials)
        return tuple(self._index[trial] for trial in sorted(self._index))

    def __len__(self) -> int:
        return len(self.trials)

    def __contains__(self, trial: int) -> bool:
        return self.path(trial).is_file()

    def missing(self, trials: Iterable[int]) -> list[int]:
        """Those of ``trials`` that are not there yet."""
        return [trial for trial in trials if trial not in self]

    def path(self, trial: int) -> Path:
        """Where a trial is, or will be."""
        return _path(self.folder, trial)

    def read(self, trial: int) -> Trajectory:
        """One trial.

        Raises:
            DescriptionError: there is no such trial, or its file is damaged.
        """
        if trial not in self:
            there = ", ".join(map(str, self.trials[:8])) + (", ..." if len(self) > 8 else "")
            raise DescriptionError(self.folder, f"no trial {trial}; there are {there or 'none'}")
        try:
            return Trajectory.load(self.path(trial))
        except DescriptionError as error:
            raise DescriptionError(
                error.source, f"{error.problem}; delete the file to have the trial run again"
            ) from None

    def write(self, trial: int, trajectory: Trajectory, outcome: Mapping[str, Any] | None = None) -> Path:
        """Keep a finished trial; ``outcome`` says what came of it (no wall-clock times).

        Raises:
            ParameterError: there is such a trial already, or ``outcome`` is nothing that JSON can hold.
        """
        if trial < 0 or trial in self:
            raise ParameterError("trial", trial, "0 or more, and not in the log yet")
        about = {
            **trajectory.about,
            "configuration": self.configuration,
            "outcome": dict(outcome or {}),
            "trial": trial,
            "versions": versions_of(_PACKAGES),
        }
        kept = Trajectory(trajectory.seed, trajectory.commands, trajectory.observations, plain(about))
        path = kept.save(self.path(trial))
        entry = TrialEntry.of(trial, kept)
        last = max(self._index, default=-1)
        self._index[trial] = entry
        if trial < last:
            self._index = self._reconciled(self.trials)
        else:
            with self._index_path.open("ab") as stream:  # at once: whole lines even from several processes
                stream.write(_lines([entry]))
        return path

    @property
    def _index_path(self) -> Path:
        return self.folder / "index.csv"

    def _reconciled(self, trials: tuple[int, ...]) -> dict[int, TrialEntry]:
        """The index, made again unless it lists exactly these trials, in order."""
        written = self._index_path.read_bytes() if self._index_path.exists() else b""
        known = _parsed(written)
        entries = [known.get(trial) or TrialEntry.of(trial, self.read(trial)) for trial in trials]
        right = _lines([TrialEntry._fields, *entries])
        if right != written:
            part = self._index_path.with_suffix(".part")
            part.write_bytes(right)
            publish(part, self._index_path)
        return {entry.trial: entry for entry in entries}


def _path(folder: Path, trial: int) -> Path:
    return folder / f"trial_{trial:06d}.h5"


def _trials(folder: Path) -> tuple[int, ...]:
    found = (_NAME.fullmatch(name) for name in os.listdir(folder))
    return tuple(sorted(int(match[1]) for match in found if match))


def _lines(rows: Iterable[Iterable[object]]) -> bytes:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().encode()


def _parsed(written: bytes) -> dict[int, TrialEntry]:
    """Lines that are whole; a run may have been killed in the middle of the last one."""
    found = {}
    whole = written[: written.rfind(b"\n") + 1].decode(errors="replace")
    for row in csv.reader(io.StringIO(whole)):
        try:
            trial, seed, commands, time, status, reason = row
            entry = TrialEntry(int(trial), int(seed), int(commands), float(time), status, reason)
        except ValueError:  # the header, or a line that was never finished
            continue
        found[entry.trial] = entry
    return found


def _compare(there: Mapping[str, Any], wanted: Mapping[str, Any], folder: Path) -> None:
    for name in sorted({*there, *wanted}):
        if there.get(name) != wanted.get(name):
            valid = f"{there.get(name)!r} as in the log at {folder}, or another folder"
            raise ParameterError(f"configuration[{name!r}]", wanted.get(name), valid)
