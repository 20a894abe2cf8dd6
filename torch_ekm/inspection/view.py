"""A hand, a grasp, its reach or a log to look at: a page of its own for any browser, and a table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from ..control import ClosedLoop, LookAndMoveController, Reach
from ..description import HandDescription, load_hand, load_object
from ..exceptions import DescriptionError, ParameterError
from ..kinematics import ActuationMap, GraspState
from ..kinematics.se3 import log as rotation_vector
from ..model import KinematicModel
from ..plant import Observation, PlantStatus, Trajectory, TrialLog
from ..rendering import Captions, Scene, make_scene
from ..rendering.visuals import visuals
from ..rendering.web import pad_forces
from ..simulation import SimulatedHand
from ..typing import Array, Tensor

_FRAMES = 10  # of one actuator's way through its range
_STEP, _STEPS = math.radians(2.5), 2  # an actuator of a grasp is moved so far at once, and so often


@dataclass(frozen=True)
class View:
    """What there is to look at."""

    scene: Scene
    """Its frames are played one after another."""
    captions: Captions
    """Title, and what the page says of each frame."""
    header: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    """What there is to read."""
    notes: tuple[str, ...] = ()
    """What could not be drawn."""


def view(hand: str, object: str | None = None, seed: int = 0, *, reach: bool = False) -> View:
    """A hand (name or file), alone or holding an object.

    Args:
        object: name or URDF.
        seed: which grasp of it.
        reach: how far it can be turned.

    Raises:
        UnknownNameError: no such hand; the message lists them.
        ParameterError: no object is given, whose reach is asked for.
        EquilibriumError, GraspError: the object cannot be pinched by this hand.
    """
    if object is None:
        if reach:
            raise ParameterError("reach", reach, "False without an object: it is that of a grasp")
        return view_hand(load_hand(hand).counted())
    plant = SimulatedHand(hand, object)
    try:
        seen = plant.reset(seed)
        return _reach(plant) if reach else _grasp(plant, seen)
    finally:
        plant.close()


def view_hand(hand: HandDescription) -> View:
    """Where the hand rests that touches nothing, while each actuator closes and opens."""
    upper, start = hand.actuator_upper, np.clip(0.0, hand.actuator_lower, hand.actuator_upper)
    ways = np.r_[np.linspace(0, 1, _FRAMES), np.linspace(1, 0, _FRAMES)]
    postures = [start, *(start + way * np.diag(upper - start)[i] for i in range(hand.n_a) for way in ways)]
    q = ActuationMap(hand).joints(torch.from_numpy(np.array(postures))).numpy()
    scene = make_scene(hand, None, q, None, None, np.array(hand.gravity))
    lines = ["at rest"]
    for k, posture in enumerate(postures[1:]):
        i = k // len(ways)
        lines.append(f"motor {hand.actuator_names[i]} at {math.degrees(posture[i]):.0f} deg")
    return View(scene, Captions(hand.name, tuple(lines)), notes=tuple(visuals(hand.urdf).problems))


def _grasp(plant: SimulatedHand, seen: Observation) -> View:
    """A pinch, and what each actuator does to it by itself."""
    hand, start, grasp, axis = plant.hand, _truth(seen), plant.snapshot(), plant.rotation_axis
    shown, lines = [seen], ["at rest"]
    rows = [("at rest", *_moved(start, start, axis), _forces(hand, seen))]
    for i, name in enumerate(hand.actuator_names):
        step = torch.zeros(hand.n_a, dtype=torch.float64)
        step[i] = _STEP
        way = [plant.command(step) for _ in range(_STEPS)]
        shown += [*way, *reversed(way[:-1]), seen]
        moved = [math.degrees(_STEP) * k for k in (*range(1, _STEPS + 1), *range(_STEPS - 1, -1, -1))]
        lines += [f"motor {name} {degrees:+.1f} deg" for degrees in moved]
        lost = ", lost" if way[-1].status is PlantStatus.LOST else ""
        rows.append((name + lost, *_moved(start, _truth(way[-1]), axis), _forces(hand, way[-1])))
        plant.restore(grasp)
    by = f"actuator, {_STEPS * math.degrees(_STEP):g} deg"
    header = (by, "turned about its axis [deg]", "moved [mm]", "forces [N]")
    states, forces = [_truth(one) for one in shown], [one.fingertip_force for one in shown]
    title = f"{hand.name} holds {plant.object.name}"
    return _held(plant, states, forces, Captions(title, tuple(lines)), header, tuple(rows))


def _reach(plant: SimulatedHand) -> View:
    """A pinch, turned on the model from the grasp to one end, to the other, and home."""
    controller = LookAndMoveController(KinematicModel(plant.hand, plant.object), plant.rotation_axis)
    loop = ClosedLoop(plant, controller)
    back, forth = (loop.reach(sign=sign) for sign in (-1, 1))
    there, rows = [], []
    for name, reach in (("forth", forth), ("back", back)):
        way, figures = _along(reach)
        there.append(way)
        rows[:0] = [(name, *row) for row in figures]
    shown = [*there[0], *reversed(there[0][:-1]), *there[1][1:], *reversed(there[1][:-1])]
    states, lines, std, forces = (list(part) for part in zip(*shown, strict=True))
    title = f"{plant.hand.name} turns {plant.object.name}: the plan both ways, with two standard deviations"
    header = ("direction", "angle [deg]", "off the axis [deg]", "ends by")
    captions = Captions(title, tuple(lines), std=np.array(std))
    return _held(plant, states, forces, captions, header, tuple(rows))


def _along(
    reach: Reach,
) -> tuple[list[tuple[GraspState, str, float, Tensor | None]], list[tuple[str, str, str]]]:
    """From the grasp to the last waypoint: its line, deviation of the turn [deg], and forces; and a row of
    figures for each waypoint."""
    plan, rows = reach.plan, []
    found: list[tuple[GraspState, str, float, Tensor | None]] = [(plan.start, "at rest", 0.0, None)]
    for k, (one, left) in enumerate(zip(plan.waypoints, plan.errors[1:], strict=True), 1):
        safe, ends = k <= plan.safe, k == len(plan.waypoints)
        std = float((plan.focus.matrix[0].square() * one.band.twist_std.square()).sum().sqrt())
        line = f"waypoint {k}: {one.band}{'' if safe else ', not safe'}{f'; ends by {reach.end}' * ends}"
        found.append((one.state, line, math.degrees(std), one.band.force))
        off = f"{math.degrees(one.band.off):.1f} +- {math.degrees(one.band.off_std):.1f}"
        last = str(reach.end) if ends else "" if safe else "not safe"
        rows.append((f"{math.degrees(plan.errors[0] - left):.1f}", off, last))
    return found, rows


def view_log(log: Path | TrialLog, trial: int | None = None) -> View:
    """One trial of a log, command by command: the truth where it is known, else what was estimated.

    Args:
        log: a log, its folder, or one trial's file.
        trial: which; the first one by default.

    Raises:
        DescriptionError: no such log or trial, a damaged or empty one, or one that does not name its
            hand and object.
        UnknownNameError: its hand or object is not on this machine; the message lists those that are.
    """
    if isinstance(log, TrialLog) or not log.is_file():
        found = log if isinstance(log, TrialLog) else TrialLog.open(log)
        trial = found.trials[0] if trial is None else trial
        trajectory, log = found.read(trial), found.path(trial)
    elif trial is not None:
        raise DescriptionError(log, f"this is one trial's file; to choose trial {trial}, name its folder")
    else:
        trajectory = Trajectory.load(log)
    if not trajectory.observations:
        reason = trajectory.about.get("outcome", {}).get("reason", "it holds no observation")
        raise DescriptionError(log, f"there is nothing to show: {reason}")
    configuration = trajectory.about.get("configuration", {})
    for name in ("hand", "object"):
        if not isinstance(configuration.get(name), str):
            raise DescriptionError(log, f"its configuration names no {name}, needed to draw it")
    hand, obj = load_hand(configuration["hand"]).counted(), load_object(configuration["object"])
    gravity = np.array(configuration.get("gravity", hand.gravity), dtype=np.float64)
    states = [_truth(seen) for seen in trajectory.observations]
    if states[0].q.shape[-1] != hand.n_q:
        problem = f"has {states[0].q.shape[-1]} joints, the hand '{hand.name}' {hand.n_q}: of another hand"
        raise DescriptionError(log, problem)
    scene = make_scene(hand, obj, *_arrays(states), gravity)
    header = ("time [s]", "object", "turned [deg]", "wrong by [deg]", "commanded [deg]", "events")
    rows = tuple(_moments(trajectory, hand))
    target = trajectory.about.get("outcome", {}).get("angle_deg")
    captions = Captions(
        f"{hand.name} holds {obj.name}: {log.stem}",
        tuple(f"motion {k}, {row[0]} s, {row[1]}: {row[4]}" for k, row in enumerate(rows)),
        np.array([float(row[2]) for row in rows]),
        target=abs(target) if isinstance(target, float) else None,
        forces=_forces_on(hand, states, [seen.fingertip_force for seen in trajectory.observations]),
    )
    return View(scene, captions, header, rows)


def _moments(trajectory: Trajectory, hand: HandDescription) -> list[tuple[str, ...]]:
    """What is known of each observation."""
    rows = []
    for k, seen in enumerate(trajectory.observations):
        wrong = "" if seen.truth is None else f"{_angle(seen.rotation @ seen.truth.rotation.mT):.2f}"
        moved = trajectory.commands[k - 1].rad2deg().tolist() if k else ()
        names = zip(hand.actuator_names, moved, strict=False)
        motion = ", ".join(f"{name} {value:+.1f}" for name, value in names if abs(value) >= 0.05)
        turned = f"{_angle(seen.rotation @ trajectory.observations[0].rotation.mT):.1f}"
        events = ", ".join(map(str, seen.info.get("events", ())))
        rows.append((f"{seen.time:.2f}", seen.status.value, turned, wrong, motion, events))
    return rows


def _held(
    plant: SimulatedHand,
    states: list[GraspState],
    forces: list[Tensor | None],
    captions: Captions,
    header: tuple[str, ...],
    rows: tuple[tuple[str, ...], ...],
) -> View:
    """Seen along the axis about which the object turns."""
    hand, axis = plant.hand, plant.rotation_axis
    scene = make_scene(hand, plant.object, *_arrays(states), np.array(hand.gravity), axis=axis.numpy())
    turned = np.array([math.degrees(float(one.minus(states[0])[-3:] @ axis)) for one in states])
    captions = replace(captions, turned=turned, forces=_forces_on(hand, states, forces))
    return View(scene, captions, header, rows)


def _arrays(states: list[GraspState]) -> tuple[Array, Array, Array]:
    parts = zip(*((s.q.numpy(), s.position.numpy(), s.rotation.numpy()) for s in states), strict=True)
    q, position, rotation = map(np.stack, parts)
    return q, position, rotation


def _forces_on(
    hand: HandDescription, states: Sequence[GraspState], forces: Sequence[Tensor | None]
) -> Array | None:
    """Those that are known, at their pads."""
    if all(force is None for force in forces):
        return None
    unknown = np.full(len(hand.pads), np.nan)
    sizes = [unknown if force is None else force.numpy() for force in forces]
    return pad_forces(hand, np.stack([state.q.numpy() for state in states]), np.stack(sizes))


def _truth(seen: Observation) -> GraspState:
    return seen.state if seen.truth is None else seen.truth.state


def _moved(before: GraspState, after: GraspState, axis: torch.Tensor) -> tuple[str, str]:
    """Angle about ``axis`` [deg], with its sign, and distance [mm]."""
    way = after.minus(before)
    return f"{math.degrees(float(way[-3:] @ axis)):.1f}", f"{1e3 * float(way[-6:-3].norm()):.1f}"


def _forces(hand: HandDescription, seen: Observation) -> str:
    """Of the pads that press."""
    assert seen.fingertip_force is not None  # the presets' hands have them
    forces = zip(hand.pads, seen.fingertip_force.tolist(), strict=True)
    return ", ".join(f"{pad.name} {force:.1f}" for pad, force in forces if force > 0.05)


def _angle(rotation: torch.Tensor) -> float:
    """[deg]"""
    return math.degrees(float(rotation_vector(rotation).norm()))
