"""From a bus to a wiring file that a check passes, and without one; zeros of tendons; figures of servos."""

import math
import random
import re
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("dynamixel_sdk")
pytest.importorskip("typer")

from dynamixel_bus import DynamixelBus
from motors import Motors
from typer.testing import CliRunner

from torch_ekm.cli import app, main
from torch_ekm.control import HandKnowledge
from torch_ekm.drivers import DynamixelPlant, Wiring
from torch_ekm.exceptions import BusError, DescriptionError, DeviceError
from torch_ekm.inspection.identify_servo import identify_servo
from torch_ekm.inspection.new_wiring import new_wiring
from torch_ekm.inspection.slack import Taut, find_slack, write_zeros

DEG = math.pi / 180
TICKS = 4096 / (2 * math.pi)
TEXT = """\
[hand]
driver = "dynamixel"
description = "yale_t42"
[bus]
port = "PORT"
baud = 1000000
[[motors]]
name = "left"
id = 1
zero = 300   # as guessed
[[motors]]
name = "right"
id = 2
sign = -1
[limits]
rate_deg = 600
still_for = 0.01
"""
TAUT = (1300.0, 2700.0)  # ticks


class Sticky(Motors):
    """Motors with a dead zone and a bias [ticks]."""

    def __init__(self, start: Sequence[float], dead: float, bias: float) -> None:
        super().__init__(start, 40000.0)
        self.dead, self.bias = dead, bias

    def send(self, goal: Sequence[float]) -> None:
        now = self.now()
        way = [to - at + (self.bias if to != at else 0) for to, at in zip(goal, now, strict=True)]
        super().send([at + x - min(max(x, -self.dead), self.dead) for at, x in zip(now, way, strict=True)])


@pytest.fixture
def bus(monkeypatch):
    monkeypatch.setattr("torch_ekm.drivers.dynamixel_port._PATIENCE_MS", 2000.0)  # the machine may be busy
    with DynamixelBus([1, 2], Motors([1150.0, 2850.0], 40000.0)) as bus:
        noise = random.Random(0)
        bus.currents = lambda ticks: [
            sign * (7 + 0.4 * max(0.0, sign * (at - taut))) + noise.uniform(-1, 1)
            for at, taut, sign in zip(ticks, TAUT, (1, -1), strict=True)
        ]
        yield bus


def wired(bus: DynamixelBus, folder: Path) -> Path:
    path = folder / "hand.toml"
    path.write_text(TEXT.replace("PORT", bus.port))
    return path


def run(monkeypatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["torch-ekm", *arguments])
    with pytest.raises(SystemExit) as end:
        main()
    return end.value.code


def test_slack_finds_the_zeros_and_writes_them(bus, tmp_path, monkeypatch, capsys) -> None:
    path = wired(bus, tmp_path)
    assert run(monkeypatch, "slack", "--plant", str(path), "--write") == 0
    with DynamixelPlant(path) as plant:
        zeros = [one.zero for one in plant.wiring.motors]
    assert zeros == pytest.approx(TAUT, abs=4)  # ticks of 0.09 deg
    text = path.read_text()
    assert "# as guessed" in text
    assert text.splitlines()[-len(TEXT.splitlines()[10:]) :].count("[limits]") == 1
    assert f"{path}:10: left: zero = " in capsys.readouterr().out
    assert bus.motors.now() == pytest.approx([1150.0, 2850.0], abs=2)  # each went back
    farthest = [max(goal[0] for goal in bus.goals), min(goal[1] for goal in bus.goals)]
    assert farthest == pytest.approx(TAUT, abs=12 * DEG * TICKS)


def test_slack_names_what_keeps_it_from_finding_a_zero(bus, tmp_path) -> None:
    with DynamixelPlant(wired(bus, tmp_path)) as plant:
        given = plant.wiring
        taut, bus.currents = bus.currents, lambda ticks: [0.0, 0.0]
        plant.wiring = _ranges(given, 12 * DEG)
        with pytest.raises(DeviceError, match=r"motor 'left': closed by all of its range"):
            find_slack(plant)
        bus.currents, bus.motors = taut, Motors([1310.0, 2850.0], 40000.0)
        plant.wiring = given
        with pytest.raises(DeviceError, match=r"motor 'left': its load rises from the start"):
            find_slack(plant)
        assert plant.wiring is given
        with pytest.raises(DescriptionError, match=r"no \[\[motors\]\] table of 'thumb'"):
            write_zeros(given, [Taut("thumb", 1.0, 0.1)])


def _ranges(wiring: Wiring, upper: float) -> Wiring:
    """From where the motors stand to ``upper`` [rad]."""
    at = zip(wiring.motors, (1150.0, 2850.0), strict=True)
    return replace(wiring, motors=tuple(replace(one, zero=x, lower=0.0, upper=upper) for one, x in at))


def test_identify_servo_over_the_bus(bus, tmp_path, monkeypatch, capsys) -> None:
    bus.motors = Sticky([1150.0, 2850.0], dead=8.0, bias=3.0)
    path, out = wired(bus, tmp_path), tmp_path / "hand.ekm"
    path.write_text(path.read_text().replace("sign = -1", "sign = -1\nzero = 2700"))
    assert run(monkeypatch, "identify-servo", "--plant", str(path), "--out", str(out)) == 0
    servo = HandKnowledge.load(out).servo
    assert servo.dead_zone.tolist() == pytest.approx([8 / TICKS] * 2, abs=0.06 * DEG)
    assert servo.bias.tolist() == pytest.approx([3 / TICKS, -3 / TICKS], abs=0.06 * DEG)
    said = capsys.readouterr().out
    assert "left: d=0.7" in said


def test_a_motor_that_stands_still_is_named(bus, tmp_path) -> None:
    bus.motors = Sticky([1150.0, 2850.0], dead=4000.0, bias=0.0)
    with DynamixelPlant(wired(bus, tmp_path)) as plant:
        plant.wiring = _ranges(plant.wiring, 3.0)
        with pytest.raises(DeviceError, match=r"motor 'left': does not move by commands of 2 deg"):
            identify_servo(plant)
        with pytest.raises(DeviceError, match=r"motor 'left': does not move, and its load does not rise"):
            find_slack(plant)


PAGES = Path(__file__).parents[2] / "docs" / "how_to"


@pytest.fixture
def scanned():
    with DynamixelBus([3, 7], Motors([2300.0, 700.0], 4000.0), 1240) as bus:
        yield bus


def test_a_scanned_bus_becomes_a_wiring_that_moves_the_hand(scanned, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("torch_ekm.drivers.dynamixel_port._PATIENCE_MS", 2000.0)  # the machine may be busy
    path = tmp_path / "my_hand.toml"
    words = ["drivers", "yale_t42", "--new", str(path), "--port", scanned.port, "--baud", "1000000"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    text = path.read_text()
    assert text.count("# XC330-M288, firmware 46") == 2
    assert "they allow 2352" in text
    assert re.findall(r"^id = (\d+)$", text, re.MULTILINE) == ["3", "7"]
    assert scanned.goals == []
    assert scanned.get(3, "torque") == 0
    done = CliRunner().invoke(app, ["check", "--plant", str(path)])
    assert done.exit_code == 0, done.output
    assert "2 motors go as commanded" in done.output
    done = CliRunner().invoke(app, words)
    assert "a file that does not exist yet" in str(done.exception)


def test_what_answers_is_named_where_it_is_another_hand(scanned) -> None:
    problem = r"2 servos answer at 57600 baud \(id 3: XC330-M288, id 7: XC330-M288\); icub_right has 9 act"
    with pytest.raises(BusError, match=problem):
        new_wiring(scanned.port, "icub_right")
    scanned.silent = {3, 7}
    with pytest.raises(BusError, match=r"no servo answers at 1000000 baud"):
        new_wiring(scanned.port, "yale_t42", (1000000,))


@pytest.mark.parametrize("driver", ["yarp", "ros2"])
def test_a_wiring_is_tried_without_its_bus(driver, tmp_path) -> None:
    page = (PAGES / "drive_over_yarp_or_ros2.md").read_text(encoding="utf-8")
    (text,) = (x for x in re.findall(r"```toml\n(.*?)```", page, re.DOTALL) if f'driver = "{driver}"' in x)
    path = tmp_path / "hand.toml"
    path.write_text(text.replace("rate_deg = 30", "rate_deg = 300\nstill_for = 0.02"))
    done = CliRunner().invoke(app, ["check", "--plant", str(path), "--emulate"])
    assert done.exit_code == 0, done.output
    assert "motors go as commanded" in done.output
    assert "nothing is connected" in done.output  # and what is not checked
    done = CliRunner().invoke(app, ["check", "--plant", str(path), "--emulate", "--dry-run"])
    unit = {"yarp": "deg", "ros2": "rad"}[driver]
    assert f" {unit} = " in done.output


@pytest.mark.parametrize("change", ['zero =|"zero" =', "as guessed|as\u2028guessed", "\n|\r\n"])
def test_zeros_are_written_where_they_stand_whoever_wrote_the_file(change: str, tmp_path) -> None:
    path, (old, new) = tmp_path / "own.toml", change.split("|")
    path.write_bytes(TEXT.replace("PORT", "none").replace(old, new).encode())
    n = path.read_bytes().count(b"\r\n")
    given = DynamixelPlant.wired(path)
    write_zeros(given, [Taut(one.name, 1234.0, 0.1) for one in given.motors])
    assert [one.zero for one in DynamixelPlant.wired(path).motors] == [1234.0] * len(given.motors)
    assert path.read_bytes().count(b"\r\n") == n
