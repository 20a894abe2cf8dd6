"""Signed distances against finite differences; test_contact_collision.py has them against coal."""

from __future__ import annotations

import numpy as np
import pytest

from torch_ekm.contact.pad_contact import point_distance, signed_distance
from torch_ekm.description.shape import Shape
from torch_ekm.simulation.physics.links import x_axis_to

SIZES = {"box": (0.09, 0.03, 0.04), "cylinder": (0.02, 0.08), "sphere": (0.025,), "capsule": (0.015, 0.06)}


def placed(kind, seed=0):
    generator = np.random.default_rng(seed)
    transform = x_axis_to(generator.standard_normal(3))
    transform[:3, 3] = generator.uniform(-0.02, 0.02, 3)
    return Shape(kind, SIZES[kind], transform)


@pytest.mark.parametrize("kind", SIZES)
def test_normal_is_the_gradient_inside_and_outside(kind):
    shape, generator, step = placed(kind), np.random.default_rng(2), 1e-7
    points = generator.uniform(-0.06, 0.06, (300, 3))
    distance, normal = signed_distance((shape,), points)
    assert (distance < 0).any()
    assert (distance > 0).any()
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1.0, atol=1e-12)
    ahead, back = ([signed_distance((shape,), points + h * e)[0] for e in np.eye(3)] for h in (step, -step))
    gradient = np.subtract(ahead, back).T / (2 * step)
    smooth = np.abs(np.linalg.norm(gradient, axis=-1) - 1) < 1e-5  # not across an inner edge
    assert smooth.mean() > 0.95
    np.testing.assert_allclose(gradient[smooth], normal[smooth], atol=1e-5)


@pytest.mark.parametrize("kind", SIZES)
def test_one_point_and_many_give_the_same(kind):
    shape = Shape(kind, SIZES[kind], np.eye(4))
    points = np.random.default_rng(7).uniform(-0.06, 0.06, (300, 3))
    points[:4] = [[0, 0, 0.01], [0, 0, -0.07], [0.001, 0, 0], [0.05, -0.05, 0.05]]  # on the axis, and far off
    distance, normal = signed_distance((shape,), points)
    one = [point_distance(shape)(*point) for point in points.tolist()]
    np.testing.assert_allclose([d for d, _ in one], distance, atol=1e-16)
    np.testing.assert_allclose([n for _, n in one][2:], normal[2:], atol=1e-14)
    assert all(np.linalg.norm(n) == pytest.approx(1.0) for _, n in one)


def test_on_the_axis_of_a_cylinder_a_normal_is_given():
    long = Shape("cylinder", (0.02, 0.1), np.eye(4))
    distance, normal = signed_distance((long,), np.zeros((2, 3)))
    np.testing.assert_allclose(distance, -0.02)
    np.testing.assert_array_equal(normal, [[1, 0, 0]] * 2)
    np.testing.assert_array_equal(signed_distance((long,), np.zeros(3))[1], [1, 0, 0])


@pytest.mark.parametrize("kind", SIZES)
def test_a_grown_shape_is_nearer_by_as_much(kind):
    """Along its axes, where no edge is nearest."""
    shape, d = Shape(kind, SIZES[kind], np.eye(4)), 0.002
    points = 0.08 * np.vstack([np.eye(3), -np.eye(3)])
    apart = signed_distance((shape,), points)[0] - signed_distance((shape.grown(d),), points)[0]
    np.testing.assert_allclose(apart, d, atol=1e-12)
    assert shape.grown(-1.0).size > (0.0,) * len(shape.size)
