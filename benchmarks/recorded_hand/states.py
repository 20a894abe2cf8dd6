"""From what a camera saw to states in which the pads touch: one in ten steps, from frames up to then."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torch_ekm.contact import ContactSet
from torch_ekm.contact.contacts import VARYING
from torch_ekm.description import HandDescription, ObjectDescription, Shape, load_object
from torch_ekm.exceptions import EKMError
from torch_ekm.kinematics import GraspState
from torch_ekm.model import KinematicModel, ModelOptions
from torch_ekm.typing import Array

from .fingers import FingerMarkers, register_camera, rotation
from .projection import project_onto_contacts
from .recordings import RecordedPath, known_diameter

STRIDE = 10
"""Steps from one state to the next."""
OPTIONS = ModelOptions(slack_tension=None, on_unstable="flag", max_overlap=0.02)
"""Servos keep both tendons taut all the time; markers are too coarse to identify a grasp's stability."""
_WINDOW = 5  # frames up to now whose median is the measurement: single frames jump by up to 15 mm
_MOVED = 2e-3  # [m] by which a proximal marker has moved before a frame is worth another look
_GROWTH = 1.3  # of the frames worth a look, until camera and diameter are fitted again
_LOOKS = 60  # frames a fit takes
_POSITION_STD, _ROTATION_STD = 1e-3, 0.02  # [m], [rad] of the object, for the projection
_LIKELY = 30.0  # chi^2 of two gaps; beyond, a marker was misread or a pad does not touch
_BEYOND = 0.35  # [rad] of a joint's limits: what a misread marker may make of an angle
_UNSEEN = 0.2  # [rad] standard deviation of an angle whose marker is hidden
_DIAMETERS, _USUAL = (0.01, 0.1), 0.045  # [m] that are believed, and one where nothing was seen yet
_UPRIGHT = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]], dtype=torch.float64)


class States(NamedTuple):
    """Of one object, one state in :data:`STRIDE` steps of each path, ``n`` in all; hand frame."""

    path: NDArray[np.int64]
    """Which path ``(n,)``."""
    step: NDArray[np.int64]
    """Which of its steps ``(n,)``."""
    q: Array
    """``(n, 4)`` [rad]"""
    position: Array
    """``(n, 2)`` [m]"""
    angle: Array
    """``(n,)`` [rad]"""
    camera: Array
    """phi, t of ``y = R(phi) x + t`` as known then ``(n, 3)``."""
    diameter: Array
    """As known then ``(n,)`` [m]."""
    found: NDArray[np.bool_]
    """Whether the pads could be brought to touch; where not, it is the state as measured ``(n,)``."""
    contacts: dict[str, Array]
    """Fields of the contact sets, ``(n, 2, ...)``."""

    def grasps(self) -> GraspState:
        """As a batch."""
        position = np.column_stack([self.position, np.zeros(len(self.q))])
        return GraspState(torch.from_numpy(self.q), torch.from_numpy(position), upright(self.angle))

    def contact_set(self, friction: float) -> ContactSet:
        """As a batch."""
        fields = {name: torch.from_numpy(self.contacts[name]) for name in VARYING}
        two = torch.full((2,), friction, dtype=torch.float64)
        return ContactSet(
            finger=("left", "right"),
            link=("left_1", "right_1"),
            friction=two,
            torsional_friction=torch.zeros_like(two),
            **fields,  # type: ignore[arg-type]  # by name, of the tensors alone
        )


def cylinder(diameter: float) -> ObjectDescription:
    """One of any diameter [m], otherwise as those that come with the package."""
    like = load_object("cylinder_45mm")
    (shape,) = like.shapes
    size = (diameter / 2, shape.size[1])
    return dataclasses.replace(like, shapes=(Shape("cylinder", size, shape.transform),), grasp_width=diameter)


def upright(angle: Array) -> torch.Tensor:
    """Orientation of a cylinder that stands on the plane and is turned by ``angle``, ``(n, 3, 3)``."""
    c, s = np.cos(angle), np.sin(angle)
    zero, one = np.zeros_like(c), np.ones_like(c)
    turn = np.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=-1).reshape(-1, 3, 3)
    return torch.from_numpy(turn) @ _UPRIGHT


def estimate_states(
    name: str, paths: Sequence[RecordedPath], markers: FingerMarkers, hand: HandDescription
) -> States:
    """States of all paths of one object.

    Camera and, where it is not published, the diameter of the object (taken for a cylinder) come from the
    frames up to now: the first one of the path, and again whenever the fingers have moved enough. Angles come
    from the median of the last five frames; the projection onto the contacts closes the gaps, and shows
    the angle of a distal joint whose marker is not seen.
    """
    rows: list[tuple] = []
    for number, path in enumerate(paths):
        last = None
        for steps, known, diameter in _epochs(name, paths, number, markers):
            model, camera = KinematicModel(hand, cylinder(diameter), OPTIONS), known.camera
            found = known.joints(np.array([_recent(path.markers, t) for t in steps]))
            q, std = map(torch.from_numpy, found)
            pose = np.array([_recent(path.pose, t) for t in steps])
            position = np.zeros((len(steps), 3))
            position[:, :2] = (pose[:, :2] - camera[1:]) @ rotation(camera[0])
            angle = path.pose[steps, 2] - camera[0]
            place, turn = torch.from_numpy(position), upright(angle)
            for k, step in enumerate(steps):
                angles, spread = q[k], std[k]
                if last is not None:  # an angle that no marker shows is about what it was
                    angles = torch.where(spread > _UNSEEN, last[0].q, angles)
                    spread = spread.clamp(max=_UNSEEN)
                measured = GraspState(angles, place[k], turn[k])
                now = _touching(model, measured, spread)
                last = now or last
                state, contacts = now or _as_measured(model, measured)
                at = state.q.numpy(), state.position[:2].numpy(), angle[k], camera, diameter, now is not None
                rows.append((number, step, *at, *(getattr(contacts, field).numpy() for field in VARYING)))
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    first = len(States._fields) - 1
    return States(*columns[:first], contacts=dict(zip(VARYING, columns[first:], strict=True)))


def _epochs(
    name: str, paths: Sequence[RecordedPath], number: int, markers: FingerMarkers
) -> Iterator[tuple[list[int], FingerMarkers, float]]:
    """Steps of a path that share what was known at them: markers in the camera's frame, and the diameter."""
    before = [frame for path in paths[:number] for frame in _looks(path)]
    fresh, now, fitted = _looks(paths[number]), [], 0
    known: tuple[FingerMarkers, float] | None = None
    steps: list[int] = []
    for step in range(0, len(paths[number]) - STRIDE, STRIDE):
        while fresh and fresh[0][0] <= step:
            now.append(fresh.pop(0))
        if known is None or len(now) >= _GROWTH * fitted + 1:
            if known is not None and steps:
                yield steps, *known
            fitted, steps = len(now), []
            placed = register_camera(markers, _some([*before, *now])[0]) if before or now else markers
            diameter = known_diameter(name)
            if diameter is None:  # other sides of it are held in other paths
                diameter = _diameter(placed, *_some(now)) if now else _USUAL
            known = placed, diameter
        steps.append(step)
    if known is not None and steps:
        yield steps, *known


def _some(looks: list[tuple[int, Array, Array]]) -> tuple[Array, Array]:
    """Markers and poses of a fixed number of frames, evenly among these."""
    chosen = [looks[k] for k in np.unique(np.linspace(0, len(looks) - 1, _LOOKS).astype(int))]
    return np.array([seen for _, seen, _ in chosen]), np.array([pose for _, _, pose in chosen])


def _diameter(markers: FingerMarkers, seen: Array, pose: Array) -> float:
    """Of the cylinder that the pads would touch about the object's reference point: the median."""
    camera = markers.camera
    q, _ = markers.joints(seen)
    position = (pose[:, :2] - camera[1:]) @ rotation(camera[0])
    distance = markers.fingers.distance(q, position)
    measured = distance[np.isfinite(seen[:, 2:]).all(-1)]  # by a finger whose distal marker is seen
    return float(np.clip(2 * np.median(measured), *_DIAMETERS)) if measured.size else _USUAL


def _looks(path: RecordedPath) -> list[tuple[int, Array, Array]]:
    """Frames at which a finger has moved since the last of them: step, markers, pose."""
    found, last = [], None
    for step, seen in enumerate(path.markers):
        base = seen[:2].ravel()
        if np.isfinite(base).all() and (last is None or np.abs(base - last).max() > _MOVED):
            last = base
            found.append((step, seen, path.pose[step]))
    return found


def _touching(
    model: KinematicModel, measured: GraspState, std: torch.Tensor
) -> tuple[GraspState, ContactSet] | None:
    try:
        projection = project_onto_contacts(
            model,
            measured,
            q_std=std,
            position_std=_POSITION_STD,
            rotation_std=_ROTATION_STD,
            touching=("left", "right"),
        )
    except EKMError:
        return None
    lower, upper = (torch.from_numpy(limit) for limit in (model.hand.joint_lower, model.hand.joint_upper))
    q = projection.state.q
    inside = bool(((q > lower - _BEYOND) & (q < upper + _BEYOND)).all())
    both = projection.contacts.finger == ("left", "right")
    return (projection.state, projection.contacts) if both and inside and projection.chi2 < _LIKELY else None


def _as_measured(model: KinematicModel, measured: GraspState) -> tuple[GraspState, ContactSet]:
    """The points of the pads that are nearest to the object, as if they touched it."""
    detector = copy.copy(model.detector)
    detector.margin = math.inf  # type: ignore[attr-defined]
    contacts = detector(measured.q, measured.position, measured.rotation)  # type: ignore[operator]
    return measured, contacts.replace(gap=torch.zeros_like(contacts.gap))


def _recent(values: Array, step: int) -> Array:
    """Median of the last frames, of those seen."""
    window = values[max(0, step - _WINDOW + 1) : step + 1]
    seen = np.isfinite(window).any(axis=0)
    return np.where(seen, np.nanmedian(np.where(seen, window, 0.0), axis=0), np.nan)
