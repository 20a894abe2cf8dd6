"""The iCub hand holding a box or a can between thumb, index and middle finger."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from equilibrium import EquilibriumSolver
from model_toys import isotropic

from torch_ekm.contact.contact_set import ContactSet
from torch_ekm.description import load_hand
from torch_ekm.kinematics import GraspState, HandKinematics
from torch_ekm.model import KinematicModel, ModelOptions

F64 = torch.float64
DEG = np.pi / 180
PADS = ("thumb_3", "index_3", "middle_3")


@dataclass(frozen=True)
class Held:
    """An object's inertia; its surfaces are in the contacts."""

    mass: float = 0.08
    com: tuple[float, float, float] = (0.001, -0.002, 0.003)


def pinch_posture(hand, open_deg: float = 0.0) -> torch.Tensor:
    q = torch.zeros(hand.n_q, dtype=F64)
    posture = {
        "thumb_0": 47,
        "thumb_1": 10 - open_deg,
        "thumb_2": 10,
        "thumb_3": 31,
        "index_0": 7,
        "ring_0": 7,
        "little_0": 7,
        "index_1": 32,
        "index_2": 12,
        "index_3": 22,
        "middle_1": 45,
        "middle_2": 18,
        "middle_3": 29,
        "ring_1": 2,
        "ring_2": 2,
        "ring_3": 2,
        "little_1": 2,
        "little_2": 2,
        "little_3": 2,
    }
    for name, angle in posture.items():
        q[hand.joint_names.index(name)] = angle * DEG
    return q


def pinch(shape: str = "box", *, gamma: float = 0.0, friction: float = 1.5, open_deg: float = 0.0, **options):
    """Model, state and contacts of a three-finger pinch; the fingertips are balls at the caps of the pads.

    The box is as thick as the fingertips are apart; the can's axis runs along the line from the index to
    the middle fingertip, its radius half that distance.
    """
    hand = load_hand("icub_right")
    kin = HandKinematics(hand)
    q = pinch_posture(hand, open_deg)
    poses = kin(q)
    pads = {pad.link: pad for pad in hand.pads}
    rho = pads["thumb_3"].radius
    tips = torch.stack(
        [(poses.of(link) @ torch.tensor([*pads[link].end, 1.0], dtype=F64))[:3] for link in PADS]
    )
    along = tips[2] - tips[1]
    along = along / along.norm()
    across = tips[0] - 0.5 * (tips[1] + tips[2])
    across = across - along * (along @ across)
    across = across / across.norm()  # from the fingers to the thumb
    normals = torch.stack([across, -across, -across])
    points = tips - rho * normals
    k_o = torch.zeros(3, 3, 3, dtype=F64)
    if shape == "can":
        radius = 0.5 * float((points[0] - points[1]) @ across)
        k_o = isotropic(normals, 1 / radius) - torch.outer(along, along) / radius
    contacts = ContactSet(
        finger=PADS,
        link=PADS,
        point=points,
        normal=normals,
        gap=torch.zeros(3, dtype=F64),
        finger_curvature=isotropic(normals, 1 / rho),
        object_curvature=k_o,
        friction=torch.full((3,), friction, dtype=F64),
        torsional_friction=torch.full((3,), gamma, dtype=F64),
    )
    centre = 0.5 * points[0] + 0.25 * (points[1] + points[2])
    rotation = torch.stack([along, across, torch.linalg.cross(along, across)], dim=-1)  # box: y is across
    state = GraspState(q, centre, rotation)
    hand = dataclasses.replace(hand, gravity=(0.0, 0.0, -9.81))
    model = KinematicModel(
        hand, Held(), ModelOptions(**options), kinematics=kin, detector=lambda *_: contacts
    )
    return model, state, contacts


@lru_cache(maxsize=4)
def gripped(shape: str = "box", grip: float = 2.5, **options):
    """A pinch in exact equilibrium with a thumb force of ``grip`` [N]: model, solver, equilibrium."""
    model, state, contacts = pinch(shape, **options)
    solver = EquilibriumSolver(model, state, contacts, max_step=0.2)
    start = solver.find(torch.tensor([grip, grip / 2, grip / 2], dtype=F64))
    for _ in range(25):  # Gauss-Newton: wished normal forces, small tangential ones
        forces = solver.forces(start)
        lin = model.linearize(start.state, start.contacts, forces=forces)
        target = torch.zeros_like(start.mu)
        target[list(lin.normal_rows)] = torch.tensor([grip, grip / 2, grip / 2], dtype=F64)
        weight = torch.full_like(target, 0.3)
        weight[list(lin.normal_rows)] = 1.0
        matrix = weight[:, None] * lin.contact_force_sensitivity
        da = torch.linalg.pinv(matrix, rtol=3e-3) @ (weight * (target - start.mu))
        if float(forces.relative_margin.min()) > 0.5:
            break
        start = solver.move(start, start.a + da * min(1.0, 0.2 / float(da.abs().max())))
    nan = float("nan")
    return model, solver, solver.grip(start, torch.tensor([grip, nan, nan], dtype=F64))
