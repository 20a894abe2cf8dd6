"""Where things are drawn, what they look like, and from where they are looked at; no graphics needed."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from torch_ekm.description import list_hands, load_hand, load_object, write_template
from torch_ekm.description.urdf import read_urdf
from torch_ekm.exceptions import DescriptionError, EKMError
from torch_ekm.kinematics.se3 import exp
from torch_ekm.rendering import make_scene, save_picture
from torch_ekm.rendering.scene import shape_mesh
from torch_ekm.rendering.visuals import Mesh, visuals

PALM_DOWN = np.array([0.0, 0.0, 9.81])


def scene_of(name, gravity):
    hand = load_hand(name)
    position, rotation = np.array([[0.05, 0.0, 0.06]] * 2), np.stack([np.eye(3)] * 2)
    q = np.tile(hand.spring_rest, (2, 1))
    return make_scene(hand, load_object("box"), q, position, rotation, gravity)


def test_the_object_is_where_it_is_said_to_be():
    scene = scene_of("icub_right", PALM_DOWN)
    placed = scene.transforms[:, -1] @ np.linalg.inv(load_object("box").shapes[-1].transform)
    np.testing.assert_allclose(placed[:, :3, 3], [[0.05, 0.0, 0.06]] * 2, atol=1e-12)
    np.testing.assert_allclose(scene.down, [0, 0, 1])


def test_a_ghost_stands_where_it_was_planned_and_can_be_seen_through():
    hand, obj, one = load_hand("icub_right"), load_object("box"), np.eye(3)[None]
    here, there = np.array([[0.05, 0.0, 0.06]]), np.array([[0.06, 0.0, 0.06]])
    q = hand.spring_rest[None]
    scene = make_scene(hand, obj, q, here, one, PALM_DOWN, ghost=(there, one))
    n = len(obj.shapes)
    hidden = [scene.opacity(i) == 1.0 for i in range(len(scene.shapes))]
    assert hidden == [True] * (len(hidden) - n) + [False] * n
    moved = scene.transforms[0, -n:, :3, 3] - scene.transforms[0, -2 * n : -n, :3, 3]
    np.testing.assert_allclose(moved, [[0.01, 0, 0]] * n, atol=1e-12)
    assert scene_of("icub_right", PALM_DOWN).ghosts == 0


@pytest.mark.parametrize("name", list_hands())
@pytest.mark.parametrize("given", [True, False])
def test_a_turn_is_seen_along_its_axis(name, given):
    """The one that is named, or that of the turn; square to a planar hand."""
    hand, axis = load_hand(name), np.array([0.1, -0.9, 0.3]) / np.linalg.norm([0.1, -0.9, 0.3])
    turn = exp(torch.from_numpy(np.outer([0.0, 0.2, 0.4], axis))).numpy()
    if given:
        turn = turn[:1]
    n = len(turn)
    scene = make_scene(
        hand, load_object("box"), np.tile(hand.spring_rest, (n, 1)), np.zeros((n, 3)), turn, PALM_DOWN,
        axis=-axis if given else None,
    )  # fmt: skip
    position, focus, up = scene.camera
    sight = (position - focus) / np.linalg.norm(position - focus)
    expected = axis if hand.planar_normal is None else np.array(hand.planar_normal)
    assert abs(sight @ expected) == pytest.approx(1.0, abs=1e-6)
    assert np.linalg.norm(np.cross(up, sight)) > 0.1


def test_hands_are_seen_from_the_side_of_the_index_finger():
    views = {name: scene_of(name, PALM_DOWN).camera for name in ("icub_right", "icub_left")}
    for name, (position, focus, up) in views.items():
        sight = position - focus
        assert np.linalg.norm(sight) == pytest.approx(0.34)
        np.testing.assert_allclose(up, [0, 0, -1])
        assert sight[1] * (1 if name == "icub_left" else -1) > 0.2


@pytest.mark.parametrize("gravity", [(0, -9.81, 0), (0, 0, 9.81), (0, 0, 0)])
def test_a_planar_hand_is_seen_from_the_front_whatever_pulls(gravity):
    position, focus, up = scene_of("planar_two_finger", np.array(gravity, dtype=float)).camera
    sight = (position - focus) / np.linalg.norm(position - focus)
    np.testing.assert_allclose(np.abs(sight), [0, 0, 1], atol=1e-9)
    assert abs(up @ sight) < 1e-9  # else there is no up in the picture


def test_a_picture_that_cannot_be_drawn_is_an_error(tmp_path):
    with pytest.raises(EKMError, match="could not draw"):
        save_picture(scene_of("icub_right", PALM_DOWN), tmp_path / "nowhere" / "picture.png")


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
def test_a_mesh_that_cannot_be_read_is_told_and_what_touches_is_drawn(name, content, told, tmp_path):
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
