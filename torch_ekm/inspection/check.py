"""Whether a hand is fit to be modelled and simulated: one row for each thing that can be wrong with it."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ..contact import ContactSet
from ..contact.contacts import contact_frames
from ..contact.pad_contact import signed_distance
from ..control import ClosedLoop, LookAndMoveController, PoseTarget
from ..control.ends import out_of_reach
from ..description import ContactPad, HandDescription, ObjectDescription, Shape, load_hand, load_object
from ..exceptions import EKMError, EquilibriumError, GraspError, MissingExtraError
from ..kinematics import ActuationMap, HandKinematics, LinkPoses
from ..model import KinematicModel, Linearization, ModelOptions, ModelStatus
from ..rendering import make_scene, save_picture
from ..simulation import PlantConfig, SimulatedHand, preset
from ..simulation.grasp_planning.blame import BorneProblem
from ..simulation.grasp_planning.pinch import pinch_problem, solve
from ..simulation.grasp_planning.pinch_problem import PinchGeometry, PinchRequest
from ..simulation.grasp_planning.requirements import direction_unmet
from ..simulation.grasp_planning.trials import smallest_changes
from ..simulation.mechanism.assembly import true_hand
from ..simulation.parameters import PlantParameters
from ..simulation.physics.links import x_axis_to
from . import Check, State

_SURFACE = 2e-4  # [m] between a pad and its link's collision shape, and of an object from its grasp_width
_RANGES = (0.05, 5.0)  # of what the joints allow; beyond them a figure has another unit
_LOW_MARGIN = 0.1  # of the friction cone
_CONTRADICT = 1e4  # [N/rad]: 100 N for 0.6 deg; soft actuators have some hundreds
_STABLE = 1e-6  # [N m/rad]; less is none
_TAUT = 1e-6  # [N m]
_LEAST_SLACK = 0.005  # of an actuator's range; less is a spring that just rests
_FRACTIONS = np.linspace(0.0, 1.0, 21)  # of an actuator's range
_LITTLE_TURN = math.radians(3.0)
_UNPLANNED = "pinch plan"
"""Row of a pinch that the planner refuses; one that is planned and lost is a "pinch"."""
_DISTURBED = 3  # pinches with the faults of the preset nominal


def check_hand(hand: str, object: str = "box", picture: Path | None = None) -> list[Check]:
    """Check a hand, and the pinch of an object (seed 0), from the files to the model's margins.

    Args:
        hand: name or path, as :func:`load_hand` takes it.
        object: name or path, as :func:`load_object` takes it.
        picture: file for a picture of the hand in the pinch, with the pads' directions (black) and the
            contact frames (red along the inward normal, tangents green and blue), and without the object,
            which hides them; or of the pinch that fails, its object seen through.

    Returns:
        The checks in the order in which faults are best corrected. A fault ends in a row, never in an error.
    """
    try:
        description = load_hand(hand).counted()
    except (EKMError, OSError) as error:
        return [Check("hand's files", "error", str(error), "see docs/reference/file_formats.md")]
    rows = [Check("hand's files", "ok", f"{description.n_q} joints, {description.n_a} actuators")]
    rows += [Check("assumed", "warning", note) for note in description.notes]
    pads = list(_pads(description))
    rows += [*pads, *_ranges(description), *_tensions(description)]
    try:
        obj = load_object(object)
    except (EKMError, OSError) as error:
        return [*rows, Check("object's files", "error", str(error), "see docs/reference/file_formats.md")]
    rows += [*_width(obj), *_rigid(description), *_reach(description, obj)]
    unfit = any(row.state == "error" for row in rows)
    pinch = list(_pinch(description, obj, picture))
    if any(row.state == "error" for row in pinch):
        if not unfit and (other := [row.name for row in pads if row.state != "ok"]):
            remedy = f"first paste the shapes of {', '.join(other)} as printed above"
            found = "parts of the hand other than the pads touch the object"
            told = [row for row in pinch if row.state == "error" or row.name == "picture"]
            return [*rows, Check("collision shapes", "error", found, remedy), *told]
        # no other figure cures a fault of the files
        unplanned = not unfit and any(row.name == _UNPLANNED for row in pinch)
        return [*rows, *pinch, *(_cured(description, obj, picture) if unplanned else ())]
    return [*rows, *pinch, *_turn(description, obj), *_disturbed(description, obj)]


def _pads(hand: HandDescription) -> Iterator[Check]:
    """Link, position [mm], direction and radius of each pad; its capsule is a collision shape of the link."""
    for pad in hand.pads:
        place = f"on {pad.link}, end {_vector(np.array(pad.end) * 1e3)} mm, "
        found = place + f"direction {_vector(pad.direction)}, radius {1e3 * pad.radius:g} mm"
        shapes, lack = hand.urdf.link(pad.link).collisions, direction_unmet(hand, pad)
        ends = np.array([pad.start, pad.end])
        depth = -signed_distance(shapes, ends)[0] if shapes else np.zeros(2)
        name, remedy = f"pad '{pad.name}'", _to_paste(hand, pad)
        if lack is not None:
            yield Check(name, "error", f"{found}; {lack[0]}", lack[1])
        elif not shapes:
            yield Check(name, "error", f"{found}; its link has no primitive shape", remedy)
        elif any(shape.kind == "box" and (signed_distance((shape,), ends)[0] < 0).all() for shape in shapes):
            balls = tuple(shape for shape in shapes if shape.kind != "box")
            if balls and np.abs(signed_distance(balls, ends)[0] + pad.radius).max() <= _SURFACE:
                remedy = "shorten that box, or take it out: the pad's own shape is there"
            yield Check(name, "warning", f"{found}; in a box, whose edges touch first", remedy)
        elif np.abs(depth - pad.radius).max() > _SURFACE:
            yield Check(name, "warning", f"{found}; not the shape of its link", remedy)
        else:
            yield Check(name, "ok", found)


def _to_paste(hand: HandDescription, pad: ContactPad) -> str:
    """The pad as the hand's own file has it: in an MJCF a capsule, in a URDF a cylinder with a ball on either
    end; or a ball."""
    ends = np.unique([pad.start, pad.end], axis=0)
    if hand.urdf_path.suffix != ".urdf":
        at = " ".join(f"{x:.6g}" for x in (ends - hand.urdf.link(pad.link).origin).ravel())
        kind = f'type="capsule" fromto="{at}"' if len(ends) > 1 else f'type="sphere" pos="{at}"'
        return f'paste into <body name=\'{pad.link}\'>: <geom {kind} size="{pad.radius:g}" contype="1"/>'
    x, y, z = ends[-1] - ends[0]
    rpy = f"0 {math.atan2(math.hypot(x, y), z):.6g} {math.atan2(y, x):.6g}"
    rod = f'<cylinder radius="{pad.radius:g}" length="{math.hypot(x, y, z):.6g}"/>'
    parts = [(end, "0 0 0", f'<sphere radius="{pad.radius:g}"/>') for end in ends]
    parts += [(ends.mean(axis=0), rpy, rod)] if len(parts) > 1 else []
    form = '<collision><origin xyz="{:.6g} {:.6g} {:.6g}" rpy="{}"/><geometry>{}</geometry></collision>'
    shapes = "".join(form.format(*at, turned, body) for at, turned, body in parts)
    return f"paste into <link name='{pad.link}'>: {shapes}"


def _ranges(hand: HandDescription) -> Iterator[Check]:
    """``a = offset + J_a q`` of the joints' ranges is about the actuator's range."""
    for actuator, arms in zip(hand.actuators, hand.actuation_jacobian, strict=True):
        pulled = arms != 0
        ends = arms[pulled] * np.stack([hand.joint_lower, hand.joint_upper])[:, pulled]
        lower, upper = (actuator.offset + bound.sum() for bound in (ends.min(axis=0), ends.max(axis=0)))
        share = (actuator.upper - actuator.lower) / (upper - lower) if upper > lower else math.nan
        if share < _RANGES[0] or share > _RANGES[1]:  # not of joints without limits
            own, free = (
                "{:.3g} to {:.3g} deg".format(*np.degrees(pair))
                for pair in ((actuator.lower, actuator.upper), (lower, upper))
            )
            found = f"range {own}; its joints and moment arms allow {free}"
            remedy = "'range' is in rad, 'range_deg' in deg; moment arms are ratios of radii, not m or mm"
            yield Check(f"range of '{actuator.name}'", "warning", found, remedy)


def _width(obj: ObjectDescription) -> Iterator[Check]:
    """The object's surface is half of ``grasp_width`` from the origin, along ``grasp_axis``."""
    ends = 0.5 * obj.grasp_width * np.stack([obj.grasp_axis, -obj.grasp_axis])
    off = float(np.abs(signed_distance(obj.shapes, ends)[0]).max())
    if off > _SURFACE:
        found = f"half of grasp_width = {obj.grasp_width:g} m is {1e3 * off:.3g} mm off its <collision>"
        remedy = "its thickness [m] along grasp_axis, through the origin of the object's frame"
        yield Check("object's width", "warning", found, remedy)


def _tensions(hand: HandDescription) -> Iterator[Check]:
    """Of each tendon in the hand that touches nothing, over the actuators' range."""
    lower, upper = hand.actuator_lower, hand.actuator_upper
    a = lower + _FRACTIONS[:, None] * (upper - lower)
    anywhere = np.full(hand.n_q, np.inf)  # stops oppose every tendon
    rods = tuple(replace(one, tendon=False) for one in hand.actuators)  # below 0: slack
    free = replace(hand, joint_lower=-anywhere, joint_upper=anywhere, actuators=rods)
    tension = ActuationMap(free).pull(torch.from_numpy(a)).numpy()
    for k, actuator in enumerate(hand.actuators):
        if not actuator.tendon:
            continue
        name, remedy = f"tendon '{actuator.name}'", "check its springs' stiffness, rest angles, and range"
        most = tension[:, k].max()
        if most <= _TAUT:
            yield Check(name, "error", "slack over its whole range: no spring opposes it", remedy)
        else:
            i = int(np.argmax(tension[:, k] > _TAUT))
            ends = slice(i - 1, i + 1)  # between two of them it becomes taut
            first = float(np.interp(_TAUT, tension[ends, k], _FRACTIONS[ends])) if i else 0.0
            at = f"{np.degrees(lower[k] + first * (upper[k] - lower[k])):.0f} deg"
            rest = "slack at rest, " if first > _LEAST_SLACK else ""
            state: State = "warning" if first > 0.5 else "ok"
            found = f"{rest}taut from {at}, up to {most:.2g} N m in free motion"
            yield Check(name, state, found, remedy if state == "warning" else "")


def _rigid(hand: HandDescription) -> Iterator[Check]:
    pairs = zip(hand.actuators, true_hand(hand, PlantParameters()).actuators, strict=True)
    capped = [f"{was.name} {now.stiffness:g}" for was, now in pairs if was.stiffness != now.stiffness]
    found = f"rigid, in simulation [N m/rad]: {', '.join(capped)}" if capped else "of finite stiffness"
    tendons = [one.name for one in hand.actuators if one.tendon and math.isinf(one.stiffness)]
    remedy = f"the 'stiffness' of cable and servo [N m/rad] of {', '.join(tendons)}" if tendons else ""
    yield Check("actuators", "warning" if tendons else "ok", found, remedy)


def _reach(hand: HandDescription, obj: ObjectDescription) -> Iterator[Check]:
    try:
        problem = pinch_problem(hand, obj, PlantConfig(), PlantParameters())
    except EKMError as error:
        yield Check("opposed pads", "error", str(error), "as the message says")
        return
    first, *others = (pad.name for pad in problem.pads)
    yield Check("opposed pads", "ok", f"pad {first} opposes {' and '.join(others)}")


def _cured(hand: HandDescription, obj: ObjectDescription, picture: Path | None) -> Iterator[Check]:
    """Changes with which the planner finds a pinch; the picture shows the one that fails."""
    if changes := smallest_changes(hand, obj, PlantConfig(), PlantParameters()):
        found = f"the pinch holds with {'; or '.join(changes)}"
        yield Check("smallest change", "warning", found, "any of these")
    else:
        found = "none found: no single change makes the pinch hold"
        yield Check("smallest change", "warning", found, "another object, or several changes at once")
    if picture is not None:
        with contextlib.suppress(EKMError, OSError):  # a row says so
            borne = BorneProblem(pinch_problem(hand, obj, PlantConfig(), PlantParameters()))
            failed = borne.geometry(solve(borne, PinchRequest(hand.pinch_force)).x[None])
            _draw(hand, None, picture, obj, failed)


def _turn(hand: HandDescription, obj: ObjectDescription) -> Iterator[Check]:
    """How far the model turns the pinched object: a pinch that holds may be at the edge of its friction."""
    remedy = "stiffer springs, another 'pinch_force', more friction, wider limits; a loop may turn it farther"
    try:
        plant = SimulatedHand(hand, obj)
        seen = plant.reset(0)
        model = KinematicModel(plant.hand, obj)
        controller = LookAndMoveController(model, plant.rotation_axis)
        loop = ClosedLoop(plant, controller)
        ends = [loop.reach(sign=sign) for sign in (-1, 1)]
        turn = PoseTarget.turned(seen.state, plant.rotation_axis, degrees=math.degrees(_LITTLE_TURN))
        few = out_of_reach(controller, seen, turn).partition(":")[0]
    except MissingExtraError:
        return
    except EKMError as error:
        yield Check("turn", "warning", str(error), remedy)
        return
    found = ", ".join(f"{round(math.degrees(end.angle)):+d} deg ({end.end})" for end in ends)
    little = min(abs(end.angle) for end in ends) < _LITTLE_TURN
    if few and little:
        found, remedy = f"{found}; {few}", "motors that move pads along the object: these press it"
    yield Check("turn", "warning" if little else "ok", f"predicted: {found}", remedy if little else "")


def _disturbed(hand: HandDescription, obj: ObjectDescription) -> Iterator[Check]:
    """Experiments and examples have faults in the hand."""
    failures: list[EKMError] = []
    for seed in range(_DISTURBED):
        try:
            SimulatedHand(hand, obj, preset="nominal").reset(seed)
        except MissingExtraError:
            return
        except EKMError as error:
            failures.append(error)
    found = f"{_DISTURBED - len(failures)} of {_DISTURBED} held with the usual faults"
    if failures:
        remedy = "a smaller 'pinch_force' in [hand], stiffer springs, more friction"
        if isinstance(failures[0], EquilibriumError):
            changes = smallest_changes(hand, obj, PlantConfig(), preset("nominal"))
            remedy = "; or ".join(changes) or remedy
        yield Check("pinch, preset nominal", "warning", f"{found}; {failures[0]}", remedy)
    else:
        yield Check("pinch, preset nominal", "ok", found)


def _pinch(hand: HandDescription, obj: ObjectDescription, picture: Path | None) -> Iterator[Check]:
    lin = seen = None
    try:
        plant = SimulatedHand(hand, obj)
        seen = plant.reset(0)  # as it is: the sensors have no noise
        assert seen.fingertip_force is not None  # of a simulated hand as described
        measured = zip(hand.pads, seen.fingertip_force.tolist(), strict=True)
        forces = ", ".join(f"{pad.name} {force:.1f}" for pad, force in measured if force > 0)
        yield Check("pinch", "ok", f"'{obj.name}' is held in simulation; forces [N]: {forces}")
        model = KinematicModel(plant.hand, obj, ModelOptions(on_unstable="flag"))
        contacts = model.contacts(seen.state)
        yield from _sides(hand, contacts, model.kinematics(seen.state.q))
        lin = model.linearize(seen.state, contacts, fingertip_force=seen.fingertip_force)
        yield from _grasp(hand, lin)
    except MissingExtraError as error:
        yield Check("pinch", "warning", f"not tried: {error}")
    except EKMError as error:
        what = "model" if seen is not None else _UNPLANNED if isinstance(error, EquilibriumError) else "pinch"
        found = f"{error}{_lost(plant) if isinstance(error, GraspError) else ''}"
        yield Check(what, "error", found, "see docs/reference/errors.md")
    if picture is not None:
        try:
            yield Check("picture", "ok", str(_draw(hand, lin, picture).resolve()))
        except (EKMError, OSError) as error:
            yield Check("picture", "warning", f"not drawn: {error}")


def _lost(plant: SimulatedHand) -> str:
    """What was left of the last pinch that did not hold, once the object was let go."""
    seen = plant.observe()  # as it is: the sensors have no noise
    assert seen.fingertip_force is not None
    away = float(np.linalg.norm(seen.position.numpy() - plant.plan.position))
    named = zip(plant.hand.pads, seen.fingertip_force.tolist(), strict=True)
    forces = ", ".join(f"{pad.name} {force:.1f}" for pad, force in named if pad.name in plant.plan.pads)
    return f"; {seen.time:.1f} s after closing: forces [N] {forces}, the object {1e3 * away:.0f} mm off"


def _sides(hand: HandDescription, contacts: ContactSet, poses: LinkPoses) -> Iterator[Check]:
    for finger, normal in zip(contacts.finger, contacts.normal.numpy(), strict=True):
        pad = next(pad for pad in hand.pads if pad.name == finger)
        if float(normal @ poses.of(pad.link)[:3, :3].numpy() @ pad.direction) > 0:
            remedy = f"'direction' of pad '{finger}', or the limits of its joints"
            yield Check("contact sides", "error", f"'{finger}' touches with its back", remedy)


def _grasp(hand: HandDescription, lin: Linearization) -> Iterator[Check]:
    """What the kinematic model says of the pinch."""
    stability, good = float(lin.stability), lin.status is ModelStatus.OK
    found = f"{stability:.2g} N m/rad with locked actuators; the model's status: {lin.status.value}"
    few = len(lin.contacts.finger) < 2  # the simulation lets any link hold, the model pads alone
    state: State = "error" if few or stability < _STABLE else "ok" if good else "warning"
    remedy = "" if state == "ok" else "stiffer springs, less force, pads that touch"
    yield Check("stability", state, found, remedy)
    answer = float(lin.normal_force_sensitivity.abs().max())
    if answer > _CONTRADICT:
        found = f"rigid actuators contradict each other: {answer:.1g} N/rad"
        yield Check("actuators in the pinch", "warning", found, "give them their true 'stiffness'")
    relative = lin.forces.relative_margin
    found = ", ".join(f"{n} {v:.2f}" for n, v in zip(lin.contacts.finger, relative.tolist(), strict=True))
    low = bool(relative.min() < _LOW_MARGIN)
    remedy = "a higher friction, or wider pads" if low else ""
    yield Check("friction margins", "warning" if low else "ok", f"{found} (1: no tangential load)", remedy)
    stopped = [name for name, held in zip(hand.joint_names, lin.held_joints, strict=True) if held]
    if stopped:
        found = f"a stop holds: {', '.join(stopped)}"
        yield Check("stops", "warning", found, "wider limits, stiffer springs")
    upstream = HandKinematics(hand).upstream.numpy()
    used = upstream[[hand.link_names.index(link) for link in lin.contacts.link]].any(axis=0)
    slack = [
        actuator.name
        for actuator, arms, lam in zip(hand.actuators, hand.actuation_jacobian, lin.forces.lam, strict=True)
        if actuator.tendon and arms[used].any() and -float(lam) <= 1e-4
    ]
    if slack:
        remedy = "stiffer springs or other rest angles"
        yield Check("tendons in the pinch", "warning", f"slack: {', '.join(slack)}", remedy)


def _draw(
    hand: HandDescription,
    lin: Linearization | None,
    path: Path,
    obj: ObjectDescription | None = None,
    failed: PinchGeometry | None = None,
) -> Path:
    """The hand with a rod along each pad's direction and the axes of each contact frame; or a pinch that
    fails, its object seen through."""
    if failed is not None:
        q, place = torch.from_numpy(failed.q[0]), (failed.position, failed.rotation)
    else:
        rest = torch.from_numpy(hand.spring_rest.clip(hand.joint_lower, hand.joint_upper))
        q, place = rest if lin is None else lin.state.q, (None, None)
    scene = make_scene(hand, obj, q[None].numpy(), *place, np.array(hand.gravity))
    scene = replace(scene, ghosts=0 if obj is None else len(obj.shapes))
    poses, rods = HandKinematics(hand)(q), []
    for pad in hand.pads:
        T = poses.of(pad.link).numpy()
        along = T[:3, :3] @ pad.direction
        rods.append((T[:3, :3] @ pad.end + T[:3, 3] + pad.radius * along, along, 0.01, (0.1, 0.1, 0.1)))
    if lin is not None:
        plane = None if hand.planar_normal is None else torch.tensor(hand.planar_normal, dtype=q.dtype)
        frames = contact_frames(lin.contacts.normal, plane).numpy()
        for point, frame in zip(lin.contacts.point.numpy(), frames, strict=True):
            rods += [(point, frame[:, k], 0.02, tuple(np.eye(3)[k].tolist())) for k in range(3)]
    shapes, transforms = [], []
    for start, along, length, colour in rods:
        T = x_axis_to(along)[:, [1, 2, 0, 3]]  # a cylinder lies along z
        T[:3, 3] = start + length / 2 * along
        shapes.append((Shape("cylinder", (0.0008, length), np.eye(4)), colour))
        transforms.append(T[None, None])
    shapes += scene.shapes  # what is seen through comes last
    transforms.append(scene.transforms)
    return save_picture(replace(scene, shapes=shapes, transforms=np.concatenate(transforms, axis=1)), path)


def _vector(values: object) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in np.asarray(values, dtype=np.float64) + 0.0) + ")"
