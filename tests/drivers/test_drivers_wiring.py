"""A wiring file is read in the description's order, and every mistake in it is named with its line."""

import math
import re
from pathlib import Path

import pytest
from wirings import T42, write

from torch_ekm.drivers import Channel, Limits, Wiring, open_driver
from torch_ekm.exceptions import DescriptionError, ParameterError, UnknownNameError

THUMB = '\n[[joints]]\nname = "thumb"\nid = 7\n\n'
JOINT = '\n[[joints]]\nname = "left_1"\nid = 7\nsign = -1\nzero = 10\nper_rad = 50\n'


def read(path: Path) -> Wiring:
    return Wiring.read(path, "dynamixel", 100.0, ("port", "baud"))


def test_channels_are_in_the_order_of_the_description(tmp_path) -> None:
    wiring = read(write(tmp_path, T42 + JOINT))
    assert [one.name for one in wiring.motors] == list(wiring.hand.actuator_names) == ["left", "right"]
    left, right = wiring.motors
    assert (left.id, left.zero, left.sign, left.per_unit) == (1, 1000.0, 1, 100.0)
    assert right.value(2950.0) == pytest.approx(0.5)
    assert right.bus(0.5) == pytest.approx(2950.0)
    assert left.lower == pytest.approx(math.radians(-68.6))
    assert wiring.joints == (Channel("left_1", 7, -1, 10.0, 50.0),)
    assert wiring.limits == Limits(math.radians(20), math.radians(200), still_for=0.05, timeout=0.5)
    assert wiring.line("motors", "right", "sign") == 12
    assert wiring.line("motors", "left", "sign") == 15  # not given: where the motor begins


def test_places_in_a_message_are_numbers_or_texts(tmp_path) -> None:
    text = T42 + '[[fingertips]]\nname = "left"\nid = 1\n[[fingertips]]\nname = "right"\nid = "0"\n'
    text = text.replace("id = 2", 'id = "2"')
    wiring = Wiring.read(write(tmp_path, text), "dynamixel", 100.0, ("port", "baud"), named=True)
    assert [one.id for one in (*wiring.motors, *wiring.fingertips)] == ["1", "2", "1", "0"]


FAULTS = {  # what is changed; line, words
    "unknown key": ("sign = -1|sing = -1", 12, "unknown key 'sing'; valid keys are: name, id"),
    "unknown table": ("[limits]|[limit]", 20, "unknown key 'limit'"),
    "key of another bus": ("baud =|speed =", 7, "unknown key 'speed'"),
    "two motors with one id": ("id = 1|id = 2", 17, "'left': id 2 is that of 'right', line 9"),
    "one motor twice": ('name = "left"|name = "right"', 16, "name 'right' is that of line 9"),
    "no such motor": ('name = "left"|name = "lift"', 16, "no 'lift'; it has: left, right"),
    "no such joint": (f"[limits]|{THUMB}[limits]", 22, "no 'thumb'; it has: left_0"),
    "range turned round": ("id = 1|id = 1\nrange_deg = [90, 10]", 18, "turned round or empty, 90 to 10 deg"),
    "range too wide": ("id = 1|id = 1\nrange_deg = [-90, 10]", 18, "the description allows -68.6 to 191 deg"),
    "sign": ("sign = -1|sign = 2", 12, "must be 1 or -1, got 2"),
    "no id": ("id = 1\n|", 15, "the key 'id' is missing"),
    "id of half": ("id = 1|id = 1.5", 17, "whole number"),
    "negative rate": ("rate_deg = 200|rate_deg = -1", 22, "must be positive"),
    "limit in deg": ("increment_deg = 20|increment = 20", 21, "must be at most 3.14 rad, got 20"),
    "rest in deg": ("rate_deg = 200|still = 0.2", 22, "'still' must be at most 0.1 rad"),
    "rest in ms": ("still_for = 0.05|still_for = 50", 23, "'still_for' must be at most 10 s, got 50"),
    "period in ms": ("rate_deg = 200|period = 20", 22, "'period' must be at most 2 s, got 20"),
    "text for a number": ("zero = 1000|zero = '1000'", 18, "must be a finite number"),
    "no such hand": ('"yale_t42"|"yale_t43"', 3, "unknown hand 'yale_t43'; valid are: icub_right"),
    "another driver": ('"dynamixel"|"yarp"', 2, "this is the driver 'dynamixel'"),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_a_mistake_is_named_with_file_and_line(name, tmp_path) -> None:
    change, line, words = FAULTS[name]
    path = write(tmp_path, change=change)
    with pytest.raises(DescriptionError, match=re.escape(words)) as error:
        read(path)
    assert str(error.value).startswith(f"{path}:{line}: ")


def test_a_motor_that_is_missing_and_a_file_that_is_not_there(tmp_path) -> None:
    text = T42[: T42.index('[[motors]]\nname = "left"')]
    with pytest.raises(DescriptionError, match=r"\[\[motors\]\]: there is none for left"):
        read(write(tmp_path, text))
    with pytest.raises(DescriptionError, match="no such wiring file"):
        read(tmp_path / "none.toml")
    with pytest.raises(UnknownNameError, match="unknown driver 'mine'; valid are: dynamixel, ros2, yarp"):
        open_driver(write(tmp_path, change='"dynamixel"|"mine"'))
    with pytest.raises(ParameterError, match="rate"):
        Limits(rate=0.0)


def test_an_mjcf_next_to_the_file_is_its_hand(tmp_path) -> None:
    (tmp_path / "hand.xml").write_text("<mujoco><worldbody/></mujoco>")
    with pytest.raises(
        DescriptionError, match=re.escape(str(tmp_path / "hand."))
    ):  # found, and without joints
        read(write(tmp_path, T42.replace("yale_t42", "hand.xml")))
