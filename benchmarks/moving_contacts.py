"""Contacts that slide, open and close, and links that bear: a motion as the equilibrium after it.

    python benchmarks/moving_contacts.py --objects box,carton,tea_tin --seeds 1000:1010 --engine mujoco

A look-and-move controller turns each object by more than it bears. Before every motion the kinematic model,
whose contacts stick, and ``KinematicModel.step`` predict where it ends, whether a contact slides, and where
the whole turn ends. On the hand as described from the true state; slips are announced on hands with noisy
sensors ("sensed": as described; "nominal": a used hand). Friction in MuJoCo is a round cone, in SAPIEN
(PhysX) a pyramid. Finished sessions stay in ``--out``.
"""

from __future__ import annotations

import contextlib
import itertools
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent / "kinematic_model"))

from command_line import study_parser
from slips import RELEASE, SLIP, STILL, Witness, own_objects, plant_parameters

from torch_ekm._terminal import progress
from torch_ekm.control import (
    FocusedPose,
    LimitingFunction,
    LookAndMoveController,
    PoseTarget,
)
from torch_ekm.description import load_object
from torch_ekm.exceptions import EKMError, GraspError
from torch_ekm.experiments.config import object_name
from torch_ekm.experiments.jobs import run_jobs
from torch_ekm.experiments.reporting.plots import COLOURS, new_figure, save_figure
from torch_ekm.experiments.reporting.report import Column, Report, Table
from torch_ekm.kinematics import GraspState
from torch_ekm.model import ContactMode, ContactMotion, KinematicModel, Linearization, ModelOptions
from torch_ekm.plant import Observation, PlantStatus
from torch_ekm.simulation import SimulatedHand, preset

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DEG = np.pi / 180
PLANTS = ("described", "sensed", "nominal")
MOTIONS = 25
_FAR = 40.0  # [deg] more than most grasps bear
_SLIDES = 1.2 * SLIP  # predicted slide that is announced; chosen on seeds 0 to 2


def session(item: str, seed: int, plant: str, engine: str) -> dict[str, Any]:
    """One turn: what was said of each motion and what came of it; of the hand as described the whole turn."""
    torch.set_num_threads(1)
    obj = own_objects().get(item) or load_object(item)
    parameters = preset("none") if plant == "described" else plant_parameters(plant, seed)
    hand = SimulatedHand("icub_right", obj, parameters=parameters.replace(hardware_seed=seed), engine=engine)
    try:
        seen = hand.reset(seed)
    except EKMError:
        hand.close()
        return {"motions": []}
    witness = Witness(hand)
    model = KinematicModel(hand.hand, hand.object, ModelOptions(on_unstable="flag"))
    draw = np.random.default_rng(seed)
    degrees, limit = _FAR * draw.choice([-1.0, 1.0]), np.radians(draw.uniform(1.5, 4.0))
    focus = FocusedPose.rotation_about(hand.rotation_axis)
    limiting = LimitingFunction(step=limit)
    controller = LookAndMoveController(KinematicModel(hand.hand, hand.object), focus, limiting=limiting)
    target = PoseTarget.turned(seen.state, hand.rotation_axis, np.radians(degrees))
    rows: list[dict[str, Any]] = []
    way, expected, slipped, still = [seen], None, 0, 0
    while len(rows) < MOTIONS and seen.status is PlantStatus.HELD and slipped < 8 and still < 4:
        decision = controller.decide(seen.state, seen.a, target, seen.fingertip_force)
        if decision.message:
            break
        witness.slips()
        after = hand.command(decision.delta_a)
        slid = max(witness.slips().values(), default=0.0)
        row, expected = said(model, seen, after, expected, exact=plant == "described")
        rows.append(row | {"slid": slid})
        turned = float(torch.linalg.vector_norm(_truth(after).minus(_truth(seen))[-3:]))
        slipped, still = slipped + (slid > SLIP), still + 1 if turned < 0.1 * DEG else 0
        seen = after
        way.append(seen)
    hand.close()
    found: dict[str, Any] = {"motions": rows}
    if plant == "described" and rows and seen.status is PlantStatus.HELD:
        found |= foreseen(model, way, hand.rotation_axis)
    return found


def said(
    model: KinematicModel, seen: Observation, after: Observation, expected: Any, *, exact: bool
) -> tuple[dict[str, Any], Any]:
    """What both models say of a motion, and the forces that are expected after it."""
    state = _truth(seen) if exact else seen.state
    force = seen.truth.fingertip_force if exact and seen.truth is not None else seen.fingertip_force
    w, ds = after.a - seen.a, _truth(after).minus(_truth(seen))
    row: dict[str, Any] = {"links": 0, "margin": -np.inf, "slide": np.inf}  # a refusal is an alarm
    known = {"fingertip_force": force, "expected": expected}
    try:
        km = model.linearize(state, **known)
        row["margin"] = float(km.margins_after(w).min())
        row["km"] = float((ds - km.step(w))[-3:].norm()) / DEG
        begun = time.process_time()
        start = model.linearize(state, model.touching(state), **known)
        motion = ContactMotion(model, start, a=seen.a if exact else None)
        step = motion.move(w)
        row["ms"] = 1e3 * (time.process_time() - begun)
        row["step"] = float((ds - step.increment)[-3:].norm()) / DEG
        row["slide"] = step.farthest_slide
        bears = (name for name, mode in step.modes.items() if mode is not ContactMode.OPEN)
        row["links"] = sum(name in model.link_names for name in bears)
        return row, start.forces_after(w) if start.forces.solved else None
    except GraspError:
        return row, None


def foreseen(model: KinematicModel, way: list[Observation], axis: torch.Tensor) -> dict[str, float]:
    """Errors of a whole turn that is predicted from its first state [deg]."""
    first, last = way[0], way[-1]
    start = _linearized(model, first)
    moved = [b.a - a.a for a, b in itertools.pairwise(way)]
    motion = ContactMotion(model, start, a=first.a)
    try:
        for w in moved:
            motion.move(w)
        rolled = sticking(model, start, moved)
    except GraspError:
        return {"turn_ended": 1.0}
    off = {name: _truth(last).minus(s)[-3:] / DEG for name, s in (("step", motion.state), ("km", rolled))}
    return {f"turn_{n}": float(x.norm()) for n, x in off.items()} | {
        f"axis_{n}": abs(float(x @ axis)) for n, x in off.items()
    }


def sticking(model: KinematicModel, start: Linearization, moved: list[torch.Tensor]) -> GraspState:
    """``s <- s (+) J_m(s) w``: pads that stick, links that do not bear."""
    lin = model.linearize(start.state, start.contacts.select(_pads(model, start)), on_unstable="flag")
    state = lin.state
    for w in moved:
        state, forces = state.plus(lin.step(w)), lin.forces_after(w)
        with contextlib.suppress(GraspError):  # then with the Jacobian before it
            lin = model.linearize(state, expected=forces, on_unstable="flag")
    return state


def _linearized(model: KinematicModel, seen: Observation) -> Linearization:
    state = _truth(seen)
    force = None if seen.truth is None else seen.truth.fingertip_force
    return model.linearize(state, model.touching(state), fingertip_force=force, on_unstable="flag")


def _pads(model: KinematicModel, lin: Linearization) -> list[int]:
    return [i for i, name in enumerate(lin.contacts.finger) if name not in model.link_names]


def _truth(seen: Observation):
    return seen.state if seen.truth is None else seen.truth.state


class Comparison:
    """All sessions, by object, seed and plant."""

    def __init__(self, results: dict[tuple[str, int, str], dict[str, Any]]) -> None:
        self.results = results

    def motions(self, *plants: str) -> list[dict[str, Any]]:
        """Of these plants, those of which both models said something."""
        every = (one for (_, _, plant), x in self.results.items() if plant in plants for one in x["motions"])
        return [one for one in every if "step" in one or plants != ("described",)]

    def errors(self) -> Table:
        """One step on the hand as described."""
        rows, every = [], self.motions("described")
        for name, fits in KINDS.items():
            group = [one for one in every if fits(one)]
            if group:
                km, step = (np.array([one[key] for one in group]) for key in ("km", "step"))
                rows.append([name, len(group), *_pair(km), *_pair(step)])
        columns = [
            "motions", "n", Column("KM, median [deg]", ".3f"), Column("KM, rms [deg]", ".3f"),
            Column("step, median [deg]", ".3f"), Column("step, rms [deg]", ".3f"),
        ]  # fmt: skip
        note = (
            "Error of the object's rotation, all axes, after one motion; hand as described, true states."
            " Motions that the step refuses are left out."
        )
        return Table("steps", "One motion", columns, rows, note)

    def turns(self) -> Table:
        """Whole turns from the first state."""
        rows = []
        items = list(dict.fromkeys(item for item, _, _ in self.results))
        for name, group in (("all", items), *((item, [item]) for item in items)):
            every = [x for (item, _, plant), x in self.results.items() if item in group and "turn_step" in x]
            if every:
                cells = [
                    f(x[k] for x in every) for k in ("turn_km", "turn_step") for f in (_median, _largest)
                ]
                rows.append([object_name(name) if name != "all" else name, len(every), *cells])
        columns = [
            "object", "turns",
            Column("KM, median [deg]", ".2f"), Column("KM, largest [deg]", ".2f"),
            Column("step, median [deg]", ".2f"), Column("step, largest [deg]", ".2f"),
        ]  # fmt: skip
        note = (
            "Error of the rotation, all axes, at the end of a turn of 9 to 25 motions, predicted from its"
            " first state and the motions of the encoders. The KM, whose contacts stick, is linearized after"
            " each motion. Left out: turns that the step says end before, or in which the object is lost."
        )
        return Table("turns", "Whole turns", columns, rows, note)

    def slips(self) -> Table:
        """Announced and false."""
        rows = []
        for plant in PLANTS:
            for label, alarm in ALARMS.items():
                rows.append([plant, label, *self._announced(plant, alarm)])
        columns = [
            "hand",
            "announced by",
            "slips",
            "first of a turn",
            "false, no slip",
            "false, nothing slid",
        ]
        note = (
            f"A motion slips where a pad slides by more than {1e3 * SLIP:.2f} mm; nothing slid: less than"
            f" {1e3 * STILL:.2f} mm. Announced: the KM's margin after it is below -{RELEASE} N; a step"
            f" slides by more than {1e3 * _SLIDES:.3f} mm. Sensed and nominal hands give noisy readings."
        )
        return Table("slips", "Slips announced one motion ahead", columns, rows, note)

    def _announced(self, plant: str, alarm: Callable[[dict[str, Any]], bool]) -> list[str]:
        slips, first, calm, still = [], [], [], []
        for (_, _, where), x in self.results.items():
            slipped = False
            for one in x["motions"] if where == plant else []:
                said = alarm(one)
                if one["slid"] > SLIP:
                    slips.append(said)
                    first += [] if slipped else [said]
                    slipped = True
                else:
                    calm.append(said)
                    still += [said] if one["slid"] < STILL else []
        return [f"{100 * np.mean(x):.0f} % of {len(x)}" if x else "-" for x in (slips, first, calm, still)]

    def picture(self) -> Figure:
        """Errors of a motion against how far it slid."""
        every = self.motions("described")
        figure, (axes,) = new_figure(6.0, 3.2)
        slid = 1e3 * np.array([max(one["slid"], 3e-6) for one in every])
        for key, label, colour in (("km", "KM", COLOURS["KM"]), ("step", "step", COLOURS["E-KM"])):
            axes.plot(slid, [one[key] for one in every], "o", ms=3, alpha=0.6, color=colour, label=label)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel("a pad slid by [mm]")
        axes.set_ylabel("error of the rotation [deg]")
        axes.legend(frameon=False, fontsize=8)
        return figure

    @property
    def verdict(self) -> str:
        every, noisy = self.motions("described"), self.motions("sensed", "nominal")
        slid = [one for one in every if one["slid"] > 2e-4]
        turns = [x["turn_step"] for x in self.results.values() if "turn_step" in x]
        slips = [ALARMS["step"](one) for one in noisy if one["slid"] > SLIP]
        calm = [ALARMS["step"](one) for one in noisy if one["slid"] <= SLIP]
        return (
            f"slid: KM {_median(x['km'] for x in slid):.2f}, step {_median(x['step'] for x in slid):.2f} deg;"
            f" whole turns {_median(turns):.2f} deg;"
            f" slips of sensed and nominal hands announced {100 * _mean(slips):.0f} %,"
            f" false {100 * _mean(calm):.0f} %;"
            f" a step {_median(x['ms'] for x in every):.1f} ms"
        )

    def report(self, folder: Path, engine: str) -> Report:
        """Tables, picture and verdict, in ``folder``."""
        caption = "Each motion of the hand as described."
        shown = save_figure(self.picture(), folder, f"moving_contacts_{engine}", caption)
        tables = [self.errors(), self.turns(), self.slips()]
        report = Report("Contacts that slide, open and close", f"{self.verdict}.", tables, [shown])
        report.write(folder)
        return report


KINDS = {
    "no slip, no link": lambda one: one["slid"] <= SLIP and not one["links"],
    "slid 0.05 to 0.2 mm": lambda one: SLIP < one["slid"] <= 2e-4,
    "slid more than 0.2 mm": lambda one: one["slid"] > 2e-4,
    "a link touches": lambda one: one["links"] > 0,
    "all": lambda one: True,
}


#: Who announces a slip, by what it says of a motion.
ALARMS: dict[str, Callable[[dict[str, Any]], bool]] = {
    "margins of the KM": lambda one: one["margin"] < -RELEASE,
    "step": lambda one: one["slide"] > _SLIDES,
}


def _pair(errors: np.ndarray) -> tuple[float, float]:
    return float(np.median(errors)), float(np.sqrt(np.mean(errors**2)))


def _median(values) -> float:
    every = list(values)
    return float(np.median(every)) if every else float("nan")


def _largest(values) -> float:
    return max(values)


def _mean(values) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def main() -> None:
    given = study_parser(
        __doc__, "moving_contacts", objects="box,can,bottle,carton,tea_tin", seeds="1000:1010",
        engine="mujoco", quick="one object, one seed, the hand as described",
    ).parse_args()  # fmt: skip
    items, seeds, plants = given.objects.split(","), given.seeds, PLANTS
    if given.quick:
        items, seeds, plants = items[:1], seeds[:1], PLANTS[:1]
    todo, where = {}, {}
    for item in items:
        for seed in seeds:
            for plant in plants:
                key = f"{given.engine}_{object_name(item)}_{plant}_{seed}"
                todo[key], where[key] = (item, seed, plant, given.engine), (item, seed, plant)
    with progress("running", len(todo)) as advance:
        results = run_jobs(session, todo, given.out, given.jobs, advance)
    comparison = Comparison({where[key]: found for key, found in results.items()})
    print(comparison.report(given.out, given.engine).markdown())
    print(comparison.verdict)


if __name__ == "__main__":
    main()
