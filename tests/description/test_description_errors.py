"""Wrong files: each error is typed, names the file and the place, and says what would be right."""

import contextlib
import datetime
import re
import tempfile
import tomllib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from own_files import change, copied

from torch_ekm.description import load_hand, load_object
from torch_ekm.description.transmission_file import document
from torch_ekm.exceptions import DescriptionError, EKMError, JointMismatchError


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    return copied(tmp_path)


URDF_FAULTS = {
    "malformed": ('<robot name="planar_two_finger">', "<robot", "not well-formed XML"),
    "not a robot": ("robot", "world", "root element must be <robot>, found <world>"),
    "limits": ('lower="-0.5" upper="1.5"', 'lower="1.5" upper="-0.5"', "joint 'left_0'.*limits reversed"),
    "nan": ('lower="-0.5"', 'lower="nan"', "'left_0', limit: 'lower' must be a finite number, got 'nan'"),
    "two numbers": ('xyz="-0.03 0 0"', 'xyz="-0.03 0"', "must be three numbers, got '-0.03 0'"),
    "no limit": ("<limit ", "<bounds ", "joint 'left_0': <joint> needs a <limit>"),
    "type": ('type="revolute"', 'type="screw"', "type 'screw' is not supported; supported: revolute"),
    "no inertia": ('ixx="', 'mxx="', "link 'hand', inertial, inertia: .* the attribute 'ixx'"),
    "no parent": ('<parent link="hand"/>', "", "joint 'left_0': <joint> needs a <parent>"),
    "no name": ('<link name="left_tip"/>', "<link/>", "a <link> has no name"),
    "no shape": ("<cylinder ", "<tube ", "<geometry> needs one of box, cylinder, sphere, capsule, mesh"),
    "zero axis": ('<axis xyz="0 0 -1"/>', '<axis xyz="0 0 0"/>', "axis must not be zero"),
    "mass": ('mass value="0.1"', 'mass value="-0.1"', "link 'hand': the mass must not be negative"),
    "size": ('<cylinder radius="0.006"', '<cylinder radius="0"', "size of a cylinder must be positive"),
    "unknown parent": ('<parent link="hand"/>', '<parent link="wrist"/>', "unknown link 'wrist'; .*: hand"),
    "loop": ('<parent link="hand"/>', '<parent link="left_tip"/>', "one tree"),
    "macro": ('<link name="left_tip"/>', '<x:f xmlns:x="http://ros.org/xacro"/>', "macros; run first: xacro"),
    "macro without a name": ('<link name="left_tip"/>', "<xacro:f/>", "unbound.*; .* run first: xacro"),
    "twice": ('<link name="left_tip"/>', '<link name="hand"/>', "repeated: hand"),
}
EVERYWHERE = ("not a robot", "size", "no shape")  # replaced at each place, not only at the first


@pytest.mark.parametrize("fault", list(URDF_FAULTS))
def test_urdf_faults(fault: str, files: tuple[Path, Path]) -> None:
    old, new, message = URDF_FAULTS[fault]
    urdf, _ = files
    change(urdf, old, new, -1 if fault in EVERYWHERE else 1)
    with pytest.raises(DescriptionError, match=message) as caught:
        load_hand(urdf)
    assert str(urdf) in str(caught.value)


TRANSMISSION_FAULTS = {
    "malformed": ("[hand]", "[hand", "not well-formed TOML"),
    "unknown key": ("tendon = true", "tendons = true", r"\[\[actuators\]\] 'left': unknown key 'tendons'; v"),
    "unknown table": ("[hand]", "[hands]", "unknown key 'hands'"),
    "couplings of none": ("[hand]", "couplings = 3\n[hand]", r"'couplings' must be written as \[\[coup"),
    "not a bool": ("tendon = true", "tendon = 1", "'tendon' must be true or false, got 1"),
    "nan": ("stiffness = 10.0", "stiffness = nan", "'stiffness' must be a finite number, got nan"),
    "negative": ("stiffness = 10.0", "stiffness = -1.0", "'stiffness' must be positive"),
    "negative spring": ("spring = 0.2", "spring = -0.2", "joints.* left_0: 'spring' must be at least 0"),
    "reversed": ("range_deg = [0.0, 150.0]", "range_deg = [150.0, 0.0]", "range reversed"),
    "both units": ("range_deg = [0.0, 150.0]", "range_deg = [0.0, 150.0]\nrange = [0.0, 1.0]", "not both"),
    "three": ("range_deg = [0.0, 150.0]", "range_deg = [0.0, 1.0, 2.0]", "list of 2 numbers"),
    "no range": ("range_deg = [0.0, 150.0]", "", "the key 'range' is missing"),
    "no arms": ("moment_arms = { left_0 = 1.0, left_1 = 0.8 }", "", "'moment_arms' is missing"),
    "rank": (
        "moment_arms = { left_0 = 1.0, left_1 = 0.8 }",
        "moment_arms = { right_0 = 2.0, right_1 = 1.6 }",
        "independent: .* nothing of their own: left, right",
    ),
    "motor twice": ('name = "right"\nrange', 'name = "left"\nrange', "each actuator must be unique.*: left"),
    "pad link": ('link = "left_1"', 'link = "left_9"', "unknown link 'left_9'; the URDF's links are: hand"),
    "pad radius": ("radius = 0.006", "radius = 0.0", "'radius' must be positive"),
    "pad twice": ('name = "right"\nlink', 'name = "left"\nlink', "each pad must be unique, repeated: left"),
    "base": ('base_link = "hand"', 'base_link = "left_1"', "'left_1' carries no revolute"),
    "no pinch": (
        'base_link = "hand"',
        'base_link = "hand"\npinch_force = 0',
        "'pinch_force' must be positive",
    ),
    "no base": ('base_link = "hand"', 'base_link = "palm"', "unknown base_link 'palm'"),
    "notes": ("[hand]", "notes = 3\n[hand]", "'notes' must be a table"),
    "no joints": ("[joints]", "[notes]", "missing joints: left_0, left_1"),
    "no hand": ("[hand]", "[notes]", r"\[hand\]: the table is missing"),
    "name": ('name = "planar_two_finger"', 'name = ""', "non-empty string"),
}


@pytest.mark.parametrize("fault", list(TRANSMISSION_FAULTS))
def test_transmission_faults(fault: str, files: tuple[Path, Path]) -> None:
    old, new, message = TRANSMISSION_FAULTS[fault]
    urdf, transmission = files
    change(transmission, old, new)
    with pytest.raises(DescriptionError, match=message) as caught:
        load_hand(urdf)
    assert str(transmission) in str(caught.value)


def test_joints_that_do_not_match(files: tuple[Path, Path]) -> None:
    urdf, transmission = files
    change(transmission, "left_1 = { spring", "left_7 = { spring")
    with pytest.raises(JointMismatchError, match="left_0, left_1, right_0, right_1") as caught:
        load_hand(urdf)
    assert caught.value.missing == ("left_1",)
    assert caught.value.unexpected == ("left_7",)
    change(transmission, "left_7 = { spring", "left_1 = { spring")
    change(transmission, "{ left_0 = 1.0, left_1 = 0.8 }", "{ left_0 = 1.0, left_2 = 0.8 }")
    with pytest.raises(JointMismatchError, match="does not have: left_2"):
        load_hand(urdf)


def test_a_joint_that_nothing_holds(files: tuple[Path, Path]) -> None:
    urdf, transmission = files
    for spring in ("0.2", "0.1"):
        change(transmission, f"spring = {spring}", "spring = 0.0")
    with pytest.raises(DescriptionError, match=r"holds the joints left_0, left_1.*positive 'spring'"):
        load_hand(urdf)


def test_missing_files(files: tuple[Path, Path]) -> None:
    urdf, transmission = files
    transmission.unlink()
    with pytest.raises(DescriptionError, match=r"my.transmission.toml: no such transmission file"):
        load_hand(urdf)
    urdf.unlink()
    with pytest.raises(DescriptionError, match=r"my.urdf: no such URDF file"):
        load_hand(str(urdf))


OBJECT_FAULTS = {
    "no friction": (".object.toml", "friction = 0.9", "", "the key 'friction' is missing"),
    "negative friction": (".object.toml", "friction = 0.9", "friction = -0.9", "must be at least 0"),
    "no width": (".object.toml", "grasp_width = 0.03", "grasp_width = 0.0", "'grasp_width' must be positive"),
    "no axis": (".object.toml", "grasp_axis = [0.0, 1.0, 0.0]", "grasp_axis = [0, 0, 0]", "must not be zero"),
    "key": (".object.toml", "[marker]", "[markers]", "unknown key 'markers'"),
    "mesh": (".urdf", '<collision><origin xyz="0 0 0"/><geometry><box size="0.09 0.03 0.04"/>',
             '<collision><geometry><mesh filename="a.stl"/>', "or capsule only, found a mesh"),
    "mesh beside a box": (".urdf", "</inertial>",
                          '</inertial><collision><geometry><mesh filename="a.stl"/></geometry></collision>',
                          "found a mesh"),
    "no shape": (".urdf", "collision>", "nothing>", "found no shape"),
    "massless": (".urdf", "inertial>", "nothing>", "needs an <inertial>"),
    "two links": (".urdf", "</robot>", '<link name="b"/><joint name="j" type="fixed"><parent link="box"/>'
                  '<child link="b"/></joint></robot>', "single link, found box, b"),
}  # fmt: skip


@pytest.mark.parametrize("fault", list(OBJECT_FAULTS))
def test_object_faults(fault: str, tmp_path: Path) -> None:
    suffix, old, new, message = OBJECT_FAULTS[fault]
    urdf, _ = copied(tmp_path, "box")
    change(tmp_path / f"my{suffix}", old, new, -1 if fault in ("massless", "no shape") else 1)
    with pytest.raises(DescriptionError, match=message):
        load_object(urdf)


def test_a_hall_channel_is_read_once(tmp_path: Path) -> None:
    urdf, transmission = copied(tmp_path, "icub_right")
    change(transmission, "channel = 1\n", "channel = 0\n")
    with pytest.raises(DescriptionError, match="each Hall channel must be unique, repeated: 0"):
        load_hand(urdf)


JUNK = ["", "nan", "-1", "0", "1e999", "[]", "{}", '"x"', "<", "&", "true", "[[pads]]", "\x00", "é", "left_0"]


@settings(max_examples=150)
@given(which=st.booleans(), at=st.floats(0, 1, exclude_max=True), junk=st.sampled_from(JUNK))
def test_damaged_files_never_raise_anything_else(which: bool, at: float, junk: str) -> None:
    """One word of either file replaced by junk: the hand loads, or the error is ours."""
    with tempfile.TemporaryDirectory() as folder:
        urdf, transmission = copied(Path(folder))
        damaged = urdf if which else transmission
        words = re.split(r"(\W)", damaged.read_text(encoding="utf-8"))
        words[int(at * len(words))] = junk
        damaged.write_text("".join(words), encoding="utf-8")
        with contextlib.suppress(EKMError):
            load_hand(urdf)


def test_a_date_stays_a_date(tmp_path: Path) -> None:
    path = tmp_path / "dated.toml"
    notes = {"notes": {"measured": datetime.date(2026, 1, 15)}}
    path.write_text(document(notes))
    assert tomllib.loads(path.read_text()) == notes
