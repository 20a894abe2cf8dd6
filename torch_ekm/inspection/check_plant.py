"""Whether a real hand is wired as its description says: found with motions of 1 deg, before anything else."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import torch

from ..description import HandDescription, ObjectDescription
from ..drivers import Wiring
from ..exceptions import EKMError, GraspError
from ..kinematics import ActuationMap, HandKinematics
from ..model import KinematicModel
from ..plant import Gate, Observation, Path, Plant, PlantStatus, can_follow
from ..typing import Array
from . import Check
from .wirings import Mistake, Motion, Readings, WiringTest

_DEG = math.pi / 180
_STEPS = (0.1 * _DEG, 1 * _DEG, 2 * _DEG, 4 * _DEG)  # larger ones where dead zones swallow the smaller
_MOVED, _STANDS = 0.9 * _DEG, 0.3 * _DEG
_WILD = 4 * _DEG  # [rad] more than any of these commands may move
_LOOKS = 20
_FITS = 1.8  # times the tolerance
_NEAR = 2.0  # of the best explanation's sum of squares: as good
_ALIKE = 3  # pairs of mistakes; more say nothing
_FAR = 0.12  # [m] of an object from the middle of the pads
_CLOCK = "Observation(time=time.monotonic(), ...) in the driver"
_ANGLE = 0.3  # cosine between predicted and measured motion of the object
_TURNED = 0.5 * _DEG  # [rad] of the object that show how it turns


def check_plant(
    plant: Plant, description: HandDescription, object: ObjectDescription | None = None
) -> list[Check]:
    """Check the wiring of a hand: at rest first, then with motions of 1 deg, one motor after the other.

    Found are: a wrong sign or unit, swapped motors or joints, a zero that is off by half a turn, two of these
    at once, a motor or a sensor that is dead or constant, a clock that stands or is missing, float32, a pose
    in another frame. Explanations that fit as well begin with "or instead".
    Nothing moves while readings at rest contradict each other. Where dead zones swallow 1 deg, 2 and 4 deg
    are tried; each motor goes back. While an object is held, motors that shape the hand rest.

    Args:
        plant: opened, and reset if it needs that. A :class:`~torch_ekm.drivers.HandDriver` inside it gives
            the lines of its wiring file.
        description: what the hand is.
        object: what it holds; its pose is then checked, and signs where joints have no sensors.

    Returns:
        A row for each thing; with "error" and a remedy where it is wrong.
    """
    return list(_Checked(plant, description, object).rows())


class _Checked:
    def __init__(self, plant: Plant, hand: HandDescription, obj: ObjectDescription | None) -> None:
        self.plant, self.hand = plant, hand
        self.model = None if obj is None else KinematicModel(hand, obj)
        self._gate = Gate(plant, hand)
        self.wiring: Wiring | None = getattr(plant, "wiring", None)
        middle = torch.from_numpy((hand.actuator_lower + hand.actuator_upper) / 2)
        self.free = ActuationMap(hand).free_motion(middle).numpy()
        self.looks: list[Observation] = []

    def rows(self) -> Iterator[Check]:
        try:
            seen = self._look()
        except EKMError as error:
            yield Check("sensors", "error", str(error), "correct this first")
            return
        for note in getattr(self.plant, "notes", ()):
            yield Check("bus", "ok", note)
        yield from self._clock(seen)
        yield self._dtype(seen)
        sensed = seen.info.get("sensed", self.hand.joint_names)
        self.sensed = np.array([name in sensed for name in self.hand.joint_names])
        self.test = WiringTest(self.hand, self.sensed, self.wiring)
        a, q = self._mean()
        readings = Readings(a, q)
        if (self.test.misfit(readings) > _FITS).any():
            yield from self._explained(readings)
            found = "not moved, and no pose checked: judged from readings at rest"
            yield Check("motors", "warning", found, "correct this, and check again")
            return
        yield from self._place(seen)
        blind = [n for n, found in zip(self.hand.actuator_names, self.test.rows, strict=True) if not found]
        watched = self.model is not None and seen.status is PlantStatus.HELD  # the object shows the signs
        if blind and not watched:
            found = f"not checked: no sensors at the joints of {', '.join(blind)}"
            remedy = "look which way each goes, or check_plant(WithPose(...), hand, object) with an object"
            yield Check("signs", "warning", found, remedy)
        sensors = f"encoders and {int(self.sensed.sum())} joint sensors agree"
        yield Check("at rest", "ok", sensors if self.sensed.any() else "encoders are within their ranges")
        if getattr(self.plant, "dry_run", False):
            yield self._rehearsed(seen)
            return
        motions, rows = self._motions(seen)
        yield from rows
        if motions and seen.dated and not self.looks[-1].time > seen.time:
            yield Check("clock", "error", f"the clock stands at {seen.time:g} s", _CLOCK)
        yield from self._constant(motions)
        readings = Readings(a, q, motions)
        if (self.test.misfit(readings) > _FITS).any():
            yield from self._explained(readings)
        elif not any(row.state == "error" for row in rows):
            found = f"{len(motions)} motors go as commanded"
            if self.sensed.any():
                found += ", and joints with them"
            elif not watched:
                found += "; without joint sensors signs, order and units are not checked"
            yield Check("wiring", "ok", found)
            if can_follow(self.plant):
                yield self._follows()

    # -- single readings ----------------------------------------------------------------------------

    def _clock(self, seen: Observation) -> Iterator[Check]:
        if not seen.dated:
            found = "readings have no date: guards against frozen sensors are off"
            yield Check("clock", "error", found, _CLOCK)
        elif seen.time < self.looks[0].time:
            yield Check("clock", "error", "the clock goes back", _CLOCK)
        else:
            took = seen.time - self.looks[0].time
            found = f"{took:.3g} s for {_LOOKS} readings" if took else "no new date yet"
            yield Check("clock", "ok", found)

    def _dtype(self, seen: Observation) -> Check:
        kinds = {n: getattr(seen, n).dtype for n in ("q", "a", "position", "rotation")}
        wrong = [name for name, kind in kinds.items() if kind != torch.float64]
        if not wrong:
            return Check("precision", "ok", "float64")
        found = f"{', '.join(wrong)}: {str(kinds[wrong[0]]).removeprefix('torch.')}"
        return Check("precision", "error", found, "torch.tensor(..., dtype=torch.float64) in the driver")

    def _place(self, seen: Observation) -> list[Check]:
        """The object is between the pads."""
        if seen.status is not PlantStatus.HELD:
            found = "the object is not seen: its pose is not checked"
            remedy = "in Python, check_plant(WithPose(driver, camera), hand, object)"
            return [Check("pose", "warning", found, remedy)]
        remedy = "give WithPose(frame=<pose of the camera's frame in the hand frame>), or correct it"
        links = HandKinematics(self.hand)(seen.q.double())
        away = math.inf
        for pad in self.hand.pads:
            pose, middle = links.of(pad.link), (np.array(pad.start) + pad.end) / 2
            point = pose[:3, :3] @ torch.from_numpy(middle) + pose[:3, 3]
            away = min(away, float((point - seen.position.double()).norm()))
        if away > _FAR:
            found = f"the object is {1e3 * away:.0f} mm away from the nearest pad"
            return [Check("pose", "error", f"{found}: the pose is in another frame, or in mm", remedy)]
        if self.model is None:
            found = f"{1e3 * away:.0f} mm from the nearest pad; contacts are not checked: no object is given"
            return [Check("pose", "ok", found)]
        try:
            self.model.linearize(_double(seen).state)
        except GraspError as error:
            return [Check("pose", "error", f"no grasp at this pose: {error}", remedy)]
        return [Check("pose", "ok", "pads touch the object where the pose has it")]

    # -- motions ------------------------------------------------------------------------------------

    def _rehearsed(self, seen: Observation) -> Check:
        """A dry run has the first motion of each motor printed; nothing shows how they go."""
        for i, a in enumerate(seen.a.tolist()):
            delta = torch.zeros(self.hand.n_a, dtype=torch.float64)
            delta[i] = self._sign(i, a) * _DEG
            self._gate.command(delta, by="check")
        return Check("motors", "warning", "not checked: a dry run moves nothing", "once more, without it")

    def _sign(self, i: int, a: float) -> float:
        """Where a motor has room."""
        return 1.0 if self.hand.actuator_upper[i] - a > 2 * _STEPS[-1] else -1.0

    def _motions(self, seen: Observation) -> tuple[tuple[Motion, ...], list[Check]]:
        motions, rows, jacobian = [], [], None
        held = seen.status is PlantStatus.HELD
        if held and self.model is not None:
            with contextlib.suppress(GraspError):  # said already
                lin = self.model.linearize(_double(seen).state)
                eye = torch.eye(self.hand.n_a, dtype=torch.float64)
                jacobian = torch.stack([lin.step(one) for one in eye], dim=1).numpy()
        gain = jacobian[: self.hand.n_q] if jacobian is not None else None if held else self.free
        along: list[tuple[Array, Array]] = []
        for i, actuator in enumerate(self.hand.actuators):
            if held and actuator.posture:
                continue
            try:
                motion, row, pose = self._motion(i)
            except EKMError as error:
                rows.append(self._wrong(i, str(error), ""))
                break
            rows += [row] if row is not None else []
            if motion is None:
                continue
            if jacobian is not None:
                predicted = jacobian[-6:] @ motion.a
                along.append((predicted, pose))
                # no joint sensor shows it
                if not self.test.rows[i] and self._cosine(predicted, pose) <= -0.5:
                    found = "the object moves against what the model predicts: sign reversed"
                    rows.append(self._wrong(i, found, "sign"))
            motions.append(replace(motion, gain=gain))
            most = max(np.abs(motion.a).max(), np.abs(motion.q[self.sensed]).max(initial=0))
            if row is not None or most > 2 * _WILD:
                break
        if along and not any(row.state == "error" for row in rows):
            rows += self._frame(along)
        return tuple(motions), rows

    def _follows(self) -> Check:
        """A movement of 1 deg and back, in 0.2 s; the first motor that may move makes it."""
        held = self.looks[-1].status is PlantStatus.HELD
        i = next(k for k, one in enumerate(self.hand.actuators) if not (held and one.posture))
        way, passed = torch.zeros(2, self.hand.n_a, dtype=torch.float64), []
        way[0, i] = self._sign(i, float(self._look().a[i])) * _DEG
        path = Path.through(way, 10 * _DEG)
        try:
            self._gate.follow(path, lambda seen: passed.append(seen) or True, by="check")
        except EKMError as error:
            return Check("follow", "error", str(error), "correct follow() of the driver, or leave it out")
        if not passed:
            found = "no reading on the way: nothing can end a movement"
            return Check("follow", "warning", found, "give watch the readings as they come")
        return Check("follow", "ok", f"a movement through 2 waypoints, {len(passed)} readings on the way")

    def _motion(self, i: int) -> tuple[Motion | None, Check | None, Array]:
        """The smallest motion of a motor that shows, and back; what is wrong at once."""
        before = self._look()
        a0, q0 = self._mean()
        sign, delta = self._sign(i, a0[i]), torch.zeros(self.hand.n_a, dtype=torch.float64)
        for step in _STEPS:
            delta[i] = sign * step
            self._gate.command(delta, by="check")
            after = self._look()
            a1, q1 = self._mean()
            noise = torch.stack([o.q.double() for o in self._last]).std(0).numpy() * math.sqrt(2 / _LOOKS)
            motion = Motion(a1 - a0, q1 - q0, None, noise)
            most = np.abs(np.concatenate([motion.a, motion.q[self.sensed]])).max()
            if abs(motion.a[i]) > _MOVED or most > _WILD:
                break
        pose = _double(after).state.minus(_double(before).state)[-6:].numpy()
        went, others = motion.a[i] * sign, np.where(np.arange(len(a0)) == i, 0, np.abs(motion.a))
        k, kept, found, key = int(np.argmax(others)), motion, "", ""
        gone = f"its encoder went {went / _DEG:.3g} deg where {step / _DEG:.3g} deg were commanded"
        if others[k] > max(_MOVED, abs(went)):
            other = self.hand.actuator_names[k]
            found, key = f"encoder '{other}' moves in its place: two motors are swapped", "id"
        elif went < -_STANDS:
            found, key = f"{gone}: the sign of commands or of the encoder is wrong", "sign"
        elif went > 3 * step + _MOVED:
            found, key = f"{gone}: commands have another unit", "per_rad"
        elif went < _STANDS:
            moved = np.abs(self.hand.actuation_jacobian[i] @ motion.q) > _MOVED and self.test.rows[i]
            found = "its encoder stands still while its joints move" if moved else "it does not move"
            found, key = f"{found} (4 deg commanded)", "id"
            kept = None
        if found:
            return kept, self._wrong(i, found, key), pose
        delta[i] = -motion.a[i]
        self._gate.command(delta, by="check")
        return motion, None, pose

    def _frame(self, along: list[tuple[Array, Array]]) -> list[Check]:
        predicted, pose = (np.concatenate(list(part)) for part in zip(*along, strict=True))
        turns = np.tile([0.0] * 3 + [1.0] * 3, len(along))
        cosine = self._cosine(predicted, pose)
        turned = self._cosine(predicted * turns, pose * turns)
        if cosine <= _ANGLE:
            found = f"the object moves otherwise than the model predicts (cosine {cosine:.2f}): another frame"
            return [Check("pose's motions", "error", found, "give WithPose(frame=...), or correct it")]
        if turned < _ANGLE and np.abs(predicted * turns).max() > _TURNED:
            found = f"the object turns otherwise than the model predicts (cosine {turned:.2f})"
            remedy = "the rotation is that of the object in the hand frame: is it transposed?"
            return [Check("pose's motions", "warning", found, remedy)]
        return [Check("pose's motions", "ok", f"as the model predicts (cosine {cosine:.2f})")]

    @staticmethod
    def _cosine(predicted: Array, pose: Array) -> float:
        scale = np.tile([50.0] * 3 + [1.0] * 3, len(pose) // 6)  # 20 mm is a radian
        x, y = predicted * scale, pose * scale
        return float(x @ y / max(np.linalg.norm(x) * np.linalg.norm(y), 1e-12))

    # -- what explains it ---------------------------------------------------------------------------

    def _explained(self, readings: Readings) -> Iterator[Check]:
        """The single mistake that explains what was read, else two, or those that explain it alike."""
        singles = ((one,) for one in self.test.mistakes(readings))
        found = self._fitting(singles) or self._fitting(self.test.pairs(readings))
        # a scale or a zero fits readings at rest by chance: a swap that fits is then listed, too
        alike = [
            one
            for one in found
            if one[0] <= found[0][0] + _NEAR
            or (not readings.motions and len(one[1]) == 1 and one[1][0].key == "id")
        ]
        if not alike or (len(alike[0][1]) > 1 and len(alike) > _ALIKE):
            off = readings.a - self.hand.unloaded(readings.q)
            i = int(np.argmax(np.where(self.test.rows, np.abs(off), 0)))
            by = f"{off[i] / _DEG:.3g} deg"
            what = f"its encoder and the sensors of its joints differ by {by}, or move otherwise"
            more = ", or the zeros of its joints; several entries may be wrong"
            yield self._wrong(i, what, "zero", more)
            return
        for number, (_, mistakes) in enumerate(alike):
            name, what = mistakes[0].where, mistakes[0].what
            if len(mistakes) > 1:
                name, what = "wiring", "; ".join(f"{one.where}: {one.what}" for one in mistakes)
            remedies = [self._remedy(one.kind, n, one.key) for one in mistakes for n in one.names]
            yield Check(name, "error", f"{'or instead: ' if number else ''}{what}", "; ".join(remedies))

    def _fitting(self, candidates: Iterable[tuple[Mistake, ...]]) -> list[tuple[float, tuple[Mistake, ...]]]:
        """Those without which all readings fit, with their sums of squares, the best first."""
        found = []
        for mistakes in candidates:
            misfit = self.test.misfit(mistakes[-1].readings)
            if (misfit <= _FITS).all():
                score = float(np.square(misfit).sum()) + sum(one.penalty for one in mistakes)
                found.append((score, mistakes))
        return sorted(found, key=lambda one: one[0])

    def _constant(self, motions: tuple[Motion, ...]) -> Iterator[Check]:
        """Joint sensors that read the same, bit by bit, while motors moved: left out from here on."""
        moves = np.abs([self.free @ motion.a for motion in motions]).max(axis=0, initial=0.0)
        read = torch.stack([seen.q for seen in self.looks])
        dead = (read == read[0]).all(0).numpy() & self.sensed & (moves > _STANDS)
        for j in np.flatnonzero(dead):
            found = "its sensor reads the same, bit by bit, while its motor moves"
            name = self.hand.joint_names[j]
            remedy = self._remedy("joints", name, "id") + ", or its cable"
            yield Check(f"joint '{name}'", "error", found, remedy)
        self.test = WiringTest(self.hand, self.sensed & ~dead, self.wiring)

    # -- inside -------------------------------------------------------------------------------------

    def _look(self) -> Observation:
        self._last = [self.plant.observe() for _ in range(_LOOKS)]
        self.looks += self._last
        return self._last[-1]

    def _mean(self) -> tuple[Array, Array]:
        """Of the last looks: a, q [rad]."""
        a, q = (torch.stack([getattr(o, name).double() for o in self._last]).mean(0) for name in "aq")
        return a.numpy(), q.numpy()

    def _wrong(self, i: int, found: str, key: str, more: str = "") -> Check:
        """Of a motor."""
        name = self.hand.actuator_names[i]
        return Check(f"motor '{name}'", "error", found, self._remedy("motors", name, key) + more)

    def _remedy(self, kind: str, name: str, key: str) -> str:
        if self.wiring is None:
            return f"{key or 'wiring'} of '{name}' in the driver"
        return f"{self.wiring.path}:{self.wiring.line(kind, name, key)}: {key or 'wiring'} of '{name}'"


def _double(seen: Observation) -> Observation:
    parts = {name: getattr(seen, name).double() for name in ("q", "a", "position", "rotation")}
    return replace(seen, **parts)
