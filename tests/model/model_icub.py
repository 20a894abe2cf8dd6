"""The iCub hand holding a box or a can between thumb, index and middle finger."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from model_toys import isotropic

from torch_ekm.contact.contact_set import ContactSet
from torch_ekm.description import load_hand
from torch_ekm.kinematics import HandKinematics
from torch_ekm.model import GraspState, KinematicModel, ModelOptions

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
        "thumb_0": 56,
        "thumb_1": 14 - open_deg,
        "thumb_2": 16,
        "thumb_3": 12,
        "index_1": 32,
        "index_2": 22,
        "index_3": 14,
        "middle_1": 30,
        "middle_2": 22,
        "middle_3": 16,
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


def pinch(shape: str = "box", *, gamma: float = 0.0, friction: float = 1.0, open_deg: float = 0.0, **options):
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
    rotation = torch.stack([torch.linalg.cross(along, across), along, across], dim=-1)
    state = GraspState(q, centre, rotation)
    options.setdefault("gravity", (0.0, 0.0, -9.81))
    model = KinematicModel(
        hand, Held(), ModelOptions(**options), kinematics=kin, detector=lambda *_: contacts
    )
    return model, state, contacts
