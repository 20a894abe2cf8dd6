"""From a bus to a wiring file that a check passes; and the same without a bus."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

pytest.importorskip("typer", reason="extra 'plots'")

from typer.testing import CliRunner

from torch_ekm.cli import app
from torch_ekm.exceptions import BusError
from torch_ekm.inspection.new_wiring import new_wiring

PAGES = Path(__file__).parents[2] / "docs" / "how_to"


@pytest.fixture
def bus():
    pytest.importorskip("dynamixel_sdk")
    from dynamixel_bus import DynamixelBus
    from motors import Motors

    with DynamixelBus([3, 7], Motors([2300.0, 700.0], 4000.0), 1240) as bus:
        yield bus


@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo terminals")
def test_a_scanned_bus_becomes_a_wiring_that_moves_the_hand(bus, tmp_path) -> None:
    path = tmp_path / "my_hand.toml"
    words = ["drivers", "yale_t42", "--new", str(path), "--port", bus.port, "--baud", "1000000"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    text = path.read_text()
    assert text.count("# XC330-M288, firmware 46") == 2
    assert "they allow 2352" in text
    assert re.findall(r"^id = (\d+)$", text, re.MULTILINE) == ["3", "7"]
    assert bus.goals == []
    assert bus.get(3, "torque") == 0
    done = CliRunner().invoke(app, ["check", "--plant", str(path)])
    assert done.exit_code == 0, done.output
    assert "2 motors go as commanded" in done.output
    done = CliRunner().invoke(app, words)
    assert "a file that does not exist yet" in str(done.exception)


def test_what_answers_is_named_where_it_is_another_hand(bus) -> None:
    problem = r"2 servos answer at 57600 baud \(id 3: XC330-M288, id 7: XC330-M288\); icub_right has 9 act"
    with pytest.raises(BusError, match=problem):
        new_wiring(bus.port, "icub_right")
    bus.silent = {3, 7}
    with pytest.raises(BusError, match=r"no servo answers at 1000000 baud"):
        new_wiring(bus.port, "yale_t42", (1000000,))


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
