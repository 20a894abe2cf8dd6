"""Trials as rosbag2 recordings in MCAP (extra ``interop``)."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from .._extras import require
from .._files import make_folder
from ..exceptions import ParameterError
from ..kinematics import poses
from ..plant import Trajectory, TrialLog

_typesys = require("rosbags.typesys")
_rosbag2 = require("rosbags.rosbag2")
_TYPES = _typesys.get_typestore(_typesys.Stores.ROS2_HUMBLE)

_ABOUT, _POSE = "/about", "/object_pose"
_JOINTS = ("q", "a", "commands")  # as JointState, which viewers know
_KINDS = {"f8": "Float64", "f4": "Float32", "i8": "Int64", "u1": "UInt8"}


def _write_trial(trajectory: Trajectory, folder: str | Path) -> Path:
    """Write a trial as a rosbag2 folder with one MCAP file; returns the folder, which must be new."""
    folder = Path(folder)
    if folder.exists():
        raise ParameterError("folder", str(folder), "a folder that does not exist yet")
    arrays = trajectory.arrays()
    stamps = [round(1e9 * time) for time in arrays["time"].tolist()]
    with _rosbag2.Writer(folder, version=9, storage_plugin=_rosbag2.StoragePlugin.MCAP) as writer:

        def topic(name: str, kind: str, rows: list[tuple[int, Any]]) -> None:
            connection = writer.add_connection(name, kind, typestore=_TYPES)
            for stamp, message in rows:
                writer.write(connection, stamp, _TYPES.serialize_cdr(message, kind))

        kind, about = "std_msgs/msg/String", json.dumps({"seed": trajectory.seed, "about": trajectory.about})
        topic(_ABOUT, kind, [(min(stamps, default=0), _message(kind, data=about))])
        for place, array in arrays.items():
            kind, make = _of_rows(place, array)
            rows = [(stamp, make(stamp, row)) for stamp, row in zip(stamps, array, strict=False)]
            topic(f"/{place}", kind, rows)
        poses = zip(stamps, trajectory.observations, strict=True)
        rows = [(stamp, _pose(stamp, one.position, one.rotation)) for stamp, one in poses]
        topic(_POSE, "geometry_msgs/msg/PoseStamped", rows)
    return folder


def log_to_mcap(log: TrialLog, folder: str | Path) -> list[Path]:
    """Every trial of a log as a rosbag2 recording in MCAP, one folder each; returns the folders.

    A topic for each array, a message for each observation at its time: ``/q``, ``/a`` and ``/commands``
    (increments [rad], at the time of the observation before them) as JointState, ``/object_pose`` as
    PoseStamped in the frame ``hand``, all others as multi-arrays; ``/about`` says the rest.

    Raises:
        ParameterError: one of the recordings exists already.
    """
    folder = Path(folder)
    make_folder(folder)
    return [_write_trial(log.read(trial), folder / f"trial_{trial:06d}") for trial in log.trials]


def _message(kind: str, **fields: Any) -> Any:
    return _TYPES.types[kind](**fields)


def _of_rows(place: str, array: np.ndarray) -> tuple[str, Any]:
    """Message type of an array's rows, and what makes one of (stamp, row)."""
    if place in _JOINTS:
        return "sensor_msgs/msg/JointState", _joints
    if array.dtype.kind == "S":
        return "std_msgs/msg/String", lambda _, row: _message("std_msgs/msg/String", data=row.decode())
    code = array.dtype.kind + str(array.dtype.itemsize)
    code = code if code in _KINDS else {"f": "f8", "b": "u1"}.get(array.dtype.kind, "i8")
    kind = f"std_msgs/msg/{_KINDS[code]}MultiArray"
    return kind, lambda _, row: _multi_array(kind, np.asarray(row, dtype=code))


def _multi_array(kind: str, row: np.ndarray) -> Any:
    dimension = "std_msgs/msg/MultiArrayDimension"
    strides = np.cumprod(row.shape[::-1])[::-1]
    sizes = [
        _message(dimension, label="", size=size, stride=int(stride))
        for size, stride in zip(row.shape, strides, strict=True)
    ]
    layout = _message("std_msgs/msg/MultiArrayLayout", dim=sizes, data_offset=0)
    return _message(kind, layout=layout, data=np.atleast_1d(row).ravel())


def _joints(stamp: int, row: np.ndarray) -> Any:
    empty, position = np.zeros(0), np.asarray(row, dtype=np.float64)
    figures = {"position": position, "velocity": empty, "effort": empty}
    return _message("sensor_msgs/msg/JointState", header=_header(stamp), name=[], **figures)


def _pose(stamp: int, position: Any, rotation: Any) -> Any:
    x, y, z = (float(one) for one in position)
    phi = poses.log(rotation)
    angle = float(phi.norm())
    i, j, k = (float(one) * (math.sin(0.5 * angle) / angle if angle else 0.5) for one in phi)
    point = _message("geometry_msgs/msg/Point", x=x, y=y, z=z)
    turn = _message("geometry_msgs/msg/Quaternion", x=i, y=j, z=k, w=math.cos(0.5 * angle))
    pose = _message("geometry_msgs/msg/Pose", position=point, orientation=turn)
    return _message("geometry_msgs/msg/PoseStamped", header=_header(stamp), pose=pose)


def _header(stamp: int) -> Any:
    time = _message("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
    return _message("std_msgs/msg/Header", stamp=time, frame_id="hand")
