"""A small recording of the same format, made by the kinematic model of the T42: for tests and ``--quick``."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch

from torch_ekm.description import load_hand
from torch_ekm.kinematics import GraspState, HandKinematics
from torch_ekm.model import KinematicModel
from torch_ekm.typing import Array

from .nominal import through_play
from .projection import project_onto_contacts
from .recordings import APART, FILE, UNIT, RecordedPath
from .states import OPTIONS, STRIDE, cylinder, upright

OBJECTS = {APART: 0.045, "cyl30_d_v0": 0.030, "cyl35_red_d_v0": 0.035, "poly6_d_v0": 0.040}
"""Name -> diameter [m]; the name of the last one does not state it."""
_MARKERS = ((0.058, -0.05), (0.057, 0.03), (0.0175, -0.04), (0.0180, 0.13))  # [m], [rad] in their links
_CAMERA = {"blue": (0.037, 0.024, 0.016), "red": (0.050, 0.027, 0.023)}  # phi [rad], t [m]
_NOISE = 2e-4  # [m] of a coordinate
_HIDDEN = (0.41989, 1.08116)  # [m]: what is written for a marker that was not seen


def write_synthetic(folder: str | Path, *, seed: int = 0, steps: int = 260, paths: int = 2) -> Path:
    """Write ``t42_hand/t42_testpaths.npz`` into ``folder``: cylinders pushed to and fro, play included.

    Args:
        folder: it is made if it is not there.
        seed: of noise and commands.
        steps: of each path.
        paths: of each object.
    """
    generator = np.random.default_rng(seed)
    arrays: dict[str, Array] = {}
    for name, diameter in OBJECTS.items():
        for number in range(paths):
            states, actions = _record(name, diameter, steps, generator)
            arrays[f"{name}/{number}/S"], arrays[f"{name}/{number}/A"] = states, actions
    path = Path(folder) / FILE
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, allow_pickle=False, **arrays)  # type: ignore[arg-type]
    return path


def _record(name: str, diameter: float, steps: int, generator: np.random.Generator) -> tuple[Array, Array]:
    hand = load_hand("yale_t42")
    model = KinematicModel(hand, cylinder(diameter), OPTIONS)
    red = "_red_" in name
    finger = _commands(steps, generator)  # left, right
    delta_a = UNIT * finger
    blank = RecordedPath(np.zeros((steps, 3)), np.zeros((steps, 4, 2)), np.zeros((steps, 2)), delta_a)
    (transmitted,) = through_play([blank], hand)
    q = torch.tensor([-0.15, 0.45, -0.15, 0.45], dtype=torch.float64)
    state = GraspState(q, torch.tensor([0.0, 0.095, 0.0], dtype=torch.float64), upright(np.zeros(1))[0])
    knots = [state := _closed(model, state)]
    for t in range(0, steps, STRIDE):
        move = torch.from_numpy(transmitted[t : t + STRIDE].sum(0))
        state = _closed(model, state.plus(model.linearize(state).step(move)))
        knots.append(state)
    at = np.arange(steps) / STRIDE
    q_all = _between(np.array([k.q.numpy() for k in knots]), at)
    turn = np.array([math.atan2(k.rotation[1, 1], k.rotation[0, 1]) - math.pi / 2 for k in knots])
    pose = np.column_stack([[k.position[:2].numpy() for k in knots], np.unwrap(turn)])
    pose = _between(pose, at)
    phi, *shift = _CAMERA["red" if red else "blue"]
    R = np.array([[math.cos(phi), -math.sin(phi)], [math.sin(phi), math.cos(phi)]])
    markers = _marker_points(hand, q_all) @ R.T + shift + _NOISE * generator.standard_normal((steps, 4, 2))
    markers[generator.uniform(size=steps) < 0.05, 3] = _HIDDEN
    place = pose[:, :2] @ R.T + shift + _NOISE * generator.standard_normal((steps, 2))
    angle = (pose[:, 2] + phi + 1.0 + math.pi) % (2 * math.pi) - math.pi
    angle = angle + 0.005 * generator.standard_normal(steps)
    columns = finger if red else finger[:, ::-1]
    loads = 80.0 * columns + generator.standard_normal((steps, 2))
    states = np.column_stack([1e3 * place, angle, markers.reshape(steps, 8), loads])
    return states, columns.copy()


def _commands(steps: int, generator: np.random.Generator) -> Array:
    """One finger gives as the other pulls, for 12 to 18 s at a time; now and then by 1.5."""
    found, sign = np.zeros((steps, 2)), float(generator.choice([-1.0, 1.0]))
    t = 0
    while t < steps:
        for_steps = int(generator.integers(120, 180))
        size = 1.5 if generator.uniform() < 0.15 else 1.0
        found[t : t + for_steps] = sign * size * np.array([-1.0, 1.0])
        sign, t = -sign, t + for_steps
    return found


def _closed(model: KinematicModel, state: GraspState) -> GraspState:
    """The state near this one in which both pads touch."""
    pads = ("left", "right")
    return project_onto_contacts(
        model, state, q_std=0.05, position_std=1e-3, rotation_std=0.05, touching=pads
    ).state


def _between(knots: Array, at: Array) -> Array:
    return np.stack([np.interp(at, np.arange(len(knots)), column) for column in knots.T], axis=-1)


def _marker_points(hand, q: Array) -> Array:
    kinematics = HandKinematics(hand)
    poses = kinematics(torch.from_numpy(q)).transforms.numpy()
    found = []
    for (radius, angle), link in zip(_MARKERS, ("left_0", "right_0", "left_1", "right_1"), strict=True):
        local = np.array([radius * math.cos(angle), radius * math.sin(angle), 0.0, 1.0])
        found.append((poses[:, kinematics.link_index(link)] @ local)[:, :2])
    return np.stack(found, axis=1)
