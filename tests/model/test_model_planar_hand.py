"""The packaged planar hand: two fingers, two tendons, everything in one plane."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from equilibrium import EquilibriumSolver
from model_icub import Held
from model_toys import F64, contact_set, finite_difference_jacobian, relative_error

from torch_ekm.description import load_hand
from torch_ekm.kinematics import GraspState, HandKinematics
from torch_ekm.model import KinematicModel


def pinch():
    hand = load_hand("planar_two_finger")
    kin = HandKinematics(hand)
    q = torch.tensor(0.5 * (hand.joint_lower + hand.joint_upper)).clamp(-0.6, 0.6)
    poses = kin(q)
    tips = torch.stack(
        [(poses.of(pad.link) @ torch.tensor([*pad.start, 1.0], dtype=F64))[:3] for pad in hand.pads]
    )
    normal = (tips[0] - tips[1]) / (tips[0] - tips[1]).norm()
    normals = torch.stack([normal, -normal])
    rho = hand.pads[0].radius
    contacts = contact_set(
        [pad.link for pad in hand.pads], tips - rho * normals, normals, 1 / rho, 0.0, friction=1.0
    )
    state = GraspState(q, contacts.point.mean(0), torch.eye(3, dtype=F64))
    model = KinematicModel(
        dataclasses.replace(hand, gravity=(0.0, -9.81, 0.0)),
        Held(mass=0.05, com=(0.0, 0.0, 0.0)),
        kinematics=kin,
        detector=lambda *_: contacts,
    )
    return model, state, contacts


def test_jacobian_and_forces_stay_in_the_plane_and_are_exact():
    model, state, contacts = pinch()
    solver = EquilibriumSolver(model, state, contacts)
    at = solver.find(torch.full((2,), 1.0, dtype=F64))
    at = solver.grip(at, torch.tensor([1.2, np.nan], dtype=F64))
    lin = model.linearize(at.state, at.contacts, forces=solver.forces(at))
    out_of_plane = [4 + 2, 4 + 3, 4 + 4]  # z, rotations about x and y
    assert lin.manipulation_jacobian[out_of_plane].abs().max() < 1e-14
    assert lin.contact_force_sensitivity.shape == (4, 2)
    expected = finite_difference_jacobian(solver, at, 1e-4)
    assert relative_error(lin.manipulation_jacobian, expected, 4) < 1e-9
    found = model.linearize(at.state, at.contacts).forces
    assert (found.mu - at.mu).norm() < 1e-4 * at.mu.norm()
