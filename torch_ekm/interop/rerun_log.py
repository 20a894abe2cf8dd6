"""Trials as recordings for the rerun viewer (extra ``interop``)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from .._extras import require
from .._files import make_folder
from ..exceptions import ParameterError
from ..plant import Trajectory, TrialLog

_rr = require("rerun")
_MOST = 64  # numbers of a row that are drawn as curves; more is a picture or a tensor


def _write_trial(trajectory: Trajectory, path: Path) -> Path:
    if path.exists():
        raise ParameterError("file", str(path), "a file that does not exist yet")
    arrays = trajectory.arrays()
    recording: Any = _rr.RecordingStream("torch_ekm", recording_id=path.stem)
    recording.save(path)
    about = json.dumps({"seed": trajectory.seed, "about": trajectory.about}, indent=1)
    recording.log("about", _rr.TextDocument(about), static=True)
    times = arrays.pop("time")
    words = {"status": arrays.pop("status"), "events": arrays.pop("events")}
    if len(times):
        pose = _rr.Transform3D.columns(translation=arrays["position"], mat3x3=arrays["rotation"])
        recording.send_columns("object", [_rr.TimeColumn("time", duration=times)], pose)
    for k, time in enumerate(times.tolist()):
        recording.set_time("time", duration=time)
        for place, rows in words.items():
            recording.log(place, _rr.TextLog(rows[k].decode()))
    for place, array in arrays.items():
        at = times[: len(array)]  # a command has the time of the observation before it
        if not len(at):
            continue
        flat = array.reshape(len(array), -1)
        if flat.shape[1] <= _MOST:
            curves = _rr.Scalars.columns(scalars=flat.astype(np.float64))
            recording.send_columns(place, [_rr.TimeColumn("time", duration=at)], curves)
            continue
        for time, row in zip(at.tolist(), array, strict=True):
            recording.set_time("time", duration=time)
            picture = row.dtype == np.uint8 and (row.ndim == 2 or (row.ndim == 3 and row.shape[2] == 3))
            recording.log(place, _rr.Image(row) if picture else _rr.Tensor(row))
    recording.disconnect()
    return path


def log_to_rerun(log: TrialLog, folder: str | Path) -> list[Path]:
    """Every trial of a log as a file ``trial_000012.rrd`` for rerun; returns the files.

    An entity for each array, on the timeline ``time`` [s]: curves of up to 64 numbers, else pictures or
    tensors; ``object`` is its pose in the hand frame, ``commands`` [rad] stand at the time of the observation
    before them, ``about`` says the rest.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
        ParameterError: one of the files exists already.
    """
    folder = Path(folder)
    make_folder(folder)
    return [_write_trial(log.read(trial), folder / f"trial_{trial:06d}.rrd") for trial in log.trials]
