"""What is done with one hand, one controller and one seed: trials one after the other, a row each.

A row has the trial's record and figures of its own. ``make(item)`` is a new bench with an object.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch

from torch_ekm.control import Direction, FocusedPose, Manipulation, PoseTarget, StopReason
from torch_ekm.exceptions import EKMError, GraspError
from torch_ekm.experiments.protocols.generalize import Generalize
from torch_ekm.experiments.records import NOT_GRASPED, Trial, TrialRecord, true_state
from torch_ekm.experiments.runner import FIRST_GRASP, Bench
from torch_ekm.kinematics import GraspState
from torch_ekm.typing import Tensor

_DEG = math.pi / 180
_SI = {"deg": _DEG, "mm": 1e-3}
_FAR = 3000  # number of the grasp of the turn that goes as far as it can
_LEAST_ASKED = 0.01 * _DEG  # of a motor that is to move
_MADE = 0.8  # of a movement: one that was ended on its way says nothing of the band at its end
Make = Callable[[str], Bench]


def row(record: TrialRecord, **figures: Any) -> TrialRecord:
    """A record with figures of its own."""
    return replace(record, more=figures)


def turns(
    make: Make,
    items: Sequence[str],
    seed: int,
    *,
    angles: Sequence[float] | None,
    learns_by: Sequence[float] | int = (),
    all_learn: bool = False,
) -> list[TrialRecord]:
    """Turns of an object from fresh grasps, after those in which the hand is learned.

    Args:
        angles: None: those of the paper's Table I, or by its rule [deg].
        learns_by: the E-KM alone makes these first, unless ``all_learn``; a number: so many of the median.
    """
    (item,) = items
    bench = make(item)
    angles = Generalize().angles_of(item) if angles is None else angles
    first = [float(np.median(angles))] * learns_by if isinstance(learns_by, int) else learns_by
    first = first if bench.learns or all_learn else ()
    asked = [(FIRST_GRASP + k, angle, "learning" if k else "first") for k, angle in enumerate(first)]
    made = []
    for trial, angle, kind in [*asked, *((k, angle, "turn") for k, angle in enumerate(angles))]:
        record = bench.trial(seed, trial, angle, kind)
        if record.grasped and bench.last is not None:
            made.append(
                row(record, bands=_bands(bench.last, bench.hand.rotation_axis), **_readings(bench.last))
            )
        else:
            made.append(row(record, bands=[]))
    bench.close()
    return made


def _bands(done: Manipulation, axis: Tensor) -> list[Any]:
    """Of each planned movement that was made: its pieces, and its end in standard deviations of the band:
    about the axis, off it, normal forces."""
    found: list[Any] = []
    for step in done.steps:
        asked, band = step.decision.delta_a, step.decision.band
        if band is None or not step.decision.turns or float(step.pull @ asked) < _MADE * float(asked @ asked):
            continue
        rest = axis @ (step.increment - step.decision.predicted)[-3:]
        off = done.focus.off_rotation(done.target.error(step.after.state)) - band.off
        forces, felt = [], step.after.fingertip_force
        if felt is not None and band.force is not None and band.force_std is not None:
            forces = ((felt - band.force) / band.force_std).tolist()
        about = float(rest / (axis * band.twist_std[-3:]).norm())
        known = [z for z in forces if math.isfinite(z)]
        found.append([len(step.decision.pieces), about, off / max(band.off_std, 1e-9), known])
    return found


def _readings(done: Manipulation) -> dict[str, float]:
    """rms of what joints were measured less the truth, and of what motors did less what was asked [deg]."""
    joints = [(step.before.q - true_state(step.before).q).square().mean() for step in done.steps]
    asked = [(step.decision.delta_a, step.after.a - step.before.a) for step in done.steps]
    missed = [(made - wish)[wish.abs() > _LEAST_ASKED].square() for wish, made in asked]
    motors = torch.cat(missed) if missed else torch.zeros(0)
    return {
        "joints": float(torch.stack(joints).mean().sqrt()) / _DEG if joints else math.nan,
        "motors": float(motors.mean().sqrt()) / _DEG if len(motors) else math.nan,
    }


def _warmed(make: Make, item: str, seed: int, angles: Sequence[float]) -> Bench:
    bench = make(item)
    for k, angle in enumerate(angles if bench.learns else ()):
        bench.trial(seed, FIRST_GRASP + k, angle, "learning")
    return bench


def axes_of(bench: Bench) -> dict[str, Tensor]:
    """Of the grasp that is held (hand frame): a, about which the pinch turns the object; b, from the thumb to
    the fingers; c, across both."""
    points, a = bench.hand.plan.points, bench.hand.rotation_axis
    across = torch.as_tensor(points[1:].mean(axis=0) - points[0])
    b = across - a * (across @ a)
    b = b / torch.linalg.vector_norm(b)
    return {"a": a, "b": b, "c": torch.linalg.cross(a, b)}


def there_and_back(
    make: Make, items: Sequence[str], seed: int, *, learns_by: Sequence[float], angle: float, times: int
) -> list[TrialRecord]:
    """One grasp turned to ``angle`` and back until the object is lost; the same turns from fresh grasps."""
    bench = _warmed(make, items[0], seed, learns_by)
    start, made = bench.grasp(seed, 0), []
    before = bench.hand.observe() if start is not None else None
    for k in range(2 * times):
        if start is None or before is None:
            break
        axes, back = axes_of(bench), k % 2 == 1
        about = Trial(bench.name, "turn", bench.controller, seed, k, 0.0 if back else angle)
        record = bench.turn(about, start)
        assert bench.last is not None
        states = true_state(before), true_state(bench.last.stop.final)
        shift = {name: 1e3 * float(axes[name] @ (states[1].position - states[0].position)) for name in "abc"}
        slid = 0.0 if record.lost else _slid(bench, *states)
        counted = replace(record, angle_deg=angle)  # a lost object counts with the whole turn
        made.append(row(counted, part="series", back=back, shift=shift["b"], slid=slid))
        if record.lost:
            break
    for k in range(1, 1 + min(times, 5)):
        made.append(row(bench.trial(seed, k, angle), part="fresh grasps", back=False))
    bench.close()
    return made


def _slid(bench: Bench, before: GraspState, after: GraspState) -> float:
    """How far the contacts have moved on the object, mean of the pads that touch it both times [mm]."""
    places = []
    for state in (before, after):
        try:
            found = bench.model.contacts(state)
        except EKMError:  # no finger holds it
            return 0.0
        places.append(dict(zip(found.finger, (found.point - state.position) @ state.rotation, strict=True)))
    moved = [float((places[1][pad] - place).norm()) for pad, place in places[0].items() if pad in places[1]]
    return 1e3 * float(np.mean(moved)) if moved else 0.0


class Part(NamedTuple):
    """What is asked of one direction."""

    unit: str
    axis: str
    size: float


def _targets() -> dict[str, list[tuple[Part, ...]]]:
    """Group -> targets, each by its directions."""
    groups: dict[str, list[tuple[Part, ...]]] = {}
    for sign in (1, -1):
        for axis in "abc":
            shift = Part("mm", axis, 3.0 * sign)
            one = {
                "turn 8 deg": (Part("deg", axis, 8.0 * sign),),
                "shift 3 mm": (shift,),
                "turn 8 deg about a, shift 3 mm": (Part("deg", "a", 8.0), shift),
                "shift 6 mm": (Part("mm", axis, 6.0 * sign),),
            }
            for group, parts in one.items():
                groups.setdefault(group, []).append(parts)
        turned = tuple(Part("deg", x, 8.0 * sign * (x == "a")) for x in "abc")
        shifts = {x: Part("mm", x, 3.0 * sign * (x == "b")) for x in "abc"}
        groups.setdefault("all but shifts along a", []).append((*turned, shifts["b"], shifts["c"]))
        groups.setdefault("all but shifts along c", []).append((*turned, shifts["a"], shifts["b"]))
        groups.setdefault("whole pose", []).append((*turned, *shifts.values()))
    return groups


TARGETS = _targets()


def target_of(start: GraspState, parts: Sequence[Part], axes: dict[str, Tensor]) -> PoseTarget:
    """Turned first, then moved."""
    target = PoseTarget(start.position, start.rotation)
    for unit, axis, size in parts:
        if unit == "deg":
            target = PoseTarget.turned(target, axes[axis], degrees=size)
        else:
            target = PoseTarget.moved(target, axes[axis], millimetres=size)
    return target


def directions(
    make: Make,
    items: Sequence[str],
    seed: int,
    *,
    learns_by: Sequence[float],
    groups: Sequence[str],
    within: dict[str, float],
    stricter: float,
) -> list[TrialRecord]:
    """Every target from a grasp of its own; what the model finds out of reach is declined.

    Args:
        within: true errors that are called near, by unit; ``size`` of a trial is in these.
        stricter: share of them that the loop asks of its noisy readings.
    """
    bench, made = _warmed(make, items[0], seed, learns_by), []
    every = [(group, parts) for group in groups for parts in TARGETS[group]]
    for k, (group, parts) in enumerate(every):
        start = bench.grasp(seed, k)
        if start is None:
            continue
        axes = axes_of(bench)
        focus = FocusedPose(
            [Direction(axes[axis], unit, tolerance=stricter * within[unit]) for unit, axis, _ in parts]
        )
        target = target_of(start, parts, axes)
        done = bench.closed_loop(bench.plant, focus, decline=True).run(target)
        wrong = (focus.matrix @ target.error(true_state(done.stop.final))).abs().tolist()
        errors: dict[str, float] = {}
        for (unit, *_), error in zip(parts, wrong, strict=True):
            errors[unit] = max(errors.get(unit, 0.0), error / _SI[unit])
        about = Trial(bench.name, "turn", bench.controller, seed, k, max(part.size for part in parts))
        record = TrialRecord.of(about, done, bench.hand.rotation_axis, learns=bench.learns)
        figures = {"wrong_deg": errors.get("deg"), "wrong_mm": errors.get("mm")}
        size = max(error / within[unit] for unit, error in errors.items())
        if done.reason is StopReason.OUT_OF_REACH:  # declined: nothing was tried
            figures, size = dict.fromkeys(figures), math.inf
        made.append(row(record, group=group, size=size, **figures))
    bench.close()
    return made


def foresight(
    make: Make, items: Sequence[str], seed: int, *, learns_by: Sequence[float], far: float
) -> list[TrialRecord]:
    """A turn as far as the grasp goes, and what was predicted of it."""
    bench, made = _warmed(make, items[0], seed, learns_by), []
    start = bench.grasp(seed, _FAR)
    about = Trial(bench.name, "turn", bench.controller, seed, _FAR, far)
    if start is None:
        made.append(row(TrialRecord(**vars(about), reason=NOT_GRASPED, message=bench.no_grasp)))
    else:
        reach, ends = _reach(bench, far)
        record = bench.turn(about, start)
        assert bench.last is not None
        axis = bench.hand.rotation_axis
        seen = [*(step.before for step in bench.last.steps), bench.last.stop.final]
        held = [true_state(at) for at in (seen[:-1] if record.lost and len(seen) > 1 else seen)]
        largest = max(float(axis @ at.minus(held[0])[-3:]) for at in held) / _DEG
        made.append(row(record, largest=largest, reach=reach, ends=ends))
    bench.close()
    return made


def _reach(bench: Bench, angle: float) -> tuple[float, str]:
    """How far the model says that the grasp turns [deg], and what it says that ends it."""
    try:
        found = bench.closed_loop(bench.plant).reach(sign=1, limit=angle * _DEG)
    except GraspError:  # it refuses the grasp
        return math.nan, "refused"
    return found.angle / _DEG, str(found.end)
