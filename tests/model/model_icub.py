"""The iCub hand holding a box or a can between thumb, index and middle finger."""

import dataclasses
from functools import lru_cache

import numpy as np
import torch
from equilibrium import EquilibriumSolver
from model_toys import (
    F64,
    ToyObject,
    changed,
    contact_set,
    isotropic,
    planar_two_finger,
    soft_two_finger,
    three_finger,
)

from torch_ekm.description import load_hand
from torch_ekm.kinematics import GraspState, HandKinematics
from torch_ekm.model import KinematicModel

DEG = np.pi / 180
FINGERS = ("thumb", "index", "middle")
POSTURE = {  # [deg]
    "thumb": (47, 10, 10, 31), "index": (7, 32, 12, 22), "middle": (0, 45, 18, 29), "ring": (7, 2, 2, 2),
    "little": (7, 2, 2, 2),
}  # fmt: skip


def pinch(shape: str = "box", *, gamma: float = 0.0, friction: float = 1.5):
    """Model, state and contacts of a three-finger pinch; the fingertips are balls at the caps of the pads.

    The box is as thick as the fingertips are apart; the can's axis runs along the line from the index to
    the middle fingertip, its radius half that distance.
    """
    hand = load_hand("icub_right")
    kin = HandKinematics(hand)
    angles = [POSTURE[finger][int(k)] for finger, k in (name.split("_") for name in hand.joint_names)]
    q = DEG * torch.tensor(angles, dtype=F64)
    poses = kin(q)
    pads = hand.pads[:3]
    assert tuple(pad.name for pad in pads) == FINGERS
    rho = pads[0].radius
    tips = torch.stack([(poses.of(pad.link) @ torch.tensor([*pad.end, 1.0], dtype=F64))[:3] for pad in pads])
    along = tips[2] - tips[1]
    along = along / along.norm()
    across = tips[0] - 0.5 * (tips[1] + tips[2])
    across = across - along * (along @ across)
    across = across / across.norm()  # from the fingers to the thumb
    normals = torch.stack([across, -across, -across])
    points = tips - rho * normals
    links = [pad.link for pad in pads]
    contacts = contact_set(links, points, normals, 1 / rho, friction=friction, gamma=gamma)
    contacts = contacts.replace(finger=FINGERS)
    if shape == "can":
        radius = 0.5 * float((points[0] - points[1]) @ across)
        k_o = isotropic(normals, 1 / radius) - torch.outer(along, along) / radius
        contacts = contacts.replace(object_curvature=k_o)
    centre = 0.5 * points[0] + 0.25 * (points[1] + points[2])
    rotation = torch.stack([along, across, torch.linalg.cross(along, across)], dim=-1)  # box: y is across
    state = GraspState(q, centre, rotation)
    hand = dataclasses.replace(hand, gravity=(0.0, 0.0, -9.81))
    held = ToyObject(0.08, (0.001, -0.002, 0.003))
    return KinematicModel(hand, held, kinematics=kin, detector=lambda *_: contacts), state, contacts


@lru_cache(maxsize=4)
def gripped(shape: str = "box", **options):
    """A pinch in exact equilibrium with a thumb force of 2.5 N: model, solver, equilibrium."""
    model, state, contacts = pinch(shape, **options)
    solver = EquilibriumSolver(model, state, contacts, max_step=0.2)
    wish = torch.tensor([2.5, 1.25, 1.25], dtype=F64)
    start = solver.find(wish)
    for _ in range(25):  # Gauss-Newton: wished normal forces, small tangential ones
        forces = solver.forces(start)
        lin = model.linearize(start.state, start.contacts, forces=forces)
        target = torch.zeros_like(start.mu)
        target[list(lin.normal_rows)] = wish
        weight = torch.full_like(target, 0.3)
        weight[list(lin.normal_rows)] = 1.0
        matrix = weight[:, None] * lin.contact_force_sensitivity
        da = torch.linalg.pinv(matrix, rtol=3e-3) @ (weight * (target - start.mu))
        if float(forces.relative_margin.min()) > 0.5:
            break
        start = solver.move(start, start.a + da * min(1.0, 0.2 / float(da.abs().max())))
    wish[1:] = torch.nan
    return model, solver, solver.grip(start, wish)


def icub(**options):
    """Model, state and contacts of the gripped box; the model finds these contacts."""
    model, _, at = gripped("box", **options)
    return changed(model, contacts=at.contacts), at.state, at.contacts


def toy(make, **options):
    grasp = make(**options)
    return grasp.model, grasp.state, grasp.contacts


#: Model, state and contacts of each kind of grasp.
GRASPS = {
    "iCub": icub,
    "planar": lambda: toy(planar_two_finger),
    "rigid tendons": lambda: toy(three_finger),
    "compliant tendons": lambda: toy(three_finger, stiffness=2e4),
    "soft fingers": lambda: toy(soft_two_finger),
}
