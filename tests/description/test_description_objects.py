"""The objects: figures a reader can check, and that bodies are physical."""

import numpy as np
import pytest

from torch_ekm.description import Shape, list_objects, load_object
from torch_ekm.description.registry import list_cylinders
from torch_ekm.description.shape import merge_capsules


@pytest.mark.parametrize("name", list_objects())
def test_objects_are_physical(name: str) -> None:
    obj = load_object(name)
    assert 0.02 < obj.mass <= 0.3
    assert 0.2 < obj.friction < 1.2
    principal = np.linalg.eigvalsh(obj.inertia)
    assert principal[0] > 0
    assert principal[0] + principal[1] > principal[2]
    np.testing.assert_allclose(
        obj.marker_transform[:3, :3] @ obj.marker_transform[:3, :3].T, np.eye(3), atol=1e-12
    )
    assert np.linalg.det(obj.marker_transform[:3, :3]) == pytest.approx(1.0)
    # the board looks away from the object, and stands clear of it
    out = obj.marker_transform[:3, 2]
    np.testing.assert_allclose(out, [1, 0, 0], atol=1e-12)
    reach = max(support(shape, out) for shape in obj.shapes)
    assert obj.marker_transform[:3, 3] @ out == pytest.approx(reach + 0.005)


def support(shape: Shape, direction: np.ndarray) -> float:
    """``max_{x in shape} direction . x``"""
    local = shape.transform[:3, :3].T @ direction
    at = float(direction @ shape.transform[:3, 3])
    if shape.kind == "box":
        return at + float(np.abs(local) @ shape.size) / 2
    if shape.kind == "sphere":
        return at + shape.size[0]
    radius, length = shape.size
    across = radius if shape.kind == "capsule" else radius * float(np.hypot(local[0], local[1]))
    return at + across + abs(local[2]) * length / 2


@pytest.mark.parametrize("name", list_objects())
def test_grasp_width_is_the_width_at_the_origin(name: str) -> None:
    """How long the line along the grasp axis through the origin is inside the object."""
    from torch_ekm.contact.pad_contact import signed_distance

    obj = load_object(name)
    along = np.linspace(-0.05, 0.05, 20001)
    within = along[signed_distance(obj.shapes, np.outer(along, obj.grasp_axis))[0] <= 0]
    assert within.max() - within.min() == pytest.approx(obj.grasp_width, abs=2e-5)


def test_the_box_by_hand() -> None:
    """80 g, 90 x 30 x 40 mm: ``I_xx = m (b^2 + c^2)/12``."""
    box = load_object("box")
    assert [(shape.kind, shape.size) for shape in box.shapes] == [("box", (0.09, 0.03, 0.04))]
    expected = 0.08 / 12 * np.array([0.03**2 + 0.04**2, 0.09**2 + 0.04**2, 0.09**2 + 0.03**2])
    np.testing.assert_allclose(np.diag(box.inertia), expected, rtol=1e-9)
    np.testing.assert_array_equal(box.com, 0.0)


def test_a_cylinder_with_two_balls_is_a_capsule() -> None:
    at = np.eye(4)
    up, down = np.eye(4), np.eye(4)
    up[2, 3], down[2, 3] = 0.02, -0.02
    rod = Shape("cylinder", (0.01, 0.04), at)
    caps = (Shape("sphere", (0.01,), up), Shape("sphere", (0.01,), down))
    (capsule,) = merge_capsules((rod, *caps))
    assert capsule.kind == "capsule"
    assert capsule.size == (0.01, 0.04)
    # one ball only, or a ball of another size: left as they are
    assert [s.kind for s in merge_capsules((rod, caps[0]))] == ["cylinder", "sphere"]
    other = Shape("sphere", (0.011,), down)
    assert [s.kind for s in merge_capsules((rod, caps[0], other))] == ["cylinder", "sphere", "sphere"]


def test_cylinders_go_by_their_diameter() -> None:
    for name in list_cylinders():
        obj, diameter = load_object(name), float(name[len("cylinder_") : -len("mm")]) / 1000
        assert [(shape.kind, shape.size) for shape in obj.shapes] == [("cylinder", (diameter / 2, 0.06))]
        assert obj.grasp_width == diameter
