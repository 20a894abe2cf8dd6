"""Trials leave as MCAP; any recording is read without ROS."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from torch_ekm.exceptions import DescriptionError, ParameterError, UnknownNameError
from torch_ekm.experiments.learner_comparison.recordings import load_recording
from torch_ekm.interop import log_to_mcap, read_bag
from torch_ekm.interop.bags import _numbers
from torch_ekm.interop.mcap_log import _multi_array
from torch_ekm.kinematics import se3
from torch_ekm.plant import Observation, PlantStatus, Trajectory, TrialLog, Truth

AnyReader = pytest.importorskip("rosbags.highlevel", reason="extra 'interop'").AnyReader
pytest.importorskip("h5py", reason="extra 'sim'")


def trajectory(seed: int, n: int = 3, forces: bool = True) -> Trajectory:
    """Made up: what every sensor said, with raw counts, an image and events."""
    random = torch.Generator().manual_seed(seed)

    def some(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=random, dtype=torch.float64)

    seen = []
    for k in range(n + 1):
        rotation = se3.exp(some(3))
        info = {
            "raw": {"counts": torch.arange(4, dtype=torch.int32) + k, "image": torch.full((9, 9), k).byte()},
            "estimate": {"covariance": some(2, 2).float()},
        }
        if k == 1:
            info["events"] = ("a tendon slipped",)
        q, a, position = some(4), some(2), some(3)
        truth = Truth(q + 0.01, position, rotation)
        status = PlantStatus.LOST if k == n else PlantStatus.HELD
        force = some(2) if forces else None
        seen.append(Observation(q, a, position, rotation, force, 0.1 * k + 0.3, status, info, truth))
    return Trajectory(seed, [some(2) for _ in range(n)], seen, {"note": "made up"})


def test_a_log_has_a_recording_for_each_trial(tmp_path: Path) -> None:
    log = TrialLog(tmp_path / "log", {"hand": "made up"})
    one = trajectory(0)
    log.write(0, one, {"reason": "done"})
    log.write(1, Trajectory(7), {"reason": "not grasped"})
    log.close()
    bags = log_to_mcap(log, tmp_path / "bags")
    assert [bag.name for bag in bags] == ["trial_000000", "trial_000001"]
    with AnyReader([bags[0]]) as reader:
        said: dict[str, list] = {}
        for connection, _, raw in reader.messages():
            said.setdefault(connection.topic, []).append(reader.deserialize(raw, connection.msgtype))
    kept = log.read(0).arrays()
    assert set(said) == {"/about", "/object_pose", *(f"/{place}" for place in kept)}
    assert json.loads(said["/about"][0].data)["about"]["outcome"]["reason"] == "done"
    (image,) = (messages for topic, messages in said.items() if topic.endswith("/image"))
    assert [int(np.asarray(message.data).max()) for message in image] == [0, 1, 2, 3]
    assert [message.position.tolist() for message in said["/q"]] == [o.q.tolist() for o in one.observations]
    with pytest.raises(ParameterError, match="does not exist yet"):
        log_to_mcap(log, tmp_path / "bags")


def test_a_recording_is_a_table(tmp_path: Path) -> None:
    one = trajectory(3, n=5)
    log = TrialLog(tmp_path / "log", {})
    log.write(0, one)
    (bag,) = log_to_mcap(log, tmp_path / "bags")
    table = read_bag(bag, clock="/commands", topics=["/q", "/object_pose"])
    assert table.values.shape == (5, 2 + 4 + 7)
    assert table.time == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    columns = dict(zip(table.names, table.values.T, strict=True))
    assert columns["/q.position[1]"].tolist() == [float(o.q[1]) for o in one.observations[:5]]
    assert columns["/commands.position[0]"].tolist() == [float(c[0]) for c in one.commands]
    assert columns["/object_pose.pose.position.z"].tolist() == [
        float(o.position[2]) for o in one.observations[:5]
    ]
    x, y, z, w = (columns[f"/object_pose.pose.orientation.{axis}"] for axis in "xyzw")
    for k, seen in enumerate(one.observations[:5]):
        half = np.arccos(np.clip(w[k], -1, 1))
        axis = np.array([x[k], y[k], z[k]]) / np.sin(half)
        turned = se3.exp(torch.from_numpy(2 * half * axis))
        torch.testing.assert_close(turned, seen.rotation, rtol=0, atol=1e-9)
    (file,) = bag.glob("*.mcap")
    assert np.array_equal(read_bag(file, "/commands", ["/q", "/object_pose"]).values, table.values)
    everything = read_bag(bag, clock="/q")
    assert not any("image" in name for name in everything.names), "81 numbers are an image"
    with pytest.raises(UnknownNameError, match="/object_pose"):
        read_bag(bag, clock="/wrench")


def test_learners_are_compared_on_a_recording(tmp_path: Path) -> None:
    one, log = trajectory(3, n=45), TrialLog(tmp_path / "log", {})
    log.write(0, one)
    (bag,) = log_to_mcap(log, tmp_path / "bags")
    columns = {"inputs": ["/commands.position*"], "targets": ["/q.position[0]"]}
    assert load_recording(bag, clock="/commands", **columns).x.shape == (45, 2)
    (file,) = bag.glob("*.mcap")
    moves = load_recording(file, None, ["/q.position[0]"], clock="/commands", inputs=columns["inputs"])
    assert moves.y.shape == (44, 1)
    with pytest.raises(ParameterError, match="a topic whose messages set the rows"):
        load_recording(file, **columns)


@pytest.mark.parametrize("kind", ["mcap", "sqlite3", "ros1"])
def test_other_topics_stand_as_they_were_last_heard(kind: str, tmp_path: Path) -> None:
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    joints, number = types.types["sensor_msgs/msg/JointState"], types.types["std_msgs/msg/Float64"]
    time = types.types["builtin_interfaces/msg/Time"](0, 0)
    header = types.types["std_msgs/msg/Header"](*([0] if kind == "ros1" else []), time, "")
    bag = tmp_path / ("own.bag" if kind == "ros1" else "own")
    plugin = getattr(rosbag2.StoragePlugin, kind.upper(), None)
    made = rosbag1.Writer(bag) if kind == "ros1" else rosbag2.Writer(bag, version=9, storage_plugin=plugin)
    pack = types.serialize_ros1 if kind == "ros1" else types.serialize_cdr
    with made as writer:
        slow = writer.add_connection("/joints", "sensor_msgs/msg/JointState", typestore=types)
        fast = writer.add_connection("/command", "std_msgs/msg/Float64", typestore=types)
        for stamp in range(10):
            if stamp % 4 == 2:
                position = np.array([1.0, 2.0]) * stamp
                message = joints(header, ["thumb", "index"], position, np.zeros(0), np.zeros(0))
                writer.write(slow, 10**9 * stamp, pack(message, "sensor_msgs/msg/JointState"))
            writer.write(fast, 10**9 * stamp + 1, pack(number(data=float(stamp)), "std_msgs/msg/Float64"))
    table = read_bag(bag, clock="/command")
    columns = dict(zip(table.names, table.values.T, strict=True))
    assert columns["/command.data"].tolist() == [*range(10)]
    index, thumb = columns["/joints.position.index"], columns["/joints.position.thumb"]
    assert np.isnan(index[:2]).all()
    assert index[2:].tolist() == [4, 4, 4, 4, 12, 12, 12, 12]
    assert thumb[2:].tolist() == [2, 2, 2, 2, 6, 6, 6, 6]
    assert table.age[:, table.names.index("/joints.position.thumb")][2:6] == pytest.approx(
        [0, 1, 2, 3], abs=1e-8
    )
    with pytest.raises(DescriptionError, match="no such recording"):
        read_bag(tmp_path / "nothing", clock="/command")
    (tmp_path / "broken.mcap").write_bytes(b"not a recording")
    with pytest.raises(DescriptionError, match="cannot be read"):
        read_bag(tmp_path / "broken.mcap", clock="/command")


def test_strides_of_a_layout_count_all_later_sizes() -> None:
    layout = _multi_array("std_msgs/msg/UInt8MultiArray", np.zeros((4, 5, 3), np.uint8)).layout
    assert [(one.size, one.stride) for one in layout.dim] == [(4, 60), (5, 15), (3, 3)]


def test_switches_of_a_message_are_numbers() -> None:
    assert dict(_numbers(np.array([True, False]), "on")) == {"on[0]": 1.0, "on[1]": 0.0}
