"""What a URDF may hold: elements that are not read, defaults, capsules, meshes, entities."""

from pathlib import Path

import numpy as np
import pytest

from torch_ekm.description.urdf import read_urdf
from torch_ekm.exceptions import DescriptionError

SHAPE = "<collision>{}<geometry><!-- rigid -->{}</geometry></collision>"
CAPSULE = SHAPE.format('<origin xyz="0 0 0.1"/>', '<capsule radius="0.01" length="0.05"/>')
MESH = SHAPE.format("", '<mesh filename="package://nowhere/a.stl" scale="?"/>')
JOINT = '<parent link="a"/><child link="b"/>'


def read(tmp_path: Path, links: str = "", joint: str = "", prolog: str = ""):
    path = tmp_path / "thing.urdf"
    path.write_text(f'{prolog}<robot><link name="a">{links}</link>{joint}</robot>', encoding="utf-8")
    return read_urdf(path)


def test_what_is_not_read_may_be_anything(tmp_path: Path) -> None:
    """Colours, drives and the pictures of a link are other programs' business, and other units'."""
    ignored = '<visual><geometry><blob/></geometry></visual><collision_checking/><sensor mass="heavy"/>'
    others = '<material name="red"><color rgba="?"/></material><gazebo/><transmission/>'
    urdf = read(tmp_path, ignored, others)
    assert urdf.name == "thing"  # of the file, where the robot has none
    assert [link.name for link in urdf.links] == ["a"]
    assert not urdf.links[0].has_mesh


def test_limits_and_axes_have_the_defaults_of_the_standard(tmp_path: Path) -> None:
    joint = f'<link name="b"/><joint name="j" type="revolute">{JOINT}<limit upper="1"/></joint>'
    (revolute,) = read(tmp_path, joint=joint).joints
    assert (revolute.lower, revolute.upper) == (0.0, 1.0)
    np.testing.assert_array_equal(revolute.axis, [1, 0, 0])
    np.testing.assert_array_equal(revolute.transform, np.eye(4))
    (endless,) = read(tmp_path, joint=joint.replace("revolute", "continuous").replace("1", "inf")).joints
    assert (endless.lower, endless.upper) == (-np.inf, np.inf)
    fixed = joint.replace("revolute", "fixed").replace("<limit", '<axis xyz="0 0 0"/><limit')
    assert read(tmp_path, joint=fixed).moving_joints == ()


def test_a_capsule_is_one_shape_and_a_mesh_is_never_opened(tmp_path: Path) -> None:
    """yourdfpy refuses the first element, and stumbles over comments."""
    link = read(tmp_path, MESH + CAPSULE).links[0]
    assert link.has_mesh
    (capsule,) = link.collisions
    assert (capsule.kind, capsule.size) == ("capsule", (0.01, 0.05))
    np.testing.assert_array_equal(capsule.transform[:3, 3], [0, 0, 0.1])


BOMB = "".join(f'<!ENTITY e{k} "{10 * f"&e{k - 1};"}">' for k in range(1, 10))


@pytest.mark.parametrize(
    ("entity", "links"),
    [
        ('<!ENTITY e SYSTEM "{secret}">', "&e;"),
        ('<!ENTITY e SYSTEM "{secret}">', '<inertial name="&e;"/>'),
        ('<!ENTITY e0 "{bulk}">' + BOMB, '<inertial name="&e9;"/>'),
    ],
)
def test_entities_are_neither_fetched_nor_multiplied(tmp_path: Path, entity: str, links: str) -> None:
    (tmp_path / "secret.txt").write_text("very secret")
    declared = entity.format(secret=(tmp_path / "secret.txt").as_uri(), bulk=1000 * "e")
    with pytest.raises(DescriptionError, match=r"thing\.urdf: not well-formed XML") as caught:
        read(tmp_path, links, prolog=f"<!DOCTYPE robot [{declared}]>")
    assert "very secret" not in str(caught.value)
