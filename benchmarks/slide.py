"""A finger slides along the object on purpose, and the object stays where it is.

    python benchmarks/slide.py --objects box,can --seeds 1000:1010 --out FOLDER

In each grasp of the iCub hand index or middle finger is to slide 3 mm: along the axis of the pinch, to either
side, or along the fingers. Before each motion increments of the motors are drawn by the cross-entropy method,
``ContactMotion`` predicts what each one does to object and contacts, and the best is commanded. Hands:
"described", true states and forces; "nominal", a used hand with noisy readings. Finished sessions stay in
``--out``: an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import copy
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent / "kinematic_model"))

from command_line import study_parser
from regrasp import median
from slip_announcement import sliding

from torch_ekm._terminal import progress
from torch_ekm.contact import ContactSet
from torch_ekm.exceptions import GraspError
from torch_ekm.experiments.config import Setting, digest
from torch_ekm.experiments.jobs import run_jobs
from torch_ekm.experiments.records import true_state
from torch_ekm.experiments.reporting.plots import COLOURS, new_figure, save_figure
from torch_ekm.experiments.reporting.report import Cell, Column, Report, Table
from torch_ekm.kinematics import GraspState, LinkPoses
from torch_ekm.model import ContactMotion, ContactStep, KinematicModel
from torch_ekm.plant import Observation, PlantStatus
from torch_ekm.simulation import SimulatedHand
from torch_ekm.typing import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PLANTS = {"described": "none", "nominal": "nominal"}
#: Finger, direction and side.
CASES = (
    ("index", "axis", 1.0), ("index", "axis", -1.0), ("middle", "axis", 1.0), ("middle", "axis", -1.0),
    ("middle", "fingers", 1.0),
)  # fmt: skip
WANTED = 3.0  # [mm]
MOTIONS = 10  # at most
_FAR = 4 * math.pi / 180  # [rad] of a motor in one motion
_ROUNDS, _DRAWN, _BEST = 3, 24, 6  # of the cross-entropy method
_LEAST, _MOST = 1.0, 5.0  # [N] of each finger
_MARGIN = 0.2  # [N] of those that do not slide
_FARTHEST = 1.5  # [mm] in one motion
OFF = 5.0  # [deg] of the object, beyond which the slide is given up
_DEG = math.pi / 180

Placed = tuple[GraspState, LinkPoses, ContactSet]


@dataclass(frozen=True)
class Slide:
    """One slide, and what came of it."""

    object: str
    seed: int
    plant: str
    finger: str
    direction: str
    side: float
    slid: list[float]
    """In the wanted direction, after each motion [mm]."""
    predicted: list[float]
    """In it, by each motion, before it [mm]."""
    others: float
    """The farthest that another finger slid [mm]."""
    off: float
    """Of the object's rotation from where it began, in the end [deg]."""
    moved: float
    """Of its position [mm]."""
    ended: str
    """reached, motions, no motion, turned or lost."""

    @property
    def case(self) -> str:
        """Finger and direction."""
        return f"{self.finger}, along the {self.direction}{' -' if self.side < 0 else ''}"

    @property
    def by_motion(self) -> Array:
        """In the wanted direction, by each motion [mm]."""
        return np.diff(np.array([0.0, *self.slid]))


class Slider:
    """Chooses motions after which one finger has slid further and the object is where it was."""

    def __init__(self, plant: SimulatedHand, model: KinematicModel, case: tuple[str, str, float]) -> None:
        self.model, (self.finger, self.direction, self.side) = model, case
        seen = plant.observe()
        self.start = seen.state
        axis = plant.rotation_axis.numpy()
        across = plant.plan.points[1:].mean(axis=0) - plant.plan.points[0]
        way = axis if self.direction == "axis" else np.cross(axis, across / np.linalg.norm(across))
        self._way = self.side * (seen.state.rotation.numpy().T @ way)  # in the object
        names = model.hand.actuator_names
        self._free = np.array([name != "pinky" for name in names])  # ring and little finger stay open
        self._last, self._expected = np.zeros(len(names)), None

    def slides(self, before: Placed, after: GraspState) -> dict[str, float]:
        """How far each finger slides over the object in the wanted direction [mm]."""
        way = torch.from_numpy(after.rotation.numpy() @ self._way)
        return {name: 1e3 * float(x @ way) for name, x in sliding(before, self.placed(after))}

    def choose(
        self, seen: Observation, missing: float, draw: np.random.Generator, *, exact: bool
    ) -> tuple[Array, float] | None:
        """The next increments [rad], and how far the finger slides in them [mm]; None: no grasp that
        the model can move.

        Args:
            seen: the last reading.
            missing: of the slide [mm].
            draw: numbers.
            exact: true states and forces.
        """
        state, force = seen.state, seen.fingertip_force
        if exact and seen.truth is not None:
            state, force = seen.truth.state, seen.truth.fingertip_force
        known = {"fingertip_force": force, "expected": self._expected, "on_unstable": "flag"}
        try:
            lin = self.model.linearize(state, self.model.touching(state), **known)
        except GraspError:  # a finger has left the object
            return None
        begun, here = ContactMotion(self.model, lin, a=seen.a if exact else None), self.placed(state)

        def cost(da: Array) -> tuple[float, float]:
            try:
                step = copy.copy(begun).move(torch.from_numpy(da))
            except GraspError:
                return math.inf, 0.0
            slid = self.slides(here, step.state).get(self.finger, 0.0)
            return self._cost(step, slid, missing), slid

        middle, spread = 0.7 * self._last, np.full(len(self._last), _FAR / 2)
        found = math.inf, 0.0, self._last
        for _ in range(_ROUNDS):
            some = middle + spread * draw.standard_normal((_DRAWN, len(middle)))
            some[0] = middle
            some = np.where(self._free, some.clip(-_FAR, _FAR), 0.0)
            rated = sorted(((*cost(da), da) for da in some), key=lambda one: one[0])
            found = min(found, rated[0], key=lambda one: one[0])
            best = np.array([da for _, _, da in rated[:_BEST]])
            middle, spread = best.mean(axis=0), best.std(axis=0) + 1e-3
        if math.isinf(found[0]):
            return None
        self._last = found[2]
        self._expected = lin.forces_after(torch.from_numpy(found[2])) if lin.forces.solved else None
        return found[2], found[1]

    def _cost(self, step: ContactStep, slid: float, missing: float) -> float:
        """Slide and what leads to it against motion of the object, forces out of range, links that bear."""
        moved = step.state.minus(self.start)[-6:].numpy()
        off, away = np.linalg.norm(moved[3:]) / _DEG, 1e3 * np.linalg.norm(moved[:3])
        fingers = ("thumb", "index", "middle")
        force = np.array([step.normal.get(name, 0.0) for name in fingers])
        shear = 0.0  # share of friction in the wanted direction: it is full before the finger slides
        if step.normal.get(self.finger, 0.0) > _MARGIN:
            way = step.state.rotation.numpy() @ self._way
            shear = float(step.loads.force[self.finger] @ way) / step.normal[self.finger]
        little = sum(max(0.0, _MARGIN - x) for name, x in step.margin.items() if name != self.finger)
        bearing = sum(x > 0 for name, x in step.normal.items() if name not in fingers)
        return float(
            -3 * min(slid, missing, _FARTHEST) - 4 * shear + (off / 2) ** 2 + (away / 6) ** 2 + 10 * little
            + (10 * (_LEAST - force).clip(min=0) + 2 * (force - _MOST).clip(min=0)).sum() + 3 * bearing
        )  # fmt: skip

    def placed(self, state: GraspState) -> Placed:
        """Links and contacts there."""
        poses = self.model.kinematics(state.q)
        return state, poses, self.model.detector(poses, state.position, state.rotation)


def slide(plant: SimulatedHand, model: KinematicModel, case: tuple[str, str, float], about: Any) -> Slide:
    """Motions until the finger has slid as far as it should, by the readings, and what came of them."""
    item, seed, name = about
    slider, seen, draw = Slider(plant, model, case), plant.observe(), np.random.default_rng(seed)
    exact, first = name == "described", true_state(plant.observe())
    slid, predicted, read, ended = [], [], 0.0, "motions"
    total: dict[str, float] = {}
    for _ in range(MOTIONS):
        chosen = slider.choose(seen, WANTED - read, draw, exact=exact)
        if chosen is None:
            ended = "no motion"
            break
        before, seen = seen, plant.command(torch.from_numpy(chosen[0]))
        if seen.status is PlantStatus.LOST:
            ended = "lost"
            break
        for finger, way in slider.slides(slider.placed(true_state(before)), true_state(seen)).items():
            total[finger] = total.get(finger, 0.0) + way
        slid.append(total.get(slider.finger, 0.0))
        predicted.append(chosen[1])
        then, now = (true_state(x) if exact else x.state for x in (before, seen))
        read += slider.slides(slider.placed(then), now).get(slider.finger, 0.0)
        off = float(now.minus(slider.start)[-3:].norm()) / _DEG
        if off > OFF or read >= WANTED:
            ended = "turned" if off > OFF else "reached"
            break
    moved = true_state(seen).minus(first)[-6:]
    others = max((abs(way) for finger, way in total.items() if finger != slider.finger), default=0.0)
    turned, away = float(moved[3:].norm()) / _DEG, 1e3 * float(moved[:3].norm())
    return Slide(item, seed, name, *case, slid, predicted, others, turned, away, ended)


def session(
    setting: Setting, item: str, seed: int, name: str, cases: Sequence[tuple[str, str, float]]
) -> Any:
    """All slides of one grasp."""
    torch.set_num_threads(1)
    config = setting.plant_config("KM+I")  # increments add up: what a servo leaves undone is commanded again
    plant = SimulatedHand(setting.hand, item, config, setting.parameters, engine=setting.engine)
    plant.reset(seed)
    model, begun, slides = KinematicModel(plant.hand, plant.object, setting.model), plant.snapshot(), []
    for case in cases:
        plant.restore(begun)
        slides.append(asdict(slide(plant, model, case, (plant.object.name, seed, name))))
    plant.close()
    return slides


def verdict_of(slides: Sequence[Slide]) -> str:
    """The last line."""
    said = []
    for name in PLANTS:
        some = [one for one in slides if one.plant == name]
        reached, lost = (sum(one.ended == end for one in some) for end in ("reached", "lost"))
        said.append(f"{name}: {WANTED:g} mm in {reached} of {len(some)} slides, lost {lost}")
    return "; ".join(said)


def table(slides: Sequence[Slide]) -> Table:
    """A row for each hand and case."""
    rows: list[list[Cell]] = []
    for name, case in dict.fromkeys((one.plant, one.case) for one in slides):
        some = [one for one in slides if (one.plant, one.case) == (name, case)]
        kept = [one for one in some if one.ended != "lost"]
        error = [abs(x) for one in kept for x in one.by_motion - np.array(one.predicted)]
        rows.append(
            [
                f"{name}: {case}", f"{sum(one.ended == 'reached' for one in some)} of {len(some)}",
                sum(one.ended == "lost" for one in some), median(len(one.slid) for one in kept),
                median(one.slid[-1] for one in kept if one.slid), median(error),
                median(one.others for one in kept), f"{median(one.off for one in kept):.1f} deg,"
                f" {median(one.moved for one in kept):.1f} mm",
            ]
        )  # fmt: skip
    columns: list[str | Column] = [
        "hand, finger", "reached", "lost", Column("motions", ".0f"), Column("slid [mm]", ".1f"),
        Column("error of one prediction [mm]", ".2f"), Column("other fingers [mm]", ".1f"), "object moved",
    ]  # fmt: skip
    note = (
        f"Reached: the finger slid {WANTED:g} mm in the wanted direction, by the readings, within {MOTIONS}"
        " motions. All else is true, median over the slides after which the object is held; prediction: how"
        " far the finger slides in one motion, before it."
    )
    return Table("slides", "One finger slides on purpose", columns, rows, note)


def picture(slides: Sequence[Slide]) -> Figure:
    """Predicted and true slide of each motion."""
    figure, axes = new_figure(6.5, 3.0, columns=len(PLANTS))
    for axis, name in zip(axes, PLANTS, strict=True):
        some = [one for one in slides if one.plant == name]
        pairs = [(x, y) for one in some for x, y in zip(one.predicted, one.by_motion, strict=True)]
        if pairs:
            predicted, true = np.array(pairs).T
            axis.plot(predicted, true, ".", color=COLOURS["E-KM"], alpha=0.5)
            axis.axline((0, 0), slope=1, color="0.4", linewidth=0.8)
        axis.set_xlabel("predicted slide of a motion [mm]")
        axis.set_title(f"hand: {name}", fontsize="medium")
    axes[0].set_ylabel("true slide [mm]")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    parser = study_parser(
        __doc__, "slide", objects="box,can", seeds="1000:1010", engine="mujoco",
        quick="one object, one seed, the hand as described, the index finger to one side",
    )  # fmt: skip
    given = parser.parse_args(arguments)
    objects, seeds, cases, plants = given.objects.split(","), given.seeds, CASES, dict(PLANTS)
    if given.quick:
        objects, seeds, cases, plants = objects[:1], seeds[:1], CASES[:1], {"described": "none"}
    todo = {}
    for seed in seeds:
        for item in objects:
            for name, preset in plants.items():
                setting = Setting(preset=preset, engine=given.engine)
                mark = digest(setting, (item,), cases, WANTED, MOTIONS)
                job = setting.hardware_instance(seed), item, seed, name, cases
                todo[f"{Path(item).stem}_{name}_{mark}_{seed}"] = job
    with progress("running", len(todo)) as advance:
        results = run_jobs(session, todo, given.out, given.jobs, advance)
    slides = [Slide(**one) for some in results.values() for one in some]
    caption = "How far the finger slides in the wanted direction, by motion; line: as predicted."
    verdict, shown = verdict_of(slides), save_figure(picture(slides), given.out, "slide", caption)
    report = Report("Slides on purpose", f"{verdict[0].upper()}{verdict[1:]}.", [table(slides)], [shown])
    report.write(given.out)
    print(report.markdown())
    print(verdict)


if __name__ == "__main__":
    main()
