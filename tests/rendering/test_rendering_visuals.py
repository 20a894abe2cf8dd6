"""What a URDF says a hand looks like is drawn; what cannot be read is told and replaced."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from torch_ekm.description import list_hands, load_hand, write_template
from torch_ekm.description.registry import hand_paths
from torch_ekm.description.urdf import read_urdf
from torch_ekm.exceptions import DescriptionError
from torch_ekm.rendering import make_scene
from torch_ekm.rendering.scene import shape_mesh
from torch_ekm.rendering.visuals import Mesh, visuals

trimesh = pytest.importorskip("trimesh")
LOOKS = """<visual><origin xyz="0.1 0 0" rpy="0 0 1.5707963"/>
  <geometry><mesh filename="NAME" scale="0.001 0.001 0.002"/></geometry></visual>"""


def finger(folder: Path, looks: str, touches: str = '<geometry><sphere radius="0.01"/></geometry>') -> Path:
    path = folder / "finger.urdf"
    collision = f"<collision>{touches}</collision>" if touches else ""
    path.write_text(
        f"""<robot name="finger"><link name="base"/><link name="tip">{looks}{collision}</link>
        <joint name="knuckle" type="revolute"><parent link="base"/><child link="tip"/><axis xyz="0 0 1"/>
        <limit lower="0" upper="1" effort="1" velocity="1"/></joint></robot>"""
    )
    return path


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "dae"])
def test_a_mesh_is_drawn_where_the_urdf_puts_it(suffix: str, tmp_path: Path) -> None:
    if suffix == "dae":
        pytest.importorskip("collada")  # trimesh reads it where this is installed
    (tmp_path / "my_hand" / "meshes").mkdir(parents=True)
    (tmp_path / "my_hand" / "urdf").mkdir()
    trimesh.creation.box((10.0, 20.0, 30.0)).export(tmp_path / "my_hand" / "meshes" / f"tip.{suffix}")
    looks = LOOKS.replace("NAME", f"package://my_hand/meshes/tip.{suffix}")
    found = visuals(read_urdf(finger(tmp_path / "my_hand" / "urdf", looks)))
    assert found.problems == ()
    (mesh,) = found.of_link["tip"]
    assert isinstance(mesh, Mesh)
    placed = shape_mesh(mesh).apply_transform(mesh.transform).bounds
    np.testing.assert_allclose(placed, [[0.09, -0.005, -0.03], [0.11, 0.005, 0.03]], atol=1e-6)


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("none.stl", None, "is not there"),
        ("bad.stl", "solid", "mesh"),
        ("tip.txt", "x", "kind"),
        ("", None, ""),
    ],
)
def test_a_mesh_that_cannot_be_read_is_told_and_what_touches_is_drawn(
    name: str, content: str | None, told: str, tmp_path: Path
) -> None:
    if content is not None:
        (tmp_path / name).write_text(content)
    found = visuals(read_urdf(finger(tmp_path, LOOKS.replace("NAME", name))))
    assert "link 'tip', visual" in found.problems[0]
    assert told in found.problems[0]
    assert [shape.kind for shape in found.of_link["tip"]] == ["sphere"]  # type: ignore[union-attr]


def test_a_mesh_only_hand(tmp_path: Path) -> None:
    """Its collision meshes are drawn; where they are missing, too, nothing is: an error says so."""
    urdf = finger(tmp_path, "", '<geometry><mesh filename="tip.stl"/></geometry>')
    written = write_template(urdf)
    text = written.read_text().replace('["TODO", "TODO", "TODO"]', "[0.0, 1.0, 0.0]")
    written.write_text(text.replace('["TODO", "TODO"]', "[0.0, 9.0]").replace('"TODO"', "0.5"))
    hand = load_hand(urdf)
    arguments = (hand, None, hand.spring_rest[None], None, None, np.array([0.0, 0.0, 9.81]))
    with pytest.raises(DescriptionError, match=r"no link has a <visual> or <collision> that can be drawn"):
        make_scene(*arguments)
    trimesh.creation.icosphere(radius=0.01).export(tmp_path / "tip.stl")
    urdf.write_text(urdf.read_text() + " ")  # changed: it is read again
    assert len(make_scene(*arguments).shapes) == 1


@pytest.mark.parametrize("name", list_hands())
def test_hands_of_the_package_look_like_what_touches(name: str) -> None:
    hand = load_hand(hand_paths(name)[0])
    found = visuals(hand.urdf)
    assert found.problems == ()
    for link in hand.urdf.links:
        looks = sorted((shape.kind, shape.size) for shape in found.of_link[link.name])  # type: ignore[union-attr]
        assert looks == sorted((shape.kind, shape.size) for shape in link.collisions)
