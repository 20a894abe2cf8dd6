"""Twelve wrong wirings, each found before anything but motions of a few degrees, and named with its line."""

import dataclasses
import math
import re
import time
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch

from torch_ekm.description import load_hand, load_object
from torch_ekm.drivers import BusReading, HandDriver, Sighting, Wiring, WithPose
from torch_ekm.inspection import Check
from torch_ekm.inspection.check_plant import check_plant
from torch_ekm.kinematics import ActuationMap
from torch_ekm.plant import Observation, PlantStatus, PlantWrapper

DEG = math.pi / 180
HAND = load_hand("yale_t42")
TICKS = 4096 / (2 * math.pi)
TEXT = (
    '[hand]\ndriver = "bench"\ndescription = "yale_t42"\n[limits]\nstill_for = 0.01\nrate_deg = 600\n'
    + "".join(
        f'[[motors]]\nname = "{name}"\nid = {k + 1}\nsign = {1 - 2 * k}\nzero = {1000 + 900 * k}\n'
        for k, name in enumerate(HAND.actuator_names)
    )
    + "".join(
        f'[[joints]]\nname = "{name}"\nid = {k + 1}\nsign = {1 - 2 * (k % 2)}\nzero = {200 + 50 * k}\n'
        for k, name in enumerate(HAND.joint_names)
    )
)


class Bench(HandDriver):
    """A free T42 on a bench: what it really is stands in ``TEXT``; the driver believes another file."""

    def __init__(self, path: Path, true: Path) -> None:
        super().__init__(Wiring.read(path, "bench", TICKS, ()))
        self.true = Wiring.read(true, "bench", TICKS, ())
        self.a = torch.tensor([0.9, 0.7], dtype=torch.float64)
        self.map, self.draw = ActuationMap(HAND), torch.Generator().manual_seed(0)
        self.dead: dict[str, float] = {}
        self.farthest, self.dead_zone, self.noise = 0.0, 1.3 * DEG, 0.3 * DEG

    def _read(self) -> BusReading:
        now = time.monotonic()
        noise = self.noise * torch.randn(HAND.n_q, generator=self.draw, dtype=torch.float64)
        q = (self.map.joints(self.a) + noise).tolist()
        by_id = {one.id: one.bus(x) for one, x in zip(self.true.joints, q, strict=True)}
        motors = {one.id: one.bus(float(x)) for one, x in zip(self.true.motors, self.a, strict=True)}
        read = [self.dead.get(one.name, by_id[one.id]) for one in self.wiring.joints]
        return BusReading([motors[one.id] for one in self.wiring.motors], now, joints=read, joints_taken=now)

    def _write(self, goal: Sequence[float], seconds: float) -> None:
        by_id = {one.id: x for one, x in zip(self.wiring.motors, goal, strict=True)}
        wanted = torch.tensor([one.value(by_id[one.id]) for one in self.true.motors], dtype=torch.float64)
        way = wanted - self.a
        went = way - way.clamp(-self.dead_zone, self.dead_zone)  # servos stop short
        self.farthest = max(self.farthest, float(went.abs().max()))
        self.a = self.a + went

    def _release(self) -> None:
        pass


class Spoilt(PlantWrapper):
    """A driver of one's own that leaves something out."""

    def __init__(self, plant, change) -> None:
        super().__init__(plant)
        self.change = change

    def observation(self, seen: Observation) -> Observation:
        return self.change(seen)


M, J, R = '"right"\nid = 2\n', '"left_1"\nid = 2\n', '"right_0"\nid = 3'
SWAPPED = '"left"\nid = 2'
WRONG = {  # what is changed in the file; the row that names it; key and name in the line to change; words
    "motor's sign": (((M + "sign = -1", M + "sign = 1"),), "motor 'right'", "sign", "sign reversed"),
    "motor's unit": (((M, M + "per_rad = 11.378\n"),), "motor 'right'", "per_rad", "unit is degrees"),
    "motor's zero": ((("zero = 1900", "zero = 3948"),), "motor 'right'", "zero", "half a turn"),
    "swapped motors": (
        (('"left"\nid = 1', SWAPPED), (M, M.replace("2", "1"))), "motor 'left' and 'right'", "id", "swapped"),
    "joint's sign": (((J + "sign = -1", J + "sign = 1"),), "joint 'left_1'", "sign", "sign reversed"),
    "joint's unit": (((J, J + "per_rad = 11.378\n"),), "joint 'left_1'", "per_rad", "unit is degrees"),
    "joint's zero": ((("zero = 250", "zero = 2298"),), "joint 'left_1'", "zero", "half a turn"),
    "swapped joints": (
        ((J, J.replace("2", "3")), (R, R.replace("3", "2"))),
        "joint 'left_1' and 'right_0'", "id", "swapped"),
}  # fmt: skip


def bench(folder: Path, changes=()) -> Bench:
    paths, wrong = (folder / "wrong.toml", folder / "true.toml"), TEXT
    for old, new in changes:
        assert old in wrong
        wrong = wrong.replace(old, new)
    for path, text in zip(paths, (wrong, TEXT), strict=True):
        path.write_text(text)
    return Bench(*paths)


def errors(rows) -> list:
    return [row for row in rows if row.state == "error"]


def test_a_hand_that_is_wired_as_described_passes_and_goes_back(tmp_path) -> None:
    plant = bench(tmp_path)
    start = plant.a
    rows = check_plant(plant, HAND)
    assert not errors(rows)
    assert {"clock", "precision", "at rest", "wiring"} <= {row.name for row in rows}
    assert float((plant.a - start).abs().max()) < 1.5 * DEG


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_wiring_is_refused_with_the_line_to_change(name, tmp_path) -> None:
    changes, row, key, words = WRONG[name]
    plant = bench(tmp_path, changes)
    found = errors(check_plant(plant, HAND))
    assert [one.name for one in found][:1] == [row]
    assert words in found[0].found
    for number, which, named in re.findall(r"wrong.toml:(\d+): (\w+) of '(\w+)'", found[0].remedy):
        assert which == key
        lines = (tmp_path / "wrong.toml").read_text().splitlines()[: int(number)]
        assert lines[-1].startswith(f"{key} = ")
        assert [line for line in lines if line.startswith("name")][-1] == f'name = "{named}"'
        assert f"'{named}'" in row
    assert plant.farthest < 6 * DEG


@pytest.mark.parametrize(
    "names",
    [
        ("motor's sign", "motor's unit"),
        ("motor's unit", "swapped joints"),
        ("motor's zero", "joint's unit"),
        ("joint's unit", "joint's zero"),
    ],
)
def test_two_wrong_entries_are_named_together(names, tmp_path) -> None:
    wrong = [WRONG[name] for name in names]
    plant = bench(tmp_path, [change for one in wrong for change in one[0]])
    (row,) = errors(check_plant(plant, HAND))
    parts = row.found.split("; ")
    assert len(parts) == 2
    for part, (_, where, key, words) in zip(parts, wrong, strict=True):
        assert part.startswith(f"{where}: ")
        assert words in part
        assert f": {key} of '{where.split(chr(39))[1]}'" in row.remedy


def test_explanations_that_fit_alike_are_alternatives(tmp_path) -> None:
    names = "motor's sign", "joint's zero"
    found = errors(check_plant(bench(tmp_path, [one for name in names for one in WRONG[name][0]]), HAND))
    assert "joint 'left_1': zero" in found[0].found
    assert [row.found.startswith("or instead: ") for row in found] == [False, True]


def test_at_rest_a_swap_that_fits_is_always_listed_and_nothing_else_is_judged(tmp_path) -> None:
    q, exchanged = torch.tensor([-0.342, 1.184, -0.367, 0.845]), torch.tensor([0.445, 0.813])
    # a scale of a joint fits, too
    read = {"q": q.double(), "a": exchanged.double(), "status": PlantStatus.HELD}

    class Flipped(Spoilt):
        wiring = None  # a driver of one's own

        def observe(self) -> Observation:
            return dataclasses.replace(self.plant.observe(), **read)

    plant = Flipped(bench(tmp_path), lambda seen: seen)
    rows = check_plant(plant, load_hand("planar_two_finger"))
    found = errors(rows)
    assert ("motor 'left' and 'right'", "or instead: swapped") in {(row.name, row.found) for row in found}
    assert all(row.found.startswith("or instead: ") for row in found[1:])
    assert rows[-1].name == "motors"
    assert rows[-1].found.startswith("not moved")
    assert "pose" not in {row.name for row in rows}  # joints that are wrong put the pads elsewhere


@pytest.mark.parametrize("name", ["motor's sign", "motor's unit", "joint's sign", "swapped motors"])
def test_near_its_zeros_a_wrong_wiring_shows_in_the_first_small_motion(name, tmp_path) -> None:
    """At rest everything reads about 0 then, whatever the sign and the unit. With noise of 0.3 deg a joint's
    sign shows in 18 of 20 draws, with half of it in all."""
    plant = bench(tmp_path, WRONG[name][0])
    plant.noise = 0.15 * DEG
    plant.a = torch.tensor([0.02, 0.01], dtype=torch.float64)
    plant.dead_zone = 0.0
    found = errors(check_plant(plant, HAND))
    assert WRONG[name][1] in [one.name for one in found]
    assert plant.farthest < 6 * DEG


def test_a_dead_joint_sensor_and_a_dead_motor(tmp_path) -> None:
    plant = bench(tmp_path)
    plant.dead["left_1"] = plant.true.joints[1].bus(float(plant.map.joints(plant.a)[1]))
    found = errors(check_plant(plant, HAND))
    assert "joint 'left_1'" in [one.name for one in found]
    assert any("the same, bit by bit" in one.found and "wrong.toml:24" in one.remedy for one in found)
    plant = bench(tmp_path)
    plant.dead_zone = 10 * DEG
    found = errors(check_plant(plant, HAND))
    assert [one.found for one in found] == ["it does not move (4 deg commanded)"] * 2


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("row", "change"),
    [
        ("clock", lambda seen: dataclasses.replace(seen, time=0.0, stamps=None)),
        ("clock", lambda seen: dataclasses.replace(seen, time=5.0)),
        ("precision", lambda seen: dataclasses.replace(seen, q=seen.q.float())),
    ],
)
def test_a_clock_that_is_undated_or_stands_and_single_precision(row, change, tmp_path) -> None:
    found = errors(check_plant(Spoilt(bench(tmp_path), change), HAND))
    assert row in [one.name for one in found]


def test_a_pose_in_another_frame(tmp_path) -> None:
    plant = bench(tmp_path)
    eye = torch.eye(3, dtype=torch.float64)

    def by_camera() -> Sighting:
        return Sighting(torch.tensor([0.0, 0.0, 0.4], dtype=torch.float64), eye, time.monotonic())

    found = errors(check_plant(WithPose(plant, by_camera), HAND))
    assert [one.name for one in found] == ["pose"]
    assert "another frame" in found[0].found
    assert "WithPose(frame=" in found[0].remedy


def test_a_driver_of_ones_own_that_commands_the_wrong_way_or_in_degrees(tmp_path) -> None:
    class Own(PlantWrapper):
        factor = -1.0

        def command(self, delta_a):
            return super().command(self.factor * delta_a)

    plant = Own(bench(tmp_path))
    plant.plant.dead_zone = 0.0
    assert "sign of commands" in errors(check_plant(plant, HAND))[0].found
    Own.factor = 20.0
    assert "another unit" in errors(check_plant(plant, HAND))[0].found


@pytest.fixture
def inner():
    """A simulated hand that holds a can."""
    from torch_ekm.simulation import SimulatedHand

    inner = SimulatedHand("planar_two_finger", "can", preset="none")
    inner.reset(seed=0)
    yield inner
    inner.close()


def test_signs_of_a_held_object_by_its_pose(inner) -> None:
    """No joint has a sensor: the model says how the object moves."""
    hand, can = inner.hand, load_object("can")

    class Reversed(PlantWrapper):
        sign = torch.tensor([1.0, 1.0], dtype=torch.float64)

        def command(self, delta_a):
            self.a = getattr(self, "a", 0.0) + delta_a
            return self.observation(self.plant.command(self.sign * delta_a))

        def observation(self, seen):
            a = seen.a if float(self.sign.min()) > 0 else self.start + self.sign * (seen.a - self.start)
            return dataclasses.replace(seen, a=a, info={**seen.info, "sensed": ()})

    plant = Reversed(inner)
    plant.start = inner.observe().a
    assert not errors(check_plant(plant, hand, can))
    plant.sign = torch.tensor([1.0, -1.0], dtype=torch.float64)
    (found,) = errors(check_plant(plant, hand, can))
    assert found.name == f"motor '{hand.actuator_names[1]}'"
    assert "sign" in found.found


def test_the_command_checks_a_hand_on_a_bus(tmp_path) -> None:
    from dynamixel_bus import DynamixelBus
    from motors import Motors
    from typer.testing import CliRunner

    from torch_ekm.cli import app

    with DynamixelBus([1, 2], Motors([1600.0, 1500.0], 4000.0)) as bus:
        head = f'[hand]\ndriver = "dynamixel"\ndescription = "yale_t42"\n[bus]\nport = "{bus.port}"\n'
        text = (
            head.replace("[bus]", "[bus]\nbaud = 1000000")
            + TEXT[TEXT.index("[limits]") : TEXT.index("[[joints")]
        )
        path = tmp_path / "my_hand.toml"
        path.write_text(text)
        done = CliRunner().invoke(app, ["check", "--plant", str(path)])
        assert done.exit_code == 0, done.output
        assert "no sensors at the joints of left" in done.output
        assert "2 motors go as commanded; without" in done.output
        assert "and joints with them" not in done.output  # none has a sensor
        bus.catch_up()
        bus.goals.clear()
        done = CliRunner().invoke(app, ["check", "--plant", str(path), "--dry-run"])
        assert done.exit_code == 0, done.output
        assert done.output.count("dry run: ") == 2  # a motion of each motor
        assert "does not move" not in done.output
        bus.catch_up()
        assert bus.goals == []
        path.write_text(text.replace("zero = 1900", "zero = 4242"))
        done = CliRunner().invoke(app, ["check", "--plant", str(path)])
        assert done.exit_code == 1
        assert "my_hand.toml" in done.output
    done = CliRunner().invoke(app, ["check", "icub_right", "--plant", str(path)])
    assert "the wiring file names the hand" in str(done.exception)
    done = CliRunner().invoke(app, ["check"])
    assert "--plant" in str(done.exception)


def test_a_driver_that_follows_is_to_give_readings_on_the_way(tmp_path) -> None:
    plant = bench(tmp_path)

    def row() -> Check:
        return next(one for one in check_plant(plant, plant.hand) if one.name == "follow")

    assert row().state == "ok"
    assert int(re.search(r"(\d+) readings on the way", row().found)[1]) >= 1
    plant.follow = lambda path, watch: plant.observe()
    assert row().state == "warning"
    plant.follow = lambda path, watch: watch(None)
    assert row().state == "error"
    bare = OnlyTheContract(plant)
    assert not [one for one in check_plant(bare, plant.hand) if one.name == "follow"]


class OnlyTheContract:
    def __init__(self, plant: HandDriver) -> None:
        self.reset, self.observe, self.command = plant.reset, plant.observe, plant.command

    def close(self) -> None:
        pass


def test_a_transposed_rotation_of_a_held_object(inner) -> None:
    transposed = Spoilt(inner, lambda seen: dataclasses.replace(seen, rotation=seen.rotation.mT))
    for plant, state in ((inner, "ok"), (transposed, "warning")):
        rows = check_plant(plant, inner.hand, load_object("can"))
        (found,) = [row for row in rows if row.name == "pose's motions"]
        assert found.state == state
    assert "transposed" in found.remedy
