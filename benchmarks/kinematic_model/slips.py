"""Which contacts truly slide, and how near the others are to it.

A contact slides by the relative motion of the two materials at the contact point, tangential, summed over the
simulator's frames; rolling is none. True margins come from the simulator's joint torques, normal forces and
friction.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from link_weights import LinkWeights

from torch_ekm.contact import constraint_matrix
from torch_ekm.description import ObjectDescription, Shape, load_object
from torch_ekm.kinematics import GraspState
from torch_ekm.model import KinematicModel, ModelOptions
from torch_ekm.simulation import PlantParameters, SimulatedHand, preset

SLIP, STILL = 5e-5, 1e-5  # [m] of a motion that slips, and in which nothing slides
RELEASE = 0.1  # [N] lack of margin that is announced; chosen on seeds 0 to 6


def own_objects() -> dict[str, ObjectDescription]:
    """A wide, a thin and a heavy one that the package does not have."""
    box = load_object("box")

    def make(name: str, kind: str, size: tuple[float, ...], width: float, mass: float, friction: float):
        inertia = mass * 0.0017 * np.eye(3) * (1.0 if width > 0.03 else 0.5)
        shape = Shape(kind, size, np.eye(4))  # type: ignore[arg-type]
        return dataclasses.replace(
            box, name=name, shapes=(shape,), mass=mass, inertia=inertia, grasp_width=width, friction=friction,
            com=np.zeros(3),
        )  # fmt: skip

    return {
        "wide": make("wide", "box", (0.09, 0.05, 0.05), 0.05, 0.15, 0.9),
        "thin": make("thin", "box", (0.10, 0.018, 0.03), 0.018, 0.05, 0.8),
        "heavy": make("heavy", "box", (0.09, 0.035, 0.045), 0.035, 0.3, 0.9),
    }


class Witness:
    """The simulator's truth about contacts: sliding and friction margins."""

    def __init__(self, plant: SimulatedHand) -> None:
        self.plant = plant
        p = plant.parameters
        hand, obj = plant.true_descriptions()
        self.model = KinematicModel(hand, obj, ModelOptions(on_unstable="flag", max_overlap=0.02))
        self.link_weights = LinkWeights(hand, self.model.kinematics) if p.link_weight else None
        self._rig: Any = plant._rig
        self.frames: list[GraspState] = []
        self._scene = self._rig.scene
        self._step, self._count = self._scene.step, 0
        self._scene.step = self._stepped

    def _stepped(self, *arguments) -> None:
        """A physics step; every tenth state is kept."""
        self._step(*arguments)
        self._count += 1
        if self._count % 10 == 0:
            seen = (self._scene.q, *self._scene.object_pose)
            self.frames.append(GraspState(*(torch.from_numpy(np.asarray(x)) for x in seen)))

    def _free(self, q: np.ndarray) -> np.ndarray:
        """Joints away from their stops."""
        hand, near = self.model.hand, np.radians(0.2)
        return np.flatnonzero((q > hand.joint_lower + near) & (q < hand.joint_upper - near))

    def slips(self) -> dict[str, float]:
        """How far each contact point slid since the last call [m]."""
        total: dict[str, torch.Tensor] = {}
        before = None
        for state in self.frames:
            poses = self.model.kinematics(state.q)
            contacts = self.model.detector(poses, state.position, state.rotation)
            now = (state, poses, contacts)
            if before is not None:
                for name, way in sliding(before, now):
                    total[name] = total.get(name, 0.0) + way
            before = now
        self.frames = self.frames[-1:]
        return {name: float(torch.linalg.vector_norm(way)) for name, way in total.items()}

    def margins(self) -> dict[str, float]:
        """``mu_s f_n - |f_t|`` [N]: forces that explain joint torques, object balance and normal forces."""
        rig = self._rig
        q, (position, rotation) = rig.scene.q, rig.scene.object_pose
        state = GraspState(*(torch.from_numpy(np.asarray(x)) for x in (q, position, rotation)))
        torque = rig.transmission.drive_stiffness * (rig.transmission.drive_targets(q, rig.servo.output) - q)
        poses = self.model.kinematics(state.q)
        contacts = self.model.detector(poses, state.position, state.rotation)
        if contacts.n_c == 0:
            return {}
        kin = self.model.contact_kinematics(state, contacts, poses=poses)
        A = constraint_matrix(kin).numpy()
        n_q = self.model.hand.n_q
        torque = torch.from_numpy(torque)
        if self.link_weights is not None:
            torque = torque - self.link_weights(poses)[0]
        weight = self.model.potential(state)[0][n_q:].numpy()
        pads = [pad.name for pad in self.model.hand.pads]
        normal = np.array([rig.normal[pads.index(name)] for name in contacts.finger])
        scale = np.array([1, 1, 1, 30, 30, 30]) / 0.01
        free = self._free(q)  # a stop's torque is not known
        rows = [
            A[:, :n_q].T[free] / 2e-3,
            -scale[:, None] * A[:, n_q:].T,
            np.eye(A.shape[0])[kin.normal_rows] / 0.02,
        ]
        rhs = [torque.numpy()[free] / 2e-3, scale * weight, normal / 0.02]
        mu = np.linalg.lstsq(np.concatenate(rows), np.concatenate(rhs))[0].reshape(contacts.n_c, -1)
        friction = contacts.friction.numpy()
        margin = friction * mu[:, 0] - np.linalg.norm(mu[:, 1:3], axis=-1)
        self.misfit = float(np.abs(np.concatenate(rows) @ mu.ravel() - np.concatenate(rhs)).max())
        return {name: float(m) for name, m, f in zip(contacts.finger, margin, normal, strict=True) if f > 0}


def plant_parameters(name: str, seed: int) -> PlantParameters:
    """A preset; "sensed" is the mechanism as described with the sensors of "nominal"."""
    nominal = preset("nominal")
    if name != "sensed":
        return preset(name).replace(hardware_seed=seed)
    names = [field.name for field in dataclasses.fields(nominal)]
    sensors = [n for n in names if n.endswith("_noise") or n.startswith("force_")]
    return preset("none").replace(hardware_seed=seed, **{n: getattr(nominal, n) for n in sensors})


def sliding(before, now) -> Iterator[tuple[str, torch.Tensor]]:
    """Tangential motion of finger relative to object at the contact point of each pad, in hand axes [m]."""
    (s1, poses1, c1), (s2, poses2, c2) = before, now
    for name in c1.finger:
        if name not in c2.finger:
            continue
        i, j = c1.finger.index(name), c2.finger.index(name)
        x, n = 0.5 * (c1.point[i] + c2.point[j]), c1.normal[i] + c2.normal[j]
        n = n / torch.linalg.vector_norm(n)
        T1, T2 = poses1.of(c1.link[i]), poses2.of(c1.link[i])
        finger = T2[:3, :3] @ T1[:3, :3].mT @ (x - T1[:3, 3]) + T2[:3, 3] - x
        obj = s2.rotation @ s1.rotation.mT @ (x - s1.position) + s2.position - x
        way = finger - obj
        yield name, way - n * (n @ way)
