"""Contacts that slide, open and close, and links that bear: a motion as the equilibrium after it.

    python benchmarks/moving_contacts.py --objects box,carton,tea_tin --seeds 1000:1010 --engine mujoco

A look-and-move controller turns each object by more than it bears. Before every motion the kinematic model,
whose contacts stick, and ``KinematicModel.step`` predict where it ends, and whether a contact slides. On the
hand as described from the true state; slips are announced on a used hand with noisy sensors ("nominal").
Friction in MuJoCo is a round cone, in SAPIEN (PhysX) a pyramid. Finished sessions stay in ``--out``.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import torch

from torch_ekm._terminal import progress
from torch_ekm.cli._app import parse_seeds
from torch_ekm.control import FocusedPose, LimitingFunction, LookAndMoveController, PoseTarget
from torch_ekm.exceptions import EKMError, GraspError
from torch_ekm.experiments.config import object_name
from torch_ekm.experiments.jobs import run_jobs
from torch_ekm.experiments.reporting.plots import COLOURS, new_figure, save_figure
from torch_ekm.experiments.reporting.report import Cell, Column, Report, Table
from torch_ekm.kinematics import GraspState
from torch_ekm.model import ContactMode, ContactMotion, KinematicModel, ModelOptions
from torch_ekm.plant import Observation, PlantStatus
from torch_ekm.simulation import ENGINES, SimulatedHand, preset

DEG = np.pi / 180
PLANTS = {"described": "none", "nominal": "nominal"}
MOTIONS = 25
SLIP, STILL = 5e-5, 1e-5  # [m] of a motion that slips, and in which nothing slides
_FAR = 40.0  # [deg] more than most grasps bear
_SLIDES = 1.2 * SLIP  # predicted slide that is announced; chosen on seeds 0 to 2
KINDS: dict[str, Callable[[Any], Any]] = {
    "no slip, no link": lambda m: (m["slid"] <= SLIP) & (m["links"] == 0),
    "slid 0.05 to 0.2 mm": lambda m: (m["slid"] > SLIP) & (m["slid"] <= 2e-4),
    "slid more than 0.2 mm": lambda m: m["slid"] > 2e-4,
    "a link touches": lambda m: m["links"] > 0,
    "all": lambda m: m["slid"] >= 0,
}


class Witness:
    """The simulator's truth about contacts: how far each slides, summed over frames; rolling is none."""

    def __init__(self, plant: SimulatedHand) -> None:
        options = ModelOptions(on_unstable="flag", max_overlap=0.02)
        self.model = KinematicModel(*plant.true_descriptions(), options)
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
            (state, poses := self.model.kinematics(state.q), self._contacts(poses, state))
            for state in self.frames
        ]
        for before, now in itertools.pairwise(found):
            for name, way in sliding(before, now):
                total[name] = total.get(name, 0.0) + way
        self.frames = self.frames[-1:]
        return {name: float(torch.linalg.vector_norm(way)) for name, way in total.items()}

    def _contacts(self, poses: Any, state: GraspState) -> Any:
        return self.model.detector(poses, state.position, state.rotation)


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


def session(item: str, seed: int, plant: str, engine: str) -> list[dict[str, Any]]:
    """One turn: what was said of each motion, and what came of it."""
    torch.set_num_threads(1)
    parameters = preset(PLANTS[plant]).replace(hardware_seed=seed)
    hand = SimulatedHand("icub_right", item, parameters=parameters, engine=engine)
    rows: list[dict[str, Any]] = []
    try:
        seen = hand.reset(seed)
    except EKMError:
        hand.close()
        return rows
    witness = Witness(hand)
    model = KinematicModel(hand.hand, hand.object, ModelOptions(on_unstable="flag"))
    draw = np.random.default_rng(seed)
    degrees, limit = _FAR * draw.choice([-1.0, 1.0]), np.radians(draw.uniform(1.5, 4.0))
    focus = FocusedPose.rotation_about(hand.rotation_axis)
    limiting = LimitingFunction(step=limit)
    controller = LookAndMoveController(KinematicModel(hand.hand, hand.object), focus, limiting=limiting)
    target = PoseTarget.turned(seen.state, hand.rotation_axis, np.radians(degrees))
    expected, slipped, still = None, 0, 0
    while len(rows) < MOTIONS and seen.status is PlantStatus.HELD and slipped < 8 and still < 4:
        decision = controller.decide(seen.state, seen.a, target, seen.fingertip_force)
        if decision.message:
            break
        witness.slips()
        after = hand.command(decision.delta_a)
        slid = max(witness.slips().values(), default=0.0)
        row, expected = said(model, seen, after, expected, exact=plant == "described")
        rows.append({**row, "plant": plant, "object": object_name(item), "slid": slid})
        turned = float(torch.linalg.vector_norm(_truth(after).minus(_truth(seen))[-3:]))
        slipped, still = slipped + (slid > SLIP), still + 1 if turned < 0.1 * DEG else 0
        seen = after
    hand.close()
    return rows


def said(
    model: KinematicModel, seen: Observation, after: Observation, expected: Any, *, exact: bool
) -> tuple[dict[str, Any], Any]:
    """What both models say of a motion, and the forces that are expected after it."""
    state = _truth(seen) if exact else seen.state
    force = seen.truth.fingertip_force if exact and seen.truth is not None else seen.fingertip_force
    w, ds = after.a - seen.a, _truth(after).minus(_truth(seen))
    row: dict[str, Any] = {"links": 0, "slide": np.inf}  # a refusal is an alarm
    known = {"fingertip_force": force, "expected": expected}
    try:
        km = model.linearize(state, **known)
        row["km"] = float((ds - km.step(w))[-3:].norm()) / DEG
        begun = time.process_time()
        start = model.linearize(state, model.touching(state), **known)
        step = ContactMotion(model, start, a=seen.a if exact else None).move(w)
        row["ms"] = 1e3 * (time.process_time() - begun)
        row["step"] = float((ds - step.increment)[-3:].norm()) / DEG
        row["slide"] = step.farthest_slide
        bears = (name for name, mode in step.modes.items() if mode is not ContactMode.OPEN)
        row["links"] = sum(name in model.link_names for name in bears)
        return row, start.forces_after(w) if start.forces.solved else None
    except GraspError:
        return row, None


def _truth(seen: Observation) -> GraspState:
    return seen.state if seen.truth is None else seen.truth.state


def errors(motions: Any) -> Table:
    """One step on the hand as described; motions that the step refuses are left out."""
    exact = motions[(motions["plant"] == "described") & motions["step"].notna()]
    groups = {name: exact[fits(exact)] for name, fits in KINDS.items()}

    def rms(name: str) -> Callable[[Any], Cell]:
        return lambda m: float(np.sqrt((m[name] ** 2).mean()))

    columns: dict[Column, Callable[[Any], Cell]] = {
        Column("n"): len,
        Column("KM, median [deg]", ".3f"): lambda m: float(m["km"].median()),
        Column("KM, rms [deg]", ".3f"): rms("km"),
        Column("step, median [deg]", ".3f"): lambda m: float(m["step"].median()),
        Column("step, rms [deg]", ".3f"): rms("step"),
    }
    note = "Error of the object's rotation, all axes, after one motion; hand as described, true states."
    shown = {name: one for name, one in groups.items() if len(one)}
    return Table.of("steps", "One motion", "motions", shown, columns, note)


def slips(motions: Any) -> Table:
    """Announced and false."""

    def share(said: Any) -> str:
        return f"{100 * said.mean():.0f} % of {len(said)}" if len(said) else "-"

    rows: list[list[Cell]] = []
    for plant, mine in motions.groupby("plant", sort=False):
        alarm, slid = mine["slide"] > _SLIDES, mine["slid"]
        rows.append([plant, *(share(alarm[group]) for group in (slid > SLIP, slid <= SLIP, slid < STILL))])
    columns = ["hand", "slips", "false, no slip", "false, nothing slid"]
    note = (
        f"A motion slips where a pad slides by more than {1e3 * SLIP:.2f} mm; readings of nominal are noisy."
    )
    return Table("slips", "Slips announced one motion ahead", columns, rows, note)


def verdict(motions: Any) -> str:
    """The last line."""
    exact, noisy = (motions[motions["plant"] == plant] for plant in PLANTS)
    slid, slipped, alarm = exact[exact["slid"] > 2e-4], noisy["slid"] > SLIP, noisy["slide"] > _SLIDES
    return (
        f"slid: KM {slid['km'].median():.2f}, step {slid['step'].median():.2f} deg; slips of nominal hands"
        f" announced {100 * alarm[slipped].mean():.0f} %, false {100 * alarm[~slipped].mean():.0f} %;"
        f" a step {exact['ms'].median():.1f} ms"
    )


def picture(motions: Any) -> Any:
    """Errors of a motion against how far it slid."""
    exact = motions[motions["plant"] == "described"]
    figure, (axes,) = new_figure(6.0, 3.2)
    for key, label, colour in (("km", "KM", COLOURS["KM"]), ("step", "step", COLOURS["E-KM"])):
        slid = 1e3 * exact["slid"].clip(lower=3e-6)
        axes.plot(slid, exact[key], "o", ms=3, alpha=0.6, color=colour, label=label)
    axes.set(xscale="log", yscale="log", xlabel="a pad slid by [mm]", ylabel="error of the rotation [deg]")
    axes.legend(frameon=False, fontsize=8)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--objects", default="box,can,bottle,carton,tea_tin", help="names or paths")
    parser.add_argument("--seeds", type=parse_seeds, default=parse_seeds("1000:1010"), help="FIRST:END")
    parser.add_argument("--engine", default="mujoco", choices=ENGINES)
    parser.add_argument("--jobs", type=int, default=2, help="processes at once")
    parser.add_argument(
        "--out", type=Path, default=Path("moving_contacts_output"), help="keeps what is finished"
    )
    parser.add_argument("--quick", action="store_true", help="one object and seed: to see that it works")
    given = parser.parse_args(arguments)
    items, seeds = given.objects.split(","), given.seeds
    if given.quick:
        items, seeds = items[:1], seeds[:1]
    todo = {
        f"{object_name(item)}_{plant}_{given.engine}_{MOTIONS}_{seed}": (item, seed, plant, given.engine)
        for item, seed, plant in itertools.product(items, seeds, PLANTS)
    }
    with progress("running", len(todo)) as advance:
        results = run_jobs(session, todo, given.out, given.jobs, advance)
    motions = pandas.DataFrame([row for rows in results.values() for row in rows])
    motions.to_csv(given.out / "motions.csv", index=False)
    caption = "Each motion of the hand as described."
    shown = save_figure(picture(motions), given.out, f"moving_contacts_{given.engine}", caption)
    told = verdict(motions)
    report = Report(
        "Contacts that slide, open and close", f"{told}.", [errors(motions), slips(motions)], [shown]
    )
    report.write(given.out)
    print(report.markdown(), told, sep="\n")


if __name__ == "__main__":
    main()
