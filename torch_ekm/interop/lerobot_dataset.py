"""Trials as a LeRobot dataset, version 3 (extra ``interop``)."""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from .._extras import require
from .._files import make_folder, told_as_output_error
from ..exceptions import ParameterError
from ..kinematics import poses
from ..plant import Trajectory, TrialLog

_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"


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
        OutputError: the dataset cannot be written; nothing of it is left.
    """
    pd, _, folder = require("pandas", "interop"), require("pyarrow", "interop"), Path(folder)
    if folder.exists():
        raise ParameterError("folder", str(folder), "a folder that does not exist yet")
    read = (log.read(trial) for trial in log.trials)
    episodes = [_frames(trajectory) for trajectory in read if trajectory.observations]
    shapes = [{name: value.shape[1] for name, value in frames.items()} for frames in episodes]
    if not episodes or any(one != shapes[0] for one in shapes):
        valid = "a log with trials, all with the same joints, actuators and sensors"
        raise ParameterError("log", str(log.folder), valid)
    lengths = np.array([len(frames["action"]) for frames in episodes])
    ends = np.cumsum(lengths)
    columns = {name: np.concatenate([frames[name] for frames in episodes]) for name in episodes[0]}
    index = np.arange(ends[-1])[:, None]
    frame, episode = (
        index - np.repeat(ends - lengths, lengths)[:, None],
        np.searchsorted(ends, index, "right"),
    )
    columns |= {"timestamp": frame.astype(np.float32), "frame_index": frame, "episode_index": episode}
    columns |= {"index": index, "task_index": 0 * index}
    whole = {"episode_index": np.arange(len(lengths)), "tasks": [[task]] * len(lengths), "length": lengths}
    whole |= {"dataset_from_index": ends - lengths, "dataset_to_index": ends}
    for place in ("data", "meta/episodes"):
        whole |= {f"{place}/chunk_index": 0, f"{place}/file_index": 0}
    table = pd.DataFrame({k: list(v) if v.shape[1] > 1 else v[:, 0] for k, v in columns.items()})
    features = {k: {"dtype": str(v.dtype), "shape": [v.shape[1]], "names": None} for k, v in columns.items()}
    info = {
        "codebase_version": "v3.0", "robot_type": str(log.configuration.get("hand", "hand")),
        "total_episodes": len(lengths), "total_frames": len(index), "total_tasks": 1, "chunks_size": 1000,
        "data_files_size_in_mb": 100, "video_files_size_in_mb": 200, "fps": 1,
        "splits": {"train": f"0:{len(lengths)}"}, "data_path": f"data/{_FILE}", "video_path": None,
        "features": features,
    }  # fmt: skip
    figures = ("min", "max", "mean", "std")
    stats: dict[str, Any] = {
        name: {"count": [len(value)], **{one: getattr(value, one)(0).tolist() for one in figures}}
        for name, value in columns.items()
    }
    make_folder(folder.parent)
    with told_as_output_error(folder), TemporaryDirectory(".part", folder.name, folder.parent) as beside:
        made = Path(beside) / folder.name
        for place, rows in (("data", table), ("meta/episodes", pd.DataFrame(whole))):
            path = made / place / _FILE.format(chunk_index=0, file_index=0)
            make_folder(path.parent)
            rows.to_parquet(path, index=False)
        pd.DataFrame({"task_index": [0]}, index=[task]).to_parquet(made / "meta/tasks.parquet")
        for name, content in (("info", info), ("stats", stats)):
            (made / f"meta/{name}.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
        made.rename(folder)
    return folder


def _frames(trajectory: Trajectory) -> dict[str, Any]:
    """What LeRobot's policies read, ``(n + 1, ...)`` for n commands."""
    arrays = trajectory.arrays()
    a, turned = arrays["a"], poses.log(torch.from_numpy(arrays["rotation"]).double()).numpy()
    columns = {
        "action": np.concatenate([*arrays["commands"], np.zeros(a.shape[1])]).reshape(len(a), -1),
        "observation.state": np.concatenate([arrays["q"], a], axis=1),
        "observation.environment_state": np.concatenate([arrays["position"], turned], axis=1),
    }
    if "fingertip_force" in arrays:
        columns["observation.fingertip_force"] = arrays["fingertip_force"]
    single = {name: value.astype(np.float32) for name, value in columns.items()}
    return {**single, "observation.time": arrays["time"][:, None]}
