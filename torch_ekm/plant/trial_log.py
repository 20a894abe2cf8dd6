"""A folder of trials that survives a kill at any moment, and whether it is what was written."""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

from .._extras import versions_of
from .._files import WriterLock, make_folder, told_as_damage, told_as_output_error
from .._warnings import warn
from ..description.registry import file_digests
from ..exceptions import DescriptionError, EKMError, ParameterError, StateError
from .trajectory import Trajectory, plain, read_trial

DAMAGED = ".damaged"
_NAME = re.compile(r"trial_(\d{6,})\.h5")
_PACKAGES = ("torch_ekm", "torch", "numpy", "sapien", "opencv-python")
_TOLD = ("commands", "time", "status")  # arrays that an entry is made of


class TrialEntry(NamedTuple):
    """One trial in a line: its number, seed, length and end."""

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


class TrialLog:
    """One HDF5 file for each trial, ``trial_000012.h5``.

    A trial's file appears whole or not at all, so a run that is killed loses the current trial and
    nothing else; started again it asks for :meth:`missing` trials and ends with the same bytes as a run
    that was never stopped, if a trial depends on its configuration and seeds alone. Each file has a digest
    of all its bytes; one that is damaged gives a warning, is renamed to ``trial_000012.h5.damaged``, and
    missing.

    One writer at a time: a log is locked until :meth:`close`, the end of a ``with``, or of its process.

    Args:
        folder: made if it is not there.
        configuration: what decides the trials, as JSON can hold it; written into every file. An
            existing log goes on with its own configuration only.

    Raises:
        ParameterError: the log in ``folder`` is of another configuration; the message says where.
        DescriptionError: ``folder`` is a file.
        FolderInUseError: another process writes this log; the message names the process.
        OutputError: the folder cannot be written to.
    """

    def __init__(self, folder: str | Path, configuration: Mapping[str, Any]) -> None:
        self.folder = Path(folder)
        self.configuration: dict[str, Any] = plain(dict(configuration))
        if self.folder.exists() and not self.folder.is_dir():
            raise DescriptionError(self.folder, "this is a file; a log is a folder")
        make_folder(self.folder)
        self._lock: WriterLock | None = WriterLock(self.folder)
        try:
            self._index, self.damaged = _entries(self.folder, self.configuration)
            with told_as_output_error(self.folder):
                self._clear_up()
        except BaseException:
            self.close()
            raise

    @classmethod
    def open(cls, folder: str | Path) -> TrialLog:
        """A log that is there already, with its own configuration, to be read: nothing in it is changed.

        Raises:
            DescriptionError: there is none, or none of its trials can be read.
        """
        folder = Path(folder)
        if not folder.is_dir():
            raise DescriptionError(folder, "no such log: it is a folder with files named trial_000000.h5 ...")
        log = cls.__new__(cls)
        log.folder, log._lock = folder, None
        log._index, log.damaged = _entries(folder, None)
        if not log._index and not log.damaged:
            raise DescriptionError(folder, "no log: there is no file named trial_000000.h5 or the like in it")
        if not log._index:
            raise DescriptionError(folder, f"no trial of this log can be read: {min(log.damaged.items())[1]}")
        _, about, _ = read_trial(log.path(min(log._index)), lambda place: False)
        log.configuration = about.get("configuration", {})
        return log

    damaged: dict[int, str]
    """Trials whose files were damaged when the log was opened, and what is wrong with each."""

    @property
    def trials(self) -> tuple[int, ...]:
        """Numbers of all trials that are there, in order."""
        return trials_in(self.folder)

    @property
    def index(self) -> tuple[TrialEntry, ...]:
        """A line for each trial that can be read, in order."""
        if not {*self._index, *self.damaged} >= {*self.trials}:  # another process wrote
            self._index, self.damaged = _entries(self.folder, None)
        return tuple(self._index[trial] for trial in sorted(self._index))

    def __len__(self) -> int:
        return len(self.trials)

    def __contains__(self, trial: int) -> bool:
        return self.path(trial).is_file()

    def missing(self, trials: Iterable[int]) -> list[int]:
        """Those of ``trials`` that are not there yet."""
        return [trial for trial in trials if trial not in self]

    def path(self, trial: int) -> Path:
        """Path of the HDF5 file in which a trial is, or will be."""
        return trial_path(self.folder, trial)

    def read(self, trial: int) -> Trajectory:
        """One trial.

        Raises:
            DescriptionError: there is no such trial, or its file is damaged.
        """
        if trial not in self:
            there = ", ".join(map(str, self.trials[:8])) + (", ..." if len(self) > 8 else "")
            raise DescriptionError(self.folder, f"no trial {trial}; there are {there or 'none'}")
        return Trajectory.load(self.path(trial))

    def write(self, trial: int, trajectory: Trajectory, outcome: Mapping[str, Any] | None = None) -> Path:
        """Keep a finished trial; ``outcome`` says what came of it (no wall-clock times).

        Raises:
            ParameterError: there is such a trial already, or ``outcome`` is nothing that JSON can hold.
            StateError: the log was opened to be read, or is closed.
            OutputError: the trial cannot be written, and the log is what it was.
        """
        if self._lock is None:
            raise StateError(
                f"the log {self.folder} is closed, or opened to be read: TrialLog(folder, configuration)"
            )
        if trial < 0 or trial in self:
            raise ParameterError("trial", trial, "0 or more, and not in the log yet")
        about = {
            **trajectory.about,
            "configuration": self.configuration,
            "outcome": dict(outcome or {}),
            "trial": trial,
            "versions": versions_of(_PACKAGES),
        }
        kept = dataclasses.replace(trajectory, about=plain(about))
        path = kept.save(self.path(trial))
        self._index[trial] = _entry(trial, *read_trial(path, _TOLD.__contains__))
        return path

    def close(self) -> None:
        """Let others write; the log can still be read."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def __enter__(self) -> TrialLog:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _clear_up(self) -> None:
        """Move damaged files aside, and remove those that were never finished."""
        for trial, problem in self.damaged.items():
            aside = self.path(trial).with_name(self.path(trial).name + DAMAGED)
            os.replace(self.path(trial), aside)
            what = f"{problem}; kept as {aside.name}, and missing from the log"
            warn(f"{aside.with_suffix('')}: {what}")
        for path in self.folder.glob("*.part"):
            if _NAME.fullmatch(path.stem):
                path.unlink()


def trial_path(folder: Path, trial: int) -> Path:
    """Path of the HDF5 file of trial number ``trial`` in a log."""
    return folder / f"trial_{trial:06d}.h5"


def trials_in(folder: Path) -> tuple[int, ...]:
    """Numbers of the trials that have a file, in order."""
    found = (_NAME.fullmatch(name) for name in os.listdir(folder))
    return tuple(sorted(int(match[1]) for match in found if match))


def read_entry(folder: Path, trial: int) -> tuple[TrialEntry, dict[str, Any]]:
    """A trial in a line, and its configuration, from its file.

    Raises:
        DescriptionError: the file is damaged, or holds another trial.
    """
    path = trial_path(folder, trial)
    seed, about, arrays = read_trial(path, _TOLD.__contains__)
    if about.get("trial", trial) != trial:
        raise DescriptionError(path, f"holds trial {about['trial']!r}")
    configuration = about.get("configuration", {})
    with told_as_damage(path, "trial"):
        return _entry(trial, seed, about, arrays), dict(configuration)


def check_configuration(there: Mapping[str, Any], wanted: Mapping[str, Any], place: object) -> None:
    """That a trial's configuration is the wanted one.

    Raises:
        ParameterError: it is not; the message names the first difference.
    """
    for name in sorted({*there, *wanted}):
        if there.get(name) != wanted.get(name):
            valid = f"{there.get(name)!r} as in the log at {place}, or another folder"
            raise ParameterError(f"configuration[{name!r}]", wanted.get(name), valid)


def _entry(trial: int, seed: int, about: Mapping[str, Any], arrays: Mapping[str, Any]) -> TrialEntry:
    times, words = arrays["time"], arrays["status"]
    time, status = (round(float(times[-1]), 6), words[-1].decode()) if len(times) else (0.0, "not grasped")
    reason = str(about.get("outcome", {}).get("reason", ""))
    return TrialEntry(trial, seed, len(arrays["commands"]), time, status, reason)


def _entries(folder: Path, wanted: Mapping[str, Any] | None) -> tuple[dict[int, TrialEntry], dict[int, str]]:
    """What can be read, and what is wrong with the others."""
    entries: dict[int, TrialEntry] = {}
    damaged: dict[int, str] = {}
    for trial in trials_in(folder):
        try:
            entries[trial], configuration = read_entry(folder, trial)
        except DescriptionError as error:
            damaged[trial] = error.problem
            continue
        if wanted is not None:
            check_configuration(configuration, wanted, folder)
    return entries, damaged


class Finding(NamedTuple):
    """Whether one file of a log is what was written, and why not."""

    file: str
    state: Literal["ok", "wrong", "left over"]
    """"left over": of a run that was killed, or set aside because it was damaged; no part of the log."""
    what: str


def verify_log(folder: str | Path) -> list[Finding]:
    """Check every byte of a log: each trial, and the hand's and object's files that it was made from.

    A trial is right if its SHA-256 is, it can be read, it is the one that its name says, and its
    configuration is that of the others. The digests detect damage, not deliberate changes of a file
    and its digest.

    Returns:
        A finding for each file; the log is right if none is "wrong".
    """
    folder = Path(folder)
    trials = trials_in(folder) if folder.is_dir() else ()
    if not trials:
        problem = "no log: there is no file named trial_000000.h5 or the like in it"
        return [Finding(str(folder), "wrong", problem)]
    shared: dict[str, Any] | None = None
    found = []
    for trial in trials:
        path = trial_path(folder, trial)
        try:
            entry, configuration = read_entry(folder, trial)
            recording = Trajectory.load(path)
            shared = configuration if shared is None else shared
            check_configuration(shared, configuration, folder)
            if len(recording.observations) not in (len(recording.commands) + 1, 0):
                sizes = f"{len(recording.commands)} commands and {len(recording.observations)} observations"
                raise StateError(f"{sizes}; there must be one observation more than commands")
            what = f"{entry.commands} commands, {entry.reason or entry.status}"
            found.append(Finding(path.name, "ok", what))
        except EKMError as error:
            found.append(Finding(path.name, "wrong", str(error).removeprefix(f"{path}: ")))
    found += _sources(shared or {})
    left_over = sorted([*folder.glob("*.part"), *folder.glob(f"*{DAMAGED}")])
    what = "no part of the log; the next run clears up unfinished files"
    return found + [Finding(path.name, "left over", what) for path in left_over]


def _sources(configuration: Mapping[str, Any]) -> list[Finding]:
    """Files of hand and object: those here compared with those that the log was made from."""
    recorded = configuration.get("files")
    if not isinstance(recorded, dict):
        what = "the configuration has no digests of the hand's and the object's files"
        return [Finding("(sources)", "ok", f"{what}; nothing to compare")]
    try:
        here = file_digests(str(configuration.get("hand")), [str(configuration.get("object"))])
    except EKMError as error:
        return [Finding("(sources)", "wrong", f"not here: {error}")]
    found = []
    for name in sorted({*recorded, *here}):
        if recorded.get(name) == here.get(name):
            found.append(Finding(name, "ok", "the file here is the one that the log was made from"))
        else:
            found.append(Finding(name, "wrong", "the file here is not the one that the log was made from"))
    return found
