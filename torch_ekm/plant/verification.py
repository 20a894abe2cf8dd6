"""Whether a log is what was written."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

from ..description.registry import file_digests
from ..exceptions import EKMError, StateError
from .trajectory import Trajectory
from .trial_log import DAMAGED, check_configuration, read_entry, trial_path, trials_in


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
