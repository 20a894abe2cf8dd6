"""Trials as a LeRobot dataset, version 3 (extra ``interop``)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .._extras import require
from .._files import make_folder
from ..exceptions import ParameterError
from ..kinematics import se3
from ..plant import Trajectory, TrialLog
from ..typing import Array

_pd = require("pandas", "interop")
require("pyarrow", "interop")
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_INDICES = ("frame_index", "episode_index", "index", "task_index")


def _frames(trajectory: Trajectory) -> dict[str, Array]:
    """``(n + 1, ...)`` for n commands: those that LeRobot's policies read."""
    arrays = trajectory.arrays()
    a, commands = arrays["a"], arrays["commands"].reshape(-1, arrays["a"].shape[-1])
    turned = se3.log(torch.from_numpy(arrays["rotation"]).double()).numpy()
    columns = {
        "action": np.concatenate([commands, np.zeros((1, a.shape[-1]))]),
        "observation.state": np.concatenate([arrays["q"], a], axis=1),
        "observation.environment_state": np.concatenate([arrays["position"], turned], axis=1),
    }
    if "fingertip_force" in arrays:
        columns["observation.fingertip_force"] = arrays["fingertip_force"]
    return {
        **{name: value.astype(np.float32) for name, value in columns.items()},
        "observation.time": arrays["time"].astype(np.float64)[:, None],
    }


def log_to_lerobot(log: TrialLog, folder: str | Path, task: str = "turn the object") -> Path:
    """The trials of a log as a LeRobot dataset v3; returns its folder, which must be new.

    An episode for each trial that was grasped, a frame for each observation, one a second: motions take as
    long as they do, ``observation.time`` has the clock [s]. ``action``: increments of the actuators [rad], 0
    in the last frame; ``observation.state``: q and a [rad]; ``observation.environment_state``: the object's
    position [m] and rotation vector [rad]; ``observation.fingertip_force`` [N] where it is measured.

    Args:
        log: whose trials are of one hand.
        folder: of the dataset.
        task: what the trials are about, in words.

    Raises:
        MissingExtraError: pandas or pyarrow is not installed.
        ParameterError: the folder exists; there is no trial; trials have other sensors than the first one.
    """
    folder = Path(folder)
    if folder.exists():
        raise ParameterError("folder", str(folder), "a folder that does not exist yet")
    read = (log.read(trial) for trial in log.trials)
    episodes = [_frames(trajectory) for trajectory in read if trajectory.observations]
    shapes = [{name: value.shape[1] for name, value in frames.items()} for frames in episodes]
    if not episodes or any(one != shapes[0] for one in shapes):
        valid = "a log with trials, all with the same joints, actuators and sensors"
        raise ParameterError("log", str(log.folder), valid)
    lengths = [len(frames["action"]) for frames in episodes]
    ends = np.cumsum(lengths)
    columns = {name: np.concatenate([frames[name] for frames in episodes]) for name in episodes[0]}
    frame = np.concatenate([np.arange(n) for n in lengths])
    columns["timestamp"] = frame.astype(np.float32)[:, None]
    episode = np.repeat(np.arange(len(lengths)), lengths)
    for name, value in zip(_INDICES, (frame, episode, np.arange(len(frame)), 0 * frame), strict=True):
        columns[name] = value[:, None]
    rows = [
        {"episode_index": k, "tasks": [task], "length": n, "data/chunk_index": 0, "data/file_index": 0,
         "dataset_from_index": int(end - n), "dataset_to_index": int(end), "meta/episodes/chunk_index": 0,
         "meta/episodes/file_index": 0}
        for k, (n, end) in enumerate(zip(lengths, ends, strict=True))
    ]  # fmt: skip
    tables = {
        "data": _pd.DataFrame({k: list(v) if v.shape[1] > 1 else v[:, 0] for k, v in columns.items()}),
        "meta/episodes": _pd.DataFrame(rows),
    }
    for place, table in tables.items():
        path = folder / place / _FILE.format(chunk_index=0, file_index=0)
        make_folder(path.parent)
        table.to_parquet(path, index=False)
    _pd.DataFrame({"task_index": [0]}, index=[task]).to_parquet(folder / "meta/tasks.parquet")
    features = {k: {"dtype": str(v.dtype), "shape": [v.shape[1]], "names": None} for k, v in columns.items()}
    info = {
        "codebase_version": "v3.0", "robot_type": str(log.configuration.get("hand", "hand")),
        "total_episodes": len(lengths), "total_frames": len(frame), "total_tasks": 1, "chunks_size": 1000,
        "data_files_size_in_mb": 100, "video_files_size_in_mb": 200, "fps": 1,
        "splits": {"train": f"0:{len(lengths)}"}, "data_path": f"data/{_FILE}", "video_path": None,
        "features": features,
    }  # fmt: skip
    stats = {name: _stats(value) for name, value in columns.items()}
    for name, content in (("info", info), ("stats", stats)):
        (folder / f"meta/{name}.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
    return folder


def _stats(value: Array) -> dict[str, Any]:
    found = {
        name: getattr(value.astype(np.float64), name)(0).tolist() for name in ("min", "max", "mean", "std")
    }
    return {**found, "count": [len(value)]}
