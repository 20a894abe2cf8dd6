"""Trials leave as MCAP, as .rrd and as a LeRobot dataset, and are read back; recordings without ROS."""

import json
import resource
from pathlib import Path

import numpy as np
import pytest
import torch
from made_up import trajectory
from pyarrow import parquet
from rosbags.highlevel import AnyReader

from torch_ekm.exceptions import DescriptionError, OutputError, ParameterError, UnknownNameError
from torch_ekm.experiments.learner_comparison.recordings import load_recording
from torch_ekm.interop import log_to_lerobot, log_to_mcap, read_bag
from torch_ekm.interop.bags import _numbers
from torch_ekm.kinematics import poses
from torch_ekm.plant import Observation, Trajectory, TrialLog


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
    assert [(one.size, one.stride) for one in image[0].layout.dim] == [(9, 216), (8, 24), (3, 3)]
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
    assert table.time == pytest.approx([0.0, 0.1, 0.4, 0.9, 1.6])
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
        turned = poses.exp(torch.from_numpy(2 * half * axis))
        torch.testing.assert_close(turned, seen.rotation, rtol=0, atol=1e-9)
    (file,) = bag.glob("*.mcap")
    assert np.array_equal(read_bag(file, "/commands", ["/q", "/object_pose"]).values, table.values)
    everything = read_bag(bag, clock="/q")
    assert not any("image" in name for name in everything.names), "216 numbers are an image"
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


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DescriptionError, match="no such recording"):
        read_bag(tmp_path / "nothing", clock="/command")
    (tmp_path / "broken.mcap").write_bytes(b"not a recording")
    with pytest.raises(DescriptionError, match="cannot be read"):
        read_bag(tmp_path / "broken.mcap", clock="/command")


def test_switches_of_a_message_are_numbers() -> None:
    assert dict(_numbers(np.array([True, False]), "on")) == {"on[0]": 1.0, "on[1]": 0.0}


@pytest.fixture
def log(tmp_path: Path) -> TrialLog:
    log = TrialLog(tmp_path / "log", {"hand": "made up"})
    log.write(0, trajectory(0, 3), {"reason": "done"})
    log.write(1, Trajectory(7), {"reason": "not grasped"})
    log.write(4, trajectory(4, 5), {"reason": "done"})
    return log


def frames(log: TrialLog) -> list[tuple[Observation, torch.Tensor]]:
    """Observations, and the command after each; zeros at the end."""
    found = []
    for trial in (0, 4):
        read = log.read(trial)
        found += zip(read.observations, [*read.commands, torch.zeros(2).double()], strict=True)
    return found


def same(row, seen: Observation, command: torch.Tensor) -> None:
    pose = torch.cat([seen.position, poses.log(seen.rotation)])
    for name, value in (
        ("action", command),
        ("observation.state", torch.cat([seen.q, seen.a])),
        ("observation.environment_state", pose),
        ("observation.fingertip_force", seen.fingertip_force),
    ):
        read = torch.as_tensor(row[name], dtype=torch.float64)
        torch.testing.assert_close(read, value, rtol=1e-6, atol=1e-6)
    assert float(np.squeeze(row["observation.time"])) == pytest.approx(seen.time, abs=1e-6)


def test_a_dataset_has_a_frame_for_each_observation(log: TrialLog, tmp_path: Path) -> None:
    folder = log_to_lerobot(log, tmp_path / "dataset", "turn it")
    rows = parquet.read_table(folder / "data/chunk-000/file-000.parquet").to_pylist()
    for row, (seen, command) in zip(rows, frames(log), strict=True):
        same(row, seen, command)
    assert [row["index"] for row in rows] == list(range(10))
    info = json.loads((folder / "meta/info.json").read_text())
    assert (info["codebase_version"], info["total_episodes"], info["robot_type"]) == ("v3.0", 2, "made up")
    stats = json.loads((folder / "meta/stats.json").read_text())["observation.time"]
    times = [seen.time for seen, _ in frames(log)]
    assert [stats["mean"][0], stats["max"][0]] == pytest.approx([np.mean(times), max(times)])
    with pytest.raises(ParameterError, match="does not exist yet"):
        log_to_lerobot(log, folder)


def test_a_dataset_on_a_full_disk_is_a_typed_error_and_leaves_nothing(log: TrialLog, tmp_path: Path) -> None:
    most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, most[1]))
    try:
        with pytest.raises(OutputError, match="dataset cannot be written"):
            log_to_lerobot(log, tmp_path / "new" / "dataset")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, most)
    assert not any((tmp_path / "new").iterdir())
    assert any(log_to_lerobot(log, tmp_path / "new" / "dataset").iterdir())


def test_a_dataset_is_of_one_hand(log: TrialLog, tmp_path: Path) -> None:
    log.write(5, trajectory(5, 2, n_a=3), {})
    with pytest.raises(ParameterError, match="all with the same joints"):
        log_to_lerobot(log, tmp_path / "dataset")
    assert not (tmp_path / "dataset").exists()


def test_lerobot_reads_the_dataset(log: TrialLog, tmp_path: Path) -> None:
    lerobot = pytest.importorskip("lerobot.datasets.lerobot_dataset", reason="lerobot, of the users' own")
    folder = log_to_lerobot(log, tmp_path / "dataset", "turn it")
    dataset = lerobot.LeRobotDataset("of/this", root=folder)
    assert (len(dataset), dataset.num_episodes, dataset.fps) == (10, 2, 1)
    for k, (seen, command) in enumerate(frames(log)):
        same(dataset[k], seen, command)
        assert dataset[k]["task"] == "turn it"
        assert int(dataset[k]["episode_index"]) == int(k >= 4)
    assert dataset.meta.episodes[1]["dataset_from_index"] == 4
    windows = lerobot.LeRobotDataset("of/this", root=folder, delta_timestamps={"action": [0.0, 1.0]})
    assert windows[3]["action_is_pad"].tolist() == [False, True], "an episode ends"
