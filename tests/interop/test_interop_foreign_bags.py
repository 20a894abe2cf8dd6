"""Recordings as ros2_control, Gazebo, a LEAP hand and an arm beside a hand leave them: with holes."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags import rosbag1, rosbag2, typesys
from rosbags.convert.converter import LATCH

from torch_ekm.exceptions import DescriptionError
from torch_ekm.experiments import Columns, load_own
from torch_ekm.experiments.learner_comparison.stream import load_table
from torch_ekm.interop import read_bag

TYPES = {
    kind: typesys.get_typestore(getattr(typesys.Stores, "ROS1_NOETIC" if kind == "ros1" else "LATEST"))
    for kind in ("ros1", "ros2")
}
LATCHED: tuple[dict[str, Any], dict[str, Any]] = ({"offered_qos_profiles": LATCH}, {"latching": 1})
Heard = tuple[float, str, Any]  # logged [s], topic, message without header or (type, its fields)


class Maker:
    """Messages of ROS 1 or 2."""

    def __init__(self, kind: str = "mcap") -> None:
        self.kind, self.types = kind, TYPES["ros1" if kind == "ros1" else "ros2"]

    def make(self, kind: str, *values: Any, **named: Any) -> Any:
        return self.types.types[kind](*values, **named)

    def header(self, stamp: float) -> Any:
        ns = round(1e9 * stamp)
        time = self.make("builtin_interfaces/msg/Time", ns // 10**9, ns % 10**9)
        return self.make("std_msgs/msg/Header", *([0] if self.kind == "ros1" else []), time, "")

    def joints(self, stamp: float, names: Iterable[str], position: Any, effort: Any = ()) -> Any:
        arrays = [np.array(x, dtype=float) for x in (position, (), effort)]
        return self.make("sensor_msgs/msg/JointState", self.header(stamp), list(names), *arrays)

    def array(self, *values: float) -> Any:
        layout = self.make("std_msgs/msg/MultiArrayLayout", [], 0)
        return self.make("std_msgs/msg/Float64MultiArray", layout, np.array(values, dtype=float))

    def write(self, folder: Path, heard: Iterable[Heard], latched: str = "") -> Path:
        """With the durability of transient local, or ROS 1's latching, for one topic."""
        path = folder / ("own.bag" if self.kind == "ros1" else "own")
        if self.kind == "ros1":
            writer: Any = rosbag1.Writer(path)
        else:
            plugin = getattr(rosbag2.StoragePlugin, self.kind.upper())
            writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
        topics: dict[str, Any] = {}
        pack = self.types.serialize_ros1 if self.kind == "ros1" else self.types.serialize_cdr
        with writer:
            for logged, topic, message in heard:
                kind = message.__msgtype__
                if topic not in topics:
                    named = LATCHED[self.kind == "ros1"] if topic == latched else {}
                    topics[topic] = writer.add_connection(topic, kind, typestore=self.types, **named)
                writer.write(topics[topic], round(1e9 * logged), pack(message, kind))
        return path


@pytest.fixture
def ros() -> Maker:
    return Maker()


def column(table: Any, name: str) -> np.ndarray:
    return table.values[:, table.names.index(name)]


def ros2_control(ros: Maker, n: int = 120, battery: float = 2.0) -> list[Heard]:
    """Effort is NaN where a joint has none; a topic that nobody asks for begins late."""
    heard: list[Heard] = []
    for k in range(n):
        t = 100 + 0.02 * k
        heard.append((t, "/joint_states", ros.joints(t, "ab", [np.sin(k), 0.1 * k], [np.nan, np.nan])))
        heard.append((t + 0.001, "/commands", ros.array(np.cos(k))))
        if t - 100 >= battery:
            heard.append((t + 0.002, "/battery", ros.array(12.0)))
    return heard


def test_what_nobody_asks_for_costs_no_row(ros, tmp_path) -> None:
    path = ros.write(tmp_path, ros2_control(ros))
    table = read_bag(path, "/commands")
    assert table.values.shape == (120, 6)
    assert np.isnan(column(table, "/joint_states.effort.a")).all()
    which = Columns(["/joint_states.position*"], ["/commands.data[0]"], ["/joint_states.position.a"])
    own = load_own(path, which, clock="/commands")
    assert (len(own.x), own.notes) == (119, "")
    late = Columns([*which.state, "/battery.data[0]"], which.command, which.observation)
    own = load_own(ros.write(tmp_path / "late", ros2_control(ros, battery=1.0)), late, clock="/commands")
    assert len(own.x) == 68
    assert own.notes == " 69 of 120 rows, because /battery.data[0] begins at 1.02 s."
    assert own.stream().notes == own.notes


def test_what_is_never_finite_is_named(ros, tmp_path) -> None:
    path = ros.write(tmp_path, ros2_control(ros))
    inputs = ["/joint_states*"]
    problem = (
        r"0 of 120 rows, because /joint_states \(2 columns, /joint_states.effort.a\) has no finite value"
    )
    with pytest.raises(DescriptionError, match=problem):
        load_table(path, ["/commands.data[0]"], inputs=inputs, clock="/commands")


def test_nothing_is_held_for_ever(ros, tmp_path) -> None:
    """An array that is emptied, one that grows, a sensor that dies and one that pauses; a row is 20 ms."""
    heard: list[Heard] = []
    for k in range(100):
        t = 1 + 0.02 * k
        heard.append((t, "/js", ros.joints(t, "a", [k], [3.0] if k < 50 else [])))
        heard.append((t, "/forces", ros.array(*([3.0] if k < 50 else [4.0, 5.0] if k >= 70 else []))))
        if k < 60:
            heard.append((t, "/dies", ros.array(k)))
        if not 30 <= k < 60:
            heard.append((t, "/pauses", ros.array(k)))
        heard.append((t + 0.001, "/u", ros.array(k)))
    heard.insert(0, (0.99, "/once", ros.array(7.0)))
    table = read_bag(ros.write(tmp_path, heard), "/u")
    assert column(table, "/forces.data[0]")[[49, 50, 69, 70]] == pytest.approx(
        [3, np.nan, np.nan, 4], nan_ok=True
    )
    assert np.isnan(column(table, "/forces.data[1]")[:70]).all()
    assert column(table, "/js.effort.a")[[49, 50]] == pytest.approx([3, np.nan], nan_ok=True)
    assert column(table, "/dies.data[0]")[[59, 68, 70]] == pytest.approx([59, 59, np.nan], nan_ok=True)
    assert np.isnan(column(table, "/pauses.data[0]")[46:60]).all()
    assert column(table, "/pauses.data[0]")[[29, 39, 60]].tolist() == [29, 29, 60]
    assert (column(table, "/once.data[0]") == 7.0).all()
    which = Columns(["/pauses.data[0]"], ["/u.data[0]"], ["/pauses.data[0]"])
    own = load_own(ros.write(tmp_path / "again", heard), which, clock="/u")
    steps = own.y[:, 0].tolist()
    assert max(steps) == 1.0, "no motion goes over the pause"
    assert "because /pauses.data[0] is silent or not finite in 16 rows, first at 0.88 s" in own.notes


@pytest.mark.parametrize("kind", ["mcap", "sqlite3", "ros1"])
def test_what_is_latched_holds_until_it_is_said_anew(kind: str, tmp_path) -> None:
    """Three settings within 0.02 s, and nothing for 2 s."""
    ros = Maker(kind)
    heard = [(0.5 + 0.01 * k, "/mode", ros.array(k)) for k in range(3)]
    heard += [(1 + 0.02 * k, "/u", ros.array(k)) for k in range(100)]
    assert (column(read_bag(ros.write(tmp_path, heard, latched="/mode"), "/u"), "/mode.data[0]") == 2.0).all()
    (tmp_path / "volatile").mkdir()
    table = read_bag(ros.write(tmp_path / "volatile", heard), "/u")
    assert np.isnan(column(table, "/mode.data[0]")).all()


@pytest.mark.parametrize("kind", ["mcap", "sqlite3", "ros1"])
def test_a_simulation_that_was_reset_is_two_runs(kind: str, tmp_path) -> None:
    """Gazebo's clock goes back to its begin, and stamps fall between those of the first run."""
    ros = Maker(kind)
    heard: list[Heard] = []
    for run in (0, 1):
        for k in range(60):
            t = 1 + 0.01 * run + 0.02 * k
            heard.append((t, "/q", ros.array(1000 * run + k)))
            heard.append((t, "/u", ros.array(1.0)))
    path = ros.write(tmp_path, heard)
    table = read_bag(path, "/q")
    assert column(table, "/q.data[0]").tolist() == [*range(60), *range(1000, 1060)]
    assert table.run.tolist() == [0] * 60 + [1] * 60
    assert table.notes == ("2 runs: a clock was set back",)
    own = load_own(path, Columns(["/q.data[0]"], ["/u.data[0]"], ["/q.data[0]"]), clock="/q")
    assert own.y[:, 0].tolist() == [1.0] * 118


@pytest.mark.parametrize(("step", "n", "runs"), [(0.001, 80, 4), (1.0, 8, 10), (0.02, 5, 20)])
def test_runs_may_be_short(step: float, n: int, runs: int, ros, tmp_path) -> None:
    heard = [(1 + step * k, "/u", ros.array(1000 * run + k)) for run in range(runs) for k in range(n)]
    table = read_bag(ros.write(tmp_path, heard), "/u")
    assert column(table, "/u.data[0]").tolist() == [1000 * run + k for run in range(runs) for k in range(n)]
    assert table.run.tolist() == [run for run in range(runs) for _ in range(n)]


def test_a_stamp_from_the_future_begins_no_run(ros, tmp_path) -> None:
    heard = [(1 + 0.02 * k, "/q", ros.joints(1 + 0.02 * k + 500 * (k == 50), "a", [k])) for k in range(99)]
    assert not read_bag(ros.write(tmp_path, heard), "/q").run.any()


def test_a_topic_that_cannot_be_read_is_left_out_unless_it_is_asked_for(ros, tmp_path) -> None:
    """A camera's messages of a type that is not there, say; here a name stands twice."""
    heard = [(t, topic, ros.joints(t, names, [1, 2]))
             for t in range(1, 60) for topic, names in (("/q", "ab"), ("/odd", "cc"))]  # fmt: skip
    path = ros.write(tmp_path, heard)
    table = read_bag(path, "/q")
    assert table.names == ("/q.position.a", "/q.position.b")
    assert table.notes[0].startswith("/odd (sensor_msgs/msg/JointState) cannot be read: ")
    with pytest.raises(DescriptionError, match=r"/odd .* has the name 'c' twice"):
        read_bag(path, "/q", ["/odd"])
    (path / "metadata.yaml").unlink()
    with pytest.raises(DescriptionError, match=r"without metadata\.yaml"):
        read_bag(path, "/q")


def test_transforms_are_called_by_their_frames(ros, tmp_path) -> None:
    """Two nodes, one transform each, on one topic."""
    turn = ros.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
    heard: list[Heard] = []
    for k in range(40):
        for name, x in (("object", float(k)), ("palm", -1.0)):
            moved = ros.make(
                "geometry_msgs/msg/Transform", ros.make("geometry_msgs/msg/Vector3", x, 0.0, 0.0), turn
            )
            one = ros.make("geometry_msgs/msg/TransformStamped", ros.header(1 + 0.1 * k), name, moved)
            heard.append((1 + 0.1 * k, "/tf", ros.make("tf2_msgs/msg/TFMessage", [one])))
        heard.append((1.01 + 0.1 * k, "/u", ros.array(k)))
    table = read_bag(ros.write(tmp_path, heard), "/u")
    assert column(table, "/tf.transforms.object.transform.translation.x").tolist() == [*range(40)]


def test_stamps_that_fall_are_a_reset_only_where_they_are_one_clock(ros, tmp_path) -> None:
    """The log's time is the wall's; two robots whose clocks differ by 2 s take turns on one topic."""
    heard: list[Heard] = []
    for k in range(80):
        t, sim = 1e6 + 0.02 * k, 5 + 0.02 * (k % 40)
        heard.append((t, "/q", ros.joints(sim, "a", [k])))
        heard.append((t + 0.001, "/both", ros.joints(t - 2 * (k % 2), "xy"[k % 2], [k])))
        heard.append((t + 0.002, "/u", ros.array(k)))
    table = read_bag(ros.write(tmp_path, heard), "/u")
    assert table.run.tolist() == [0] * 40 + [1] * 40
    assert "/q has a header.stamp 1e+06 s before it was logged: not used" in table.notes


def test_names_count_wherever_a_message_has_them(ros, tmp_path) -> None:
    """Names of a trajectory and of ros2_control's states are not called ``name``, and change places."""
    heard: list[Heard] = []
    for k in range(60):
        t, (names, goal) = 1 + 0.02 * k, (("ab", [k, -k]), ("ba", [-k, k]))[k % 2]
        point = [
            np.array(goal, dtype=float),
            *[np.array([])] * 3,
            ros.make("builtin_interfaces/msg/Duration", 0, 1),
        ]
        points = [ros.make("trajectory_msgs/msg/JointTrajectoryPoint", *point)]
        heard.append(
            (t, "/u", ros.make("trajectory_msgs/msg/JointTrajectory", ros.header(t), list(names), points))
        )
    table = read_bag(ros.write(tmp_path, heard), "/u")
    assert column(table, "/u.points[0].positions.a").tolist() == [*range(60)]
    assert column(table, "/u.points[0].positions.b").tolist() == [-k for k in range(60)]
    twice = tmp_path / "twice"
    twice.mkdir()
    heard = [(1 + k, "/q", ros.joints(1 + k, ["a", "a"], [1, 2])) for k in range(9)]
    with pytest.raises(DescriptionError, match="/q: a message has the name 'a' twice"):
        read_bag(ros.write(twice, heard), "/q")


def test_messages_of_one_time_are_a_row_each(ros, tmp_path) -> None:
    """A simulation's clock stands between its steps."""
    heard: list[Heard] = [(1 + 0.1 * (k // 4), "/u", ros.array(k)) for k in range(80)]
    table = read_bag(ros.write(tmp_path, heard), "/u")
    assert column(table, "/u.data[0]").tolist() == [*range(80)]


def test_an_arm_and_a_hand_take_turns_on_one_topic(ros, tmp_path) -> None:
    heard: list[Heard] = []
    for k in range(50):
        t = 1 + 0.02 * k
        heard.append((t, "/joint_states", ros.joints(t, ["finger"], [k])))
        heard.append((t + 0.005, "/joint_states", ros.joints(t + 0.005, ["elbow"], [-k])))
        heard.append((t + 0.01, "/u", ros.array(k)))
    table = read_bag(ros.write(tmp_path, heard), "/u")
    assert column(table, "/joint_states.position.finger").tolist() == [*range(50)]
    assert column(table, "/joint_states.position.elbow").tolist() == [-k for k in range(50)]


def test_a_message_counts_from_its_stamp_and_the_latency_is_stated(ros, tmp_path) -> None:
    """A LEAP hand's node writes unnamed arrays; here they are logged 45 ms after they were measured."""
    heard: list[Heard] = []
    for k in range(80):
        t = 1 + 0.02 * k
        late = 1.4 if k == 40 else 0.045  # a network that hangs for a moment
        heard.append((t + late, "/leap", ros.joints(t, "", [k, -k])))
        heard.append((t + 0.001, "/u", ros.array(k)))
    heard.sort(key=lambda one: one[0])
    table = read_bag(ros.write(tmp_path, heard), "/u")
    assert column(table, "/leap.position[1]").tolist() == [-k for k in range(80)]
    assert table.notes == (
        "/leap counts from its header.stamp, 45 ms before it was logged (at most 1.4e+03 ms)",
    )


def test_rows_are_in_the_order_of_time_whoever_wrote_them(ros, tmp_path) -> None:
    """One topic after the other, and neighbours exchanged."""
    heard: list[Heard] = [(1 + 0.02 * (k ^ 1), "/u", ros.array(k ^ 1)) for k in range(60)]
    heard += [(1.001 + 0.02 * k, "/q", ros.array(k)) for k in range(60)]
    table = read_bag(ros.write(tmp_path, heard), "/u")
    assert column(table, "/u.data[0]").tolist() == [*range(60)]
    assert column(table, "/q.data[0]")[1:].tolist() == [*range(59)]
    assert not table.run.any()


TIMES = ["time [s]", "%time", "__time", "/joint_states/header.stamp", "timestamp_ns"]
MAYBE = ["t", "t [s]", "sim_time", "header_stamp", "rosbagTimestamp", "Elapsed Time (s)", "stamp.secs"]


@pytest.mark.parametrize("name", [*TIMES, *MAYBE])
def test_a_time_in_a_csv_that_goes_back_begins_a_run(name, tmp_path) -> None:
    rows = [f"{0.1 * k:.3f},{1000 * run + k},1" for run in (0, 1) for k in range(50)]
    path = tmp_path / "own.csv"
    path.write_text("\n".join([f"{name},q,u", *rows]))
    own = load_own(path, Columns(["q"], ["u"], ["q"]))
    assert own.y[:, 0].tolist() == [1.0] * 98
    assert own.notes == f" 2 runs: column '{name}' goes back."
    path.write_text("\n".join([f"{name},q,u", *rows[::-1]]))
    own = load_own(path, Columns(["q"], ["u"], ["q"]))
    assert (f"'{name}' goes back in 98 of 100 rows, first in row 2" in own.notes) == (name in TIMES)


def test_each_time_in_a_csv_may_begin_a_run_and_what_only_sounds_like_one_does_not(tmp_path) -> None:
    """A log's time grows while the stamp of a simulation goes back after each eight rows; x_t swings."""
    rows = [(0.1 * (8 * r + k), 0.1 * k, k, 1000 * r + k, (-1) ** k) for r in range(12) for k in range(8)]
    path = tmp_path / "own.csv"
    table = "\n".join(",".join(f"{x:g}" for x in row) for row in rows)
    path.write_text(f"time,header.stamp,nanosec,q,x_t\n{table}")
    own = load_own(path, Columns(["q"], ["x_t"], ["q"]))
    assert own.y[:, 0].tolist() == [1.0] * 84
    assert own.notes == " 12 runs: column 'header.stamp' goes back."


@pytest.mark.parametrize("end", ["", ".csv", ".mcap", ".db3"])
def test_a_name_that_no_file_can_have_is_no_file(end: str) -> None:
    for name in ("n" * 300 + end, "n\0n" + end):
        with pytest.raises(DescriptionError):
            load_own(name, Columns(["q"], ["u"], ["q"]), clock="/u")
