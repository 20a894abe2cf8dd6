"""Where things are drawn, and from where they are looked at; no graphics needed."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torch_ekm.description import list_hands, load_hand, load_object
from torch_ekm.exceptions import EKMError
from torch_ekm.kinematics.se3 import exp
from torch_ekm.rendering import make_scene
from torch_ekm.rendering.image import save_picture

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
    pytest.importorskip("pyvista")
    with pytest.raises(EKMError, match="could not draw"):
        save_picture(scene_of("icub_right", PALM_DOWN), tmp_path / "nowhere" / "picture.png")
