"""A hand that is fit passes; each fault ends in a row that names the part."""

import dataclasses
import functools
import math
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from own_files import change, copied
from typer.testing import CliRunner

from torch_ekm.cli import app
from torch_ekm.control import ClosedLoop
from torch_ekm.description import list_hands, load_hand, load_object
from torch_ekm.exceptions import GraspError
from torch_ekm.inspection import check as module
from torch_ekm.inspection.check import check_hand
from torch_ekm.plant import PlantStatus
from torch_ekm.simulation import SimulatedHand
from torch_ekm.simulation.grasp_planning import pinch

HAND = load_hand("planar_two_finger")
#: A turn of 3 deg is enough for its row to be ok; to its very end one test below follows it.
SMALL_TURNS = functools.partialmethod(ClosedLoop.reach, limit=math.radians(5.0))


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    return copied(tmp_path)


@pytest.fixture
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """One first guess of the planner, one pinch with faults, no trials, small turns: most
    rows need no more."""
    monkeypatch.setattr(pinch, "_GUESSES", 1)
    monkeypatch.setattr(ClosedLoop, "reach", SMALL_TURNS)
    monkeypatch.setattr(module, "_DISTURBED", 1)
    monkeypatch.setattr(module, "smallest_changes", lambda *_: [])


@pytest.mark.parametrize("name", list_hands())
def test_the_hands_of_the_package_pass(name, tmp_path, monkeypatch):
    drawn = name == "icub_right"  # in a process of its own, which takes as long as the rest
    monkeypatch.setattr(ClosedLoop, "reach", SMALL_TURNS)
    if name != "planar_two_finger":
        monkeypatch.setattr(module, "_DISTURBED", 1)
    rows = check_hand(name, picture=tmp_path / "check.png" if drawn else None)
    assert [row for row in rows if row.state != "ok"] == []
    assert not drawn or (tmp_path / "check.png").stat().st_size > 5000
    assert sum(row.name.startswith("pad ") for row in rows) == len(load_hand(name).pads)
    assert {"tendon", "opposed", "pinch", "stability"} <= {row.name.split()[0] for row in rows}


_CAPSULE = (
    '<collision><origin xyz="0.015 0 0" rpy="0 1.57079632679 0"/><geometry><cylinder radius="0.006" '
    'length="0.03"/></geometry></collision>'
)
_BOX = '<collision><origin xyz="0.015 0 0"/><geometry><box size="0.042 0.012 0.016"/></geometry></collision>'
SPRING, OPPOSED = "spring = 0.2, rest_deg = ", "opposed pads"
FAULTS = {  # what is changed (0: URDF, 1: transmission file); name, state and text of a row
    "pad away": (1, "[0.0, -1.0, 0.0]", "[0.0, 1.0, 0.0]", "pad 'left'", "error", "away.*'left_1' closes"),
    "pad sideways": (1, "[0.0, -1.0, 0.0]", "[0.0, 0.0, 1.0]", "pad 'left'", "error", "no joint moves it"),
    "pad off its link": (1, "radius = 0.006", "radius = 0.009", "pad 'left'", "warning", "not the shape"),
    "pad in a box": (0, _CAPSULE, _BOX, "pad 'left'", "warning", "in a box, whose edges touch"),
    "limits": (0, 'upper="1.5"', 'upper="0.02"', "pinch plan", "error", "is to blame"),
    "no limits": (0, 'left_0" type="revolute"', 'left_0" type="continuous"', OPPOSED, "error", "left_0"),
    "axis": (0, '<axis xyz="0 0 -1"/>', '<axis xyz="0 0.1 -1"/>', "hand's files", "error", "planar_normal"),
    "never taut": (1, SPRING + "0", SPRING + "160", "tendon 'left'", "error", "slack"),
    "late": (1, SPRING + "0", SPRING + "100", "tendon 'left'", "warning", "from 100 deg"),
    "one pad": (1, '[[pads]]\nname = "left"', '[[pads]]\nname = "left"', OPPOSED, "error", "two"),
    "unreadable": (0, "<robot", "<robot <", "hand's files", "error", "not well-formed XML"),
    "rigid": (1, "stiffness = 10.0", "", "actuators", "warning", "left 100"),
}  # fmt: skip


#: Their rows come before the pinch, which other tests plan with springs and actuators like theirs.
NO_PINCH = ("never taut", "late", "rigid")


@pytest.mark.usefixtures("brief")
@pytest.mark.parametrize("fault", list(FAULTS))
def test_each_fault_has_its_row(fault, files, monkeypatch):
    if fault in NO_PINCH:
        monkeypatch.setattr(module, "_pinch", lambda *_: [module.Check("pinch", "error", "not tried")])
    which, old, new, name, state, text = FAULTS[fault]
    change(files[which], old, new, -1 if fault == "limits" else 1)
    if fault == "one pad":
        content = files[which].read_text()
        files[which].write_text(content[: content.rindex("[[pads]]")])
    rows = [row for row in check_hand(str(files[0])) if row.name == name]
    assert [row.state for row in rows] == [state]
    assert re.search(text, rows[0].found)
    assert bool(rows[0].remedy) == (state != "ok")


def test_a_pad_that_the_urdf_lacks_is_printed_to_be_pasted(files, monkeypatch):
    urdf, transmission = files
    change(transmission, "radius = 0.006", "radius = 0.009")
    rows = list(module._pads(load_hand(urdf)))
    (row,) = [row for row in rows if row.state != "ok"]
    pasted = row.remedy[row.remedy.index("<collision>") :]
    link = f'<link name="{load_hand(urdf).pads[0].link}">'
    text = re.sub(r"<collision>.*?</collision>", "", urdf.read_text(), flags=re.DOTALL)
    urdf.write_text(text.replace(link, link + pasted))
    assert next(module._pads(load_hand(urdf))).state == "ok"
    monkeypatch.setattr(module, "check_hand", lambda *_: rows)
    assert pasted in CliRunner().invoke(app, ["check", str(urdf)]).output.splitlines()  # on one line


UNITS = {"rad": ("range_deg", "range"), "m": ("left_0 = 1.0, left_1 = 0.8", "left_0 = 0.010, left_1 = 0.008")}


@pytest.mark.parametrize("unit", UNITS)
def test_ranges_and_moment_arms_in_another_unit_are_named(unit, files):
    urdf, transmission = files
    assert not list(module._ranges(load_hand(urdf)))
    change(transmission, *UNITS[unit])
    (row,) = module._ranges(load_hand(urdf))
    assert (row.name, row.state) == ("range of 'left'", "warning")
    assert "are ratios of radii" in row.remedy


def test_a_grasp_width_that_is_not_the_objects_is_named():
    can = load_object("can")
    assert not list(module._width(can))
    (row,) = module._width(dataclasses.replace(can, grasp_width=0.02))
    assert row.found.startswith("half of grasp_width = 0.02 m is 10 mm off")


@pytest.mark.usefixtures("brief")
def test_where_the_files_have_a_fault_no_other_figure_is_tried(files, monkeypatch):
    tried = []
    monkeypatch.setattr(module, "_cured", lambda *of: tried.append(of) or ())
    monkeypatch.setattr(module, "_pinch", lambda *_: [module.Check("pinch plan", "error", "not tried")])
    urdf, transmission = files
    assert "collision shapes" not in {row.name for row in check_hand(str(urdf), "can")}
    assert len(tried) == 1
    change(transmission, "radius = 0.006", "radius = 0.009")
    (row,) = [row for row in check_hand(str(urdf), "can") if row.name == "collision shapes"]
    assert "paste the shapes of pad 'left'" in row.remedy
    assert len(tried) == 1
    change(transmission, "radius = 0.009", "radius = 0.006")
    change(transmission, "[0.0, -1.0, 0.0]", "[0.0, 1.0, 0.0]")
    check_hand(str(urdf), "can")
    assert len(tried) == 1


def test_which_pad_opposes_which_is_said():
    (row,) = module._reach(load_hand("icub_right"), load_object("box"))
    assert row.found == "pad thumb opposes index and middle"


def test_a_xacro_file_is_told_which_command_comes_first(tmp_path):
    (row,) = check_hand(str(tmp_path / "my.urdf.xacro"))
    assert row.found.endswith(f"xacro {tmp_path}/my.urdf.xacro > {tmp_path}/my.urdf")


@pytest.mark.usefixtures("brief")
def test_a_pad_that_holds_with_its_back_is_told(monkeypatch):
    lower, upper = HAND.joint_lower.copy(), HAND.joint_upper.copy()
    lower[0], upper[0], upper[1] = -0.5, 0.0, 0.4
    left = dataclasses.replace(HAND.actuators[0], lower=-0.5)
    hand = dataclasses.replace(
        HAND, joint_lower=lower, joint_upper=upper, actuators=(left, *HAND.actuators[1:])
    )
    monkeypatch.setattr(module, "load_hand", lambda _: hand)
    rows = {row.name: row for row in check_hand("mine")}
    assert rows["contact sides"].state == rows["model"].state == "error"
    assert "'right'" in rows["contact sides"].found


@pytest.mark.parametrize(("most", "state"), [(3.4, "ok"), (2.6, "warning")])
def test_a_pinch_that_turns_little_is_told(most, state, monkeypatch):
    """At least 3 deg either way."""
    monkeypatch.setattr(module, "_LITTLE_TURN", math.radians(3.0))
    turns = {-1: -math.radians(9.0), 1: math.radians(most)}
    monkeypatch.setattr(ClosedLoop, "reach", lambda _, sign: SimpleNamespace(angle=turns[sign], end="end"))
    (row,) = module._turn(HAND, load_object("can"))
    assert (row.state, row.found) == (state, "predicted: -9 deg (end), +3 deg (end)")
    few = "the motors come 8 % of the way: choose another"
    monkeypatch.setattr(module, "out_of_reach", lambda *_: few)
    (row,) = module._turn(HAND, load_object("can"))
    told = "predicted: -9 deg (end), +3 deg (end)"
    told += "; the motors come 8 % of the way" if state == "warning" else ""
    assert (row.state, row.found) == (state, told)


@pytest.mark.usefixtures("brief")
def test_springs_too_soft_for_the_usual_force_are_told_what_holds(monkeypatch):
    """Which changes those are: tests/simulation/test_simulation_trials.py."""
    hand = dataclasses.replace(HAND, spring_stiffness=HAND.spring_stiffness / 4)

    changes, drawn = ["a pinch_force of 1.2 N", "springs 2.0 times as stiff"], []
    monkeypatch.setattr(module, "load_hand", lambda _: hand)
    monkeypatch.setattr(module, "smallest_changes", lambda *_: changes)
    monkeypatch.setattr(module, "save_picture", lambda scene, path: drawn.append(scene) or path)
    rows = {row.name: row for row in check_hand("mine", "can", Path("check.png"))}
    assert rows["opposed pads"].state == "ok"
    assert "the fingertips reach it; torque is to blame: joint" in rows["pinch plan"].found
    assert (
        rows["smallest change"].found
        == "the pinch holds with a pinch_force of 1.2 N; or springs 2.0 times as stiff"
    )
    seen = [shape.kind for shape, _ in drawn[-1].shapes[-drawn[-1].ghosts :]]
    assert seen == ["cylinder"]  # the can, seen through


def test_a_planned_pinch_that_is_lost_is_told_with_forces_and_distance(monkeypatch):
    monkeypatch.setattr(SimulatedHand, "status", PlantStatus.LOST)
    (row,) = module._pinch(HAND, load_object("can"), None)
    assert row.state == "error"
    assert re.search(r"s after closing: forces \[N\] left \d.*, right \d.*, the object \d+ mm off", row.found)


@pytest.mark.usefixtures("brief")
def test_a_pinch_that_the_usual_faults_break_is_told(monkeypatch):
    def hand(*args, preset="none", **options):
        if preset == "nominal":
            raise GraspError("it slips")
        return SimulatedHand(*args, preset=preset, **options)

    monkeypatch.setattr(module, "SimulatedHand", hand)
    rows = {row.name: row for row in check_hand("planar_two_finger", "can")}
    assert (rows["pinch"].state, rows["pinch, preset nominal"].state) == ("ok", "warning")
    assert "it slips" in rows["pinch, preset nominal"].found


@pytest.mark.usefixtures("brief")
def test_rigid_actuators_that_contradict_each_other_are_told(monkeypatch):
    hand = load_hand("icub_right")
    rigid = tuple(dataclasses.replace(actuator, stiffness=float("inf")) for actuator in hand.actuators)
    hand = dataclasses.replace(hand, actuators=rigid)
    monkeypatch.setattr(module, "load_hand", lambda _: hand)
    rows = {row.name: row for row in check_hand("mine")}
    assert "thumb_distal 100" in rows["actuators"].found
    assert rows["actuators in the pinch"].state == "warning"


@pytest.mark.usefixtures("brief")
def test_command_line(files, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "save_picture", lambda scene, path: path)
    runner = CliRunner()
    picture = ["--picture", str(tmp_path / "check.png")]
    done = runner.invoke(app, ["check", "planar_two_finger", "can", *picture])
    assert done.exit_code == 0, done.output
    assert "friction margins" in done.output
    files[0].write_text("nothing")
    for arguments in ([str(files[0])], ["planar_two_finger", "banana"], ["banana"]):
        done = runner.invoke(app, ["check", *arguments, *picture])
        assert done.exit_code == 1
        assert "error" in done.output
