"""Surfaces that are curved differently in different directions: cylindrical fingers on cylinders."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from model_toys import F64, finite_difference_jacobian, relative_error, soft_two_finger, three_finger

from torch_ekm.contact.contact_kinematics import contact_frames
from torch_ekm.model import KinematicModel


def crossed(toy, angle, rho=0.008, radius=0.02):
    """Finger and object are cylinders whose axes cross under ``angle`` [rad] at every contact."""
    c = toy.contacts
    frame = contact_frames(c.normal)
    t1, t2 = frame[..., 1], frame[..., 2]
    tangent = torch.eye(3, dtype=F64) - c.normal[..., :, None] * c.normal[..., None, :]

    def cylinder(turn, r):
        axis = math.cos(turn) * t1 + math.sin(turn) * t2
        return (tangent - axis[..., :, None] * axis[..., None, :]) / r

    contacts = c.replace(finger_curvature=cylinder(0.4, rho), object_curvature=cylinder(0.4 + angle, radius))
    model = toy.model
    model = KinematicModel(
        model.hand, model.obj, model.options, kinematics=model.kinematics, detector=lambda *_: contacts
    )
    return dataclasses.replace(toy, model=model, contacts=contacts)


@pytest.mark.parametrize("angle", [1.5708, 0.9, 0.5])
@pytest.mark.parametrize("make", [three_finger, soft_two_finger], ids=["hard", "soft"])
def test_jacobian_of_crossed_cylinders_equals_finite_differences(make, angle):
    toy = crossed(make(), angle)
    solver, start = toy.solver(), toy.equilibrium()
    assert {core.kind for core in solver.surfaces.finger + solver.surfaces.object} == {"line"}
    lin = toy.model.linearize(toy.state, forces=toy.forces())
    truth = finite_difference_jacobian(solver, start, 5e-6)
    assert relative_error(lin.manipulation_jacobian, truth, len(toy.state.q)) < 1e-7
    normals = finite_difference_jacobian(solver, start, 5e-6, lambda e: solver.forces(e).normal)
    assert (lin.normal_force_sensitivity - normals).norm() < 1e-6 * normals.norm()


def test_the_curvature_tensor_matters():
    toy = crossed(three_finger(), 1.5708)
    ball = three_finger()
    J = toy.model.linearize(toy.state, forces=toy.forces()).manipulation_jacobian
    other = ball.model.linearize(ball.state, forces=ball.forces()).manipulation_jacobian
    assert relative_error(J, other, 9) > 0.05
