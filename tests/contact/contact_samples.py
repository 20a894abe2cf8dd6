"""Contacts on a ball of radius 30 mm, held by fingers that are just joints in space."""

import dataclasses

import torch

from torch_ekm.contact.contacts import ContactKinematics, ContactModel, ContactSet, contact_kinematics

F64 = torch.float64
RADIUS = 0.03


def tangential(normal: torch.Tensor, curvature: float) -> torch.Tensor:
    return curvature * (torch.eye(3, dtype=F64) - normal[..., :, None] * normal[..., None, :])


def ball_contacts(directions, *, friction=0.6, gamma=0.0) -> ContactSet:
    normal = torch.tensor(directions, dtype=F64)
    normal = normal / normal.norm(dim=-1, keepdim=True)
    n_c = len(normal)
    names = tuple(f"finger_{i}" for i in range(n_c))
    return ContactSet(
        finger=names,
        link=names,
        point=RADIUS * normal,
        normal=normal,
        gap=torch.zeros(n_c, dtype=F64),
        finger_curvature=tangential(normal, 1 / 0.006),
        object_curvature=tangential(normal, 1 / RADIUS),
        friction=torch.full((n_c,), friction, dtype=F64),
        torsional_friction=torch.full((n_c,), gamma, dtype=F64),
    )


def held(
    directions,
    *,
    joints_per_finger: int = 3,
    seed: int = 0,
    models: list[ContactModel] | None = None,
    plane=None,
    **kw,
) -> ContactKinematics:
    """Each contact is carried by its own chain of random joints within 5 cm."""
    contacts = ball_contacts(directions, **kw)
    generator = torch.Generator().manual_seed(seed)
    n_q = joints_per_finger * contacts.n_c
    axis = torch.randn(n_q, 3, dtype=F64, generator=generator)
    if plane is not None:
        axis = torch.tensor(plane, dtype=F64).expand(n_q, 3)
    axis = axis / axis.norm(dim=-1, keepdim=True)
    origin = 0.05 * torch.randn(n_q, 3, dtype=F64, generator=generator)
    upstream = torch.eye(contacts.n_c, dtype=torch.bool).repeat_interleave(joints_per_finger, dim=1)
    plane = None if plane is None else torch.tensor(plane, dtype=F64)
    kin = contact_kinematics(contacts, torch.zeros(3, dtype=F64), axis, origin, upstream, plane=plane)
    return kin if models is None else dataclasses.replace(kin, models=tuple(models))


THREE = [[1.0, 0.1, 0.2], [-0.5, 0.9, -0.1], [-0.4, -0.8, 0.15]]
