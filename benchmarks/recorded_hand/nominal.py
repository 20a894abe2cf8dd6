"""Nominal models of the recorded motions, and what they predict: no motion, a constant Jacobian, the KM."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torch_ekm.description import HandDescription
from torch_ekm.kinematics.servo_model import Play
from torch_ekm.model import KinematicModel
from torch_ekm.typing import Array

from .fingers import rotation
from .recordings import RecordedPath
from .states import OPTIONS, States, cylinder

LARGEST = 0.2  # [m/rad]: a Jacobian five times that of the hand's middle is not believed


@dataclass(frozen=True)
class Nominal:
    """A nominal model by name."""

    name: str
    kind: str
    """"none", "constant", "published" or "online" (learning.py)."""
    play: bool = False
    """Whether the motors' motion goes through the play of the drive first."""


NOMINALS = (
    Nominal("no model", "none"),
    Nominal("constant Jacobian, play", "constant", play=True),
    Nominal("KM, published figures", "published"),
    Nominal("KM, published figures, play", "published", play=True),
    Nominal("KM, figures online, play", "online", play=True),
)


class Samples(NamedTuple):
    """Of one object at one horizon; ``n`` samples that do not overlap, in the order of time."""

    row: NDArray[np.int64]
    """Which state each begins at ``(n,)``."""
    path: NDArray[np.int64]
    motion: Array
    """x, y [m] and angle [rad], camera axes ``(n, 3)``."""
    delta_a: Array
    """Of the motors, left and right ``(n, 2)`` [rad]."""
    transmitted: Array
    """What of it leaves the play ``(n, 2)`` [rad]."""
    loads: Array
    """At the beginning ``(n, 2)``."""
    horizon: int
    """Steps."""


def through_play(paths: Sequence[RecordedPath], hand: HandDescription) -> list[Array]:
    """Motion of the tendons in each step ``(n, 2)`` [rad]; at the beginning they hang at the closing end."""
    play, most = Play.of(hand), max(map(len, paths))
    commanded = torch.zeros(most, len(paths), 2, dtype=torch.float64)
    for k, path in enumerate(paths):
        commanded[: len(path), k] = torch.from_numpy(path.delta_a)
    state, out = play.at(-0.5 * play.width.expand(len(paths), 2)), torch.zeros_like(commanded)
    for t in range(most):
        out[t], state = play.advance(state, commanded[t])
    return [out[: len(path), k].numpy() for k, path in enumerate(paths)]


def take_samples(
    paths: Sequence[RecordedPath], states: States, moved: Sequence[Array], horizon: int
) -> Samples:
    """Samples of ``horizon`` steps, one after the other in each path.

    Args:
        states: of the same object.
        moved: from :func:`through_play`.
        horizon: a multiple of :data:`~torch_ekm.experiments.recorded_hand.states.STRIDE`.
    """
    rows = []
    for k in np.flatnonzero(states.step % horizon == 0):
        path, number, t = paths[states.path[k]], states.path[k], int(states.step[k])
        end = t + horizon
        if end >= len(path):
            continue
        rows.append(
            (
                k,
                number,
                path.pose[end] - path.pose[t],
                path.delta_a[t:end].sum(0),
                moved[number][t:end].sum(0),
                path.loads[t],
            )
        )
    return Samples(*(np.array(column) for column in zip(*rows, strict=True)), horizon)


def jacobians(hand: HandDescription, states: States) -> Array:
    """``d(x, y, angle)/da`` at each state, camera axes ``(n, 3, 2)``; stiffnesses of tendon and servo are not
    published, and taken for rigid."""
    obj = cylinder(0.045)  # its mass alone counts, and that not in the plane
    model = KinematicModel(hand, obj, dataclasses.replace(OPTIONS, actuator_compliance=False))
    linear = model.linearize(states.grasps(), states.contact_set(obj.friction))
    J = linear.object_jacobian[:, [0, 1, 5]].numpy()
    believed = np.abs(J[:, :2]).max((1, 2)) < LARGEST
    usual = np.median(J[believed], axis=0) if believed.any() else np.zeros((3, 2))
    J = np.where(believed[:, None, None], J, usual)
    return np.concatenate([rotation(states.camera[:, 0]) @ J[:, :2], J[:, 2:]], axis=1)


def constant_jacobian(action: Array, motion: Array) -> Array:
    """Least squares ``motion = J action``, ``(3, 2)``."""
    return np.asarray(np.linalg.lstsq(action, motion, rcond=None)[0].T, dtype=np.float64)


def predictions(
    nominal: Nominal,
    samples: Mapping[str, Samples],
    published: Mapping[str, Array],
    apart: str,
) -> dict[str, Array]:
    """Of each object, ``(n, 3)`` [m, m, rad].

    Args:
        published: Jacobians of the KM at the states of each object.
        apart: object that a constant Jacobian is fitted to.
    """
    found = {}
    for name, taken in samples.items():
        action = action_of(nominal, taken)
        if nominal.kind == "none":
            found[name] = np.zeros_like(taken.motion)
            continue
        if nominal.kind == "published":
            J = published[name][taken.row]
        else:
            fitted = samples[apart]
            J = constant_jacobian(action_of(nominal, fitted), fitted.motion)
        found[name] = np.einsum("...ij,nj->ni" if J.ndim == 2 else "nij,nj->ni", J, action)
    return found


def action_of(nominal: Nominal, samples: Samples) -> Array:
    """What the model takes for the motion of the tendons."""
    return samples.transmitted if nominal.play else samples.delta_a
