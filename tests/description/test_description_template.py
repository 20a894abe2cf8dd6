"""A transmission file begun from a URDF: it names what lacks, and loads when that is filled in."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from torch_ekm.description import list_hands, load_hand, write_template, write_transmission
from torch_ekm.description.registry import hand_paths
from torch_ekm.description.urdf import read_urdf
from torch_ekm.exceptions import DescriptionError
from torch_ekm.kinematics import ActuationMap

MIMIC = """<robot name="my finger">
  <link name="base"/>
  <joint name="knuckle" type="revolute"><parent link="base"/><child link="proximal"/>
    <axis xyz="0 0 1"/><limit lower="0.1" upper="1.5" effort="1" velocity="1"/></joint>
  <link name="proximal"/>
  <joint name="middle" type="revolute"><parent link="proximal"/><child link="distal"/>
    <axis xyz="0 0 1"/><limit lower="0" upper="1.5" effort="1" velocity="1"/>
    <mimic joint="knuckle" multiplier="0.5" offset="0.2"/></joint>
  <link name="distal"><collision><geometry><mesh filename="tip.stl"/></geometry></collision></link>
</robot>"""


def filled_in(path: Path) -> str:
    """The file with figures where it asks for them, and its text."""
    text = path.read_text()
    text = text.replace('["TODO", "TODO", "TODO"]', "[0.0, 1.0, 0.0]").replace(
        '["TODO", "TODO"]', "[0.0, 180.0]"
    )
    path.write_text(text.replace('"TODO"', "0.5"))
    return path.read_text()


def mine(folder: Path, text: str = MIMIC) -> tuple[Path, Path, str]:
    """A URDF, its transmission file, and what stands in it."""
    urdf = folder / "mine.urdf"
    urdf.write_text(text)
    written = write_template(urdf)
    return urdf, written, filled_in(written)


@pytest.mark.parametrize("name", list_hands())
def test_a_template_names_what_lacks_and_loads_when_it_is_filled_in(name: str, tmp_path: Path) -> None:
    urdf = Path(shutil.copy(hand_paths(name)[0], tmp_path / "mine.urdf"))
    with pytest.raises(DescriptionError, match=r"torch-ekm hands --new"):
        load_hand(urdf)
    written = write_template(urdf)
    joints = [joint.name for joint in read_urdf(urdf).moving_joints]
    free = joints[-1]
    with pytest.raises(DescriptionError, match=rf"still to be filled in.*joints\.{free}\.spring"):
        load_hand(urdf)
    filled_in(written)
    hand, true = load_hand(urdf), load_hand(name)
    assert hand.joint_names == true.joint_names
    assert hand.base_link == true.base_link
    assert hand.planar_normal == true.planar_normal
    assert {pad.link for pad in true.pads} <= {pad.link for pad in hand.pads}
    with pytest.raises(DescriptionError, match="not overwritten"):
        write_template(urdf)
    assert "TODO" not in written.read_text().split("[hand]")[1]


def test_a_mimic_becomes_a_coupling(tmp_path: Path) -> None:
    urdf, written, good = mine(tmp_path)
    hand = load_hand(urdf)
    knuckle, middle = ActuationMap(hand).joints(torch.tensor([[0.1], [0.4]], dtype=torch.float64)).T
    torch.testing.assert_close(middle, 0.5 * knuckle + 0.2, rtol=0, atol=1e-7)
    assert float(knuckle[1] - knuckle[0]) > 0.1
    written.write_text(
        good.replace("middle = -0.5", "middle = -0.4").replace("knuckle = -0.5", "knuckle = -0.4")
    )
    assert hand.notes == ()


def test_a_transmission_file_overrules_a_mimic(tmp_path: Path) -> None:
    """By another coupling, by none, or by another angle at rest; each time with a note."""
    urdf, written, good = mine(tmp_path)
    written.write_text(good.replace("knuckle = -0.5", "knuckle = -0.4"))
    hand = load_hand(urdf)
    assert hand.coupling.tolist() == [[-0.4, 1.0]]
    (note,) = hand.notes
    assert "'middle' is a <mimic> of 'knuckle'" in note
    assert "knuckle = -0.5" in note
    start, end = good.index("[[couplings]]"), good.index("[[actuators]]")
    alone = good[:start] + good[end:]
    written.write_text(alone)
    with pytest.raises(DescriptionError, match="holds the joints middle"):
        load_hand(urdf)
    written.write_text(alone.replace("spring = 0.0", "spring = 0.1"))
    assert len(load_hand(urdf).coupling) == 0
    written.write_text(good.replace("rest_deg = 14.3", "rest_deg = 34.3"))
    assert "an offset of 11.4592 deg" in load_hand(urdf).notes[0]


def test_a_circle_of_mimics_is_opened(tmp_path: Path) -> None:
    back = '<mimic joint="middle"/><child link="proximal"/>'
    hand = load_hand(mine(tmp_path, MIMIC.replace('<child link="proximal"/>', back))[0])
    assert hand.coupling.tolist() == [[1.0, -1.0]]
    assert "in a circle, is left out: middle (of knuckle)" in hand.notes[0]


@pytest.mark.parametrize(
    ("mimic", "locked", "note"),
    [
        ('joint="knuckle" multiplier="0" offset="0.2"', True, ""),
        ('joint="slide" multiplier="2" offset="0.2"', True, "does not move is locked: middle"),
        ('joint="gone"', False, "of no other joint, or in a circle, is left out: middle"),
    ],
)
def test_a_mimic_of_what_does_not_move(mimic: str, locked: bool, note: str, tmp_path: Path) -> None:
    slide = (
        '<link name="x"/><joint name="slide" type="prismatic"><parent link="base"/><child link="x"/></joint>'
    )
    text = MIMIC.replace('joint="knuckle" multiplier="0.5" offset="0.2"', mimic)
    hand = load_hand(mine(tmp_path, text.replace("</robot>", slide + "</robot>"))[0])
    assert note in " ".join(hand.notes)
    assert "held at 0: slide" in " ".join(hand.notes)
    assert hand.coupling.tolist() == ([[0.0, 1.0]] if locked else [])
    if locked:
        assert hand.spring_rest[1] == pytest.approx(0.2)


def test_the_pad_of_a_thumb_is_called_so(tmp_path: Path) -> None:
    assert 'name = "thumb_1"' in mine(tmp_path, MIMIC.replace("distal", "thumb_tip"))[2]


@pytest.mark.parametrize("name", ["icub_right", "planar_two_finger"])
def test_a_written_transmission_reads_back(name, tmp_path):
    hand = load_hand(name)
    actuators = tuple(
        dataclasses.replace(actuator, stiffness=1.0 + k, backlash=0.01 * k, offset=0.1 * k)
        for k, actuator in enumerate(hand.actuators)
    )
    changed = dataclasses.replace(
        hand,
        actuators=actuators,
        actuation_jacobian=1.1 * hand.actuation_jacobian,
        spring_stiffness=0.9 * hand.spring_stiffness,
        spring_rest=hand.spring_rest - 0.1,
    )
    write_transmission(changed, tmp_path / "mine.transmission.toml")
    back = load_hand(tmp_path / "mine.urdf")
    assert back.actuators == changed.actuators
    for field in dataclasses.fields(changed):
        one, other = getattr(changed, field.name), getattr(back, field.name)
        if isinstance(one, np.ndarray):
            np.testing.assert_array_equal(one, other)
        elif field.name not in ("urdf", "transmission_path"):
            assert one == other, field.name
    with pytest.raises(DescriptionError, match="end in"):
        write_transmission(changed, tmp_path / "mine.toml")
