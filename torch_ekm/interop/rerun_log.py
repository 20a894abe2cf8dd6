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

_MOST = 64  # numbers of a row that are drawn as curves; more is a picture or a tensor


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


def _write_trial(trajectory: Trajectory, path: Path) -> Path:
    if path.exists():
        raise ParameterError("file", str(path), "a file that does not exist yet")
    rr, arrays = require("rerun"), trajectory.arrays()
    recording: Any = rr.RecordingStream("torch_ekm", recording_id=path.stem)
    recording.save(path)
    about = json.dumps({"seed": trajectory.seed, "about": trajectory.about}, indent=1)
    recording.log("about", rr.TextDocument(about), static=True)
    times = arrays.pop("time")

    def columns(place: str, values: Any, n: int) -> None:
        recording.send_columns(place, [rr.TimeColumn("time", duration=times[:n])], values)

    if len(times):
        pose = rr.Transform3D.columns(translation=arrays["position"], mat3x3=arrays["rotation"])
        columns("object", pose, len(times))
    for place, array in arrays.items():
        if len(array) and array.dtype.kind != "S" and array[0].size <= _MOST:
            curves = array.reshape(len(array), -1).astype(np.float64)
            columns(place, rr.Scalars.columns(scalars=curves), len(array))
            continue
        for time, row in zip(times.tolist(), array, strict=False):
            recording.set_time("time", duration=time)
            recording.log(place, _drawn(rr, row))
    recording.disconnect()
    return path


def _drawn(rr: Any, row: Any) -> Any:
    if isinstance(row, bytes):
        return rr.TextLog(row.decode())
    picture = row.dtype == np.uint8 and (row.ndim == 2 or (row.ndim == 3 and row.shape[2] == 3))
    return rr.Image(row) if picture else rr.Tensor(row)
