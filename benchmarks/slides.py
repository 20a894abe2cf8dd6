"""Contacts that slide, open and close, and links that bear, for the question ``slides`` of the matrix.

A look-and-move controller turns each object by more than it bears, in a hand as described. Before every
motion the kinematic model, whose contacts stick, and ``KinematicModel.step`` predict from the true state
where it ends; a row is a motion. Friction in MuJoCo is a round cone, in SAPIEN (PhysX) a pyramid.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import torch

from torch_ekm.control import FocusedPose, LimitingFunction, LookAndMoveController, PoseTarget, StopReason
from torch_ekm.exceptions import GraspError
from torch_ekm.experiments.records import Trial, TrialRecord, true_state
from torch_ekm.experiments.reporting.plots import COLOURS, new_figure
from torch_ekm.experiments.reporting.report import Cell, Column, Table
from torch_ekm.experiments.runner import Bench
from torch_ekm.kinematics import GraspState
from torch_ekm.model import ContactMode, ContactMotion, KinematicModel, ModelOptions
from torch_ekm.plant import Observation, PlantStatus
from torch_ekm.simulation import SimulatedHand

DEG = np.pi / 180
SLIP = 5e-5  # [m] of a motion that slips
_FAR = 40.0  # [deg] more than most grasps bear
KINDS: dict[str, Callable[[Any], Any]] = {
    "no slip, no link": lambda m: (m["slid"] <= SLIP) & (m["links"] == 0),
    "slid more than 0.05 mm": lambda m: m["slid"] > SLIP,
    "a link touches": lambda m: m["links"] > 0,
    "all": lambda m: m["slid"] >= 0,
}


class Witness:
    """The simulator's truth about contacts: how far each slides, summed over frames; rolling is none."""

    def __init__(self, plant: SimulatedHand) -> None:
        options = ModelOptions(on_unstable="flag", max_overlap=0.02)
        self.model: Any = KinematicModel(*plant.true_descriptions(), options)
        self.frames: list[GraspState] = []
        rig: Any = plant._rig
        self._scene = rig.scene
        self._step, self._count = self._scene.step, 0
        self._scene.step = self._stepped

    def _stepped(self, *arguments: Any) -> None:
        """A physics step; every tenth state is kept."""
        self._step(*arguments)
        self._count += 1
        if self._count % 10 == 0:
            seen = (self._scene.q, *self._scene.object_pose)
            self.frames.append(GraspState(*(torch.from_numpy(np.asarray(x)) for x in seen)))

    def slips(self) -> dict[str, float]:
        """How far each contact point slid since the last call [m]."""
        total: dict[str, torch.Tensor] = {}
        found = [
            (at, poses := self.model.kinematics(at.q), self.model.detector(poses, at.position, at.rotation))
            for at in self.frames
        ]
        for before, now in itertools.pairwise(found):
            for name, way in sliding(before, now):
                total[name] = total.get(name, 0.0) + way
        self.frames = self.frames[-1:]
        return {name: float(torch.linalg.vector_norm(way)) for name, way in total.items()}


def sliding(before: Any, now: Any) -> Iterator[tuple[str, torch.Tensor]]:
    """Tangential motion of finger relative to object at the contact point of each pad, in hand axes [m]."""
    (s1, poses1, c1), (s2, poses2, c2) = before, now
    for name in set(c1.finger) & set(c2.finger):
        i, j = c1.finger.index(name), c2.finger.index(name)
        x, n = 0.5 * (c1.point[i] + c2.point[j]), c1.normal[i] + c2.normal[j]
        n = n / torch.linalg.vector_norm(n)
        T1, T2 = poses1.of(c1.link[i]), poses2.of(c1.link[i])
        finger = T2[:3, :3] @ T1[:3, :3].mT @ (x - T1[:3, 3]) + T2[:3, 3] - x
        obj = s2.rotation @ s1.rotation.mT @ (x - s1.position) + s2.position - x
        way = finger - obj
        yield name, way - n * (n @ way)


def slides(
    make: Callable[[str], Bench], items: Sequence[str], seed: int, *, motions: int
) -> Iterator[TrialRecord]:
    """One turn: what was said of each motion, and what came of it."""
    bench = make(items[0])
    start, hand = bench.grasp(seed, 0), bench.hand
    if start is None:
        return
    witness, seen = Witness(hand), hand.observe()
    model = KinematicModel(hand.hand, hand.object, ModelOptions(on_unstable="flag"))
    draw = np.random.default_rng(seed)
    degrees, limit = _FAR * draw.choice([-1.0, 1.0]), np.radians(draw.uniform(1.5, 4.0))
    focus = FocusedPose.rotation_about(hand.rotation_axis)
    controller = LookAndMoveController(bench.model, focus, limiting=LimitingFunction(step=limit))
    target = PoseTarget.turned(start, hand.rotation_axis, np.radians(degrees))
    expected, slipped, still = None, 0, 0
    for k in range(motions):
        decision = controller.decide(seen.state, seen.a, target, seen.fingertip_force)
        if decision.message or slipped == 8 or still == 4 or seen.status is not PlantStatus.HELD:
            break
        witness.slips()
        after = hand.command(decision.delta_a)
        slid = max(witness.slips().values(), default=0.0)
        figures, expected = said(model, seen, after, expected)
        about = Trial(bench.name, "turn", bench.controller, seed, k, degrees)
        reason, more = StopReason.STEP_LIMIT.value, {**figures, "slid": slid}
        yield TrialRecord(
            **vars(about), reason=reason, message="", seconds=(1e-3 * figures["ms"],), more=more
        )
        turned = float(torch.linalg.vector_norm(true_state(after).minus(true_state(seen))[-3:]))
        slipped, still = slipped + (slid > SLIP), still + 1 if turned < 0.1 * DEG else 0
        seen = after
    bench.close()


def said(
    model: KinematicModel, seen: Observation, after: Observation, expected: Any
) -> tuple[dict[str, Any], Any]:
    """What both models say of a motion, and the forces that are expected after it."""
    assert seen.truth is not None  # of a simulated hand
    state, w, ds = true_state(seen), after.a - seen.a, true_state(after).minus(true_state(seen))
    found: dict[str, Any] = {"links": 0, "km": None, "step": None, "ms": 0.0}
    known = {"fingertip_force": seen.truth.fingertip_force, "expected": expected}
    try:
        found["km"] = float((ds - model.linearize(state, **known).step(w))[-3:].norm()) / DEG
        begun = time.process_time()
        start = model.linearize(state, model.touching(state), **known)
        step = ContactMotion(model, start, a=seen.a).move(w)
        found["ms"] = 1e3 * (time.process_time() - begun)
        found["step"] = float((ds - step.increment)[-3:].norm()) / DEG
        bears = (name for name, mode in step.modes.items() if mode is not ContactMode.OPEN)
        found["links"] = sum(name in model.link_names for name in bears)
        return found, start.forces_after(w) if start.forces.solved else None
    except GraspError:
        return found, None


def errors_table(motions: Any) -> Table:
    """Motions of each engine; those that the step refuses are left out."""
    found = motions[motions["step"].notna()].astype({"km": float, "step": float})
    groups = {
        f"{plant}: {name}": mine[fits(mine)]
        for plant, mine in found.groupby("plant", sort=False)
        for name, fits in KINDS.items()
    }
    columns: dict[Column, Callable[[Any], Cell]] = {Column("n"): len}
    for label, key in (("KM", "km"), ("step", "step")):
        columns[Column(f"{label}, median [deg]", ".3f")] = lambda m, key=key: float(m[key].median())
        columns[Column(f"{label}, rms [deg]", ".3f")] = lambda m, key=key: float(
            np.sqrt((m[key] ** 2).mean())
        )
    note = "Error of the object's rotation, all axes, after one motion; hand as described, true states."
    shown = {name: one for name, one in groups.items() if len(one)}
    return Table.of("steps", "One motion", "motions", shown, columns, note)


def told(motions: Any) -> str:
    """The last line."""
    slid = motions[motions["slid"] > SLIP]
    errors = (
        f"{label} {slid[key].astype(float).median():.2f}" for label, key in (("KM", "km"), ("step", "step"))
    )
    return f"slid: {', '.join(errors)} deg; a step {motions['ms'].median():.1f} ms"


def errors_picture(motions: Any) -> Any:
    """Errors of a motion against how far it slid."""
    plants = dict(tuple(motions.groupby("plant", sort=False)))
    figure, panels = new_figure(8.5, 3.2, len(plants), sharey=True)
    for axes, (plant, mine) in zip(panels, plants.items(), strict=True):
        slid = 1e3 * mine["slid"].clip(lower=3e-6)
        for key, label, colour in (("km", "KM", COLOURS["KM"]), ("step", "step", COLOURS["E-KM"])):
            axes.plot(slid, mine[key].astype(float), "o", ms=3, alpha=0.6, color=colour, label=label)
        axes.set(xscale="log", yscale="log", xlabel="a pad slid by [mm]")
        axes.set_title(plant, loc="left", fontsize=10)
    panels[0].set(ylabel="error of the rotation [deg]")
    panels[0].legend(frameon=False, fontsize=8)
    return figure
