"""One finger is lifted and set elsewhere: does the object stay where it is?

    python benchmarks/regrasp.py --objects box,can --seeds 1000:1010 --out FOLDER

In each grasp of the iCub hand index finger, middle finger and thumb are lifted 4 mm, each from the same
moment: while the two others hold alone, and with ring and little finger closed on the object before. Where
the object stays within 10 deg of its axis, the finger is set down 5 mm further on until it bears again, and
the support opens. The model is asked beforehand. Poses are true plus noise. Finished sessions stay in
``--out``: an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from command_line import study_parser
from scipy.optimize import least_squares

from torch_ekm._terminal import progress
from torch_ekm.exceptions import GraspError
from torch_ekm.experiments.config import Setting, digest
from torch_ekm.experiments.jobs import run_jobs
from torch_ekm.experiments.records import true_state
from torch_ekm.experiments.reporting.plots import COLOURS, new_figure, save_figure
from torch_ekm.experiments.reporting.report import Cell, Column, Report, Table
from torch_ekm.kinematics import GraspState
from torch_ekm.model import KinematicModel
from torch_ekm.plant import PlantStatus
from torch_ekm.simulation import SimulatedHand
from torch_ekm.typing import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Fingers that are lifted one after the other, and whether ring and little finger bear meanwhile.
CASES = (
    (("index",), False), (("middle",), False), (("thumb",), False),
    (("index",), True), (("middle",), True), (("middle", "index"), True),
)  # fmt: skip
CLEAR, FURTHER = 4e-3, 5e-3  # [m] above the object, and along it
SHIFTED = 2.0  # [mm] along it, at least, is another place: motors and tendons are not as described
AXIS = 10.0  # [deg] off it: the finger is not set again
BEARS = 0.8  # [N]: the least force of a finger in a turn
SUPPORT = 1.5  # [N] of ring and little finger together
_STEP = 6 * math.pi / 180  # [rad] of a motor in one command
_NEAR = 0.5 * math.pi / 180  # [rad] of a motor that is where it is wanted
_COMMANDS = 30  # at most, of one way
_CLOSINGS = 10  # commands, at most, until a finger that was set down bears
_DEG = math.pi / 180


@dataclass(frozen=True)
class Lift:
    """Fingers that were lifted, and what came of it."""

    object: str
    seed: int
    fingers: str
    support: bool
    regular: bool
    """The model can hold the object without them."""
    foreseen: float
    """Farthest off the axis with the first one lifted, by the model [deg]; NaN: it finds no equilibrium."""
    off: float
    """The same in the simulation, of all of them [deg]."""
    moved: float
    """Of the object, at most [mm]."""
    lost: bool
    shift: float = 0.0
    """From where they touched to where they do in the end, the least of them [mm]."""
    force: float = 0.0
    """In the end, the least of them [N]."""
    remains: float = math.nan
    """Off the axis in the end, the support open [deg]."""

    @property
    def case(self) -> str:
        """Fingers and support."""
        return f"{self.fingers}, supported" if self.support else self.fingers


def set_again(one: Lift) -> bool:
    """The object is held, and each finger bears at another place."""
    return not one.lost and one.force >= BEARS and one.shift >= SHIFTED


class Regrasp:
    """A grasp whose fingers are lifted, moved and set down by increments of their motors."""

    def __init__(self, plant: SimulatedHand, model: KinematicModel) -> None:
        self.plant, self.model, self.seen = plant, model, plant.observe()
        self.start, axis = true_state(self.seen), plant.rotation_axis
        across = plant.plan.points[1:].mean(axis=0) - plant.plan.points[0]
        along = np.cross(axis.numpy(), across / np.linalg.norm(across))
        self._along = self.seen.state.rotation.numpy().T @ along  # in the object

    @property
    def lost(self) -> bool:
        return self.seen.status is PlantStatus.LOST

    def off_axis(self, state: GraspState) -> float:
        """Rotation since the start but for that about the axis [deg]."""
        turned, axis = state.minus(self.start)[-3:], self.plant.rotation_axis
        return float((turned - (axis @ turned) * axis).norm()) / _DEG

    def place(self, finger: str, state: GraspState) -> float:
        """Where a finger touches: from the object's middle, square to axis and grip [m]."""
        return self._near(finger, state)[1]

    def _near(self, finger: str, state: GraspState) -> tuple[float, float, Array]:
        """Gap, place, and how the joints move the contact along the object's outward normal [m/rad]."""
        found = self.model.detector.near(state.q, state.position, state.rotation, 0.1)
        one = found.select([found.finger.index(finger)])
        jacobian = np.asarray(self.model.contact_kinematics(state, one).point_jacobian[0])
        along, point = state.rotation.numpy() @ self._along, (one.point[0] - state.position).numpy()
        return float(one.gap[0]), float(along @ point), one.normal[0].numpy() @ jacobian

    def motors(self, finger: str, place: float, gap: float, force: float) -> dict[int, float]:
        """Where its motors hold a finger over a place of the object, or on it with a normal force: in
        balance with the joints' springs [rad]."""
        hand, state = self.model.hand, self.seen.state
        joints = [hand.joint_names.index(f"{finger}_{k}") for k in (1, 2, 3)]
        motors = [hand.actuator_names.index(f"{finger}_{part}") for part in ("proximal", "distal")]

        def at(q: Array) -> tuple[float, float, Array]:
            moved = state.q.clone()
            moved[joints] = torch.from_numpy(q)
            gap, place, arm = self._near(finger, GraspState(moved, state.position, state.rotation))
            springs = hand.spring_stiffness[joints] * (q - hand.spring_rest[joints])
            return gap, place, springs - force * arm[joints]

        def unmet(q: Array) -> Array:
            now, there, torque = at(q)
            return np.array([1e3 * (now - gap), 1e3 * (there - place), 1e2 * (torque[1] - torque[2])])

        low, high = hand.joint_lower[joints], hand.joint_upper[joints]
        first = np.clip(state.q[joints].numpy(), low + 1e-3, high - 1e-3)
        q = least_squares(unmet, first, bounds=(low, high), diff_step=1e-4, max_nfev=40).x
        torque, stiffness = at(q)[2], [hand.actuators[motor].stiffness for motor in motors]
        pulled = q[0] + torque[0] / stiffness[0], q[1] + q[2] + torque[1] / stiffness[1]
        return dict(zip(motors, pulled, strict=True))

    def go(self, wanted: dict[int, float]) -> None:
        """Motors to where they are wanted, in small steps."""
        for _ in range(_COMMANDS):
            away = {motor: to - float(self.seen.a[motor]) for motor, to in wanted.items()}
            if (farthest := max(map(abs, away.values()))) < _NEAR or self.lost:
                return
            share = min(1.0, _STEP / farthest)
            self.by({motor: share * way for motor, way in away.items()})

    def by(self, increments: dict[int, float]) -> None:
        delta = torch.zeros(self.model.hand.n_a, dtype=torch.float64)
        for motor, way in increments.items():
            delta[motor] = way
        self.seen = self.plant.command(delta)

    def force(self, *fingers: str) -> float:
        """Measured, the sum [N]."""
        assert self.seen.fingertip_force is not None
        names = [pad.name for pad in self.model.hand.pads]
        return sum(float(self.seen.fingertip_force[names.index(finger)]) for finger in fingers)

    def support(self, closed: bool) -> None:
        """Ring and little finger close until they bear, or open."""
        motor = self.model.hand.actuator_names.index("pinky")
        for _ in range(40):
            if (self.force("ring", "little") >= SUPPORT) if closed else (self.seen.a[motor] < _STEP / 2):
                return
            self.by({motor: _STEP if closed else -2 * _STEP})


def lift(grasp: Regrasp, item: str, seed: int, fingers: tuple[str, ...], support: bool) -> Lift:
    """Lift fingers one after the other and set them further on, as far as the object allows it."""
    if support:
        grasp.support(closed=True)
    state = grasp.seen.state
    before = {finger: (grasp.place(finger, state), grasp.force(finger)) for finger in fingers}
    about = item, seed, ", then ".join(fingers), support, *_foreseen(grasp, fingers[0], before[fingers[0]][0])
    off = moved = 0.0
    for finger in fingers:
        place, force = before[finger]
        grasp.go(grasp.motors(finger, place, CLEAR, 0.0))
        now = true_state(grasp.seen)
        if not grasp.lost:  # where it fell says nothing
            off = max(off, grasp.off_axis(now))
            moved = max(moved, 1e3 * float((now.position - grasp.start.position).norm()))
        if grasp.lost or off > AXIS:
            return Lift(*about, off, moved, grasp.lost)
        there = place + FURTHER
        grasp.go(grasp.motors(finger, there, CLEAR, 0.0))
        closed = grasp.motors(finger, there, 0.0, force)
        grasp.go(closed)
        for _ in range(_CLOSINGS):
            if grasp.lost or grasp.force(finger) >= 0.7 * force:
                break
            grasp.by({motor: _STEP / 3 for motor in closed})
    grasp.support(closed=False)
    if grasp.lost:
        return Lift(*about, off, moved, lost=True)
    shift = min(
        1e3 * (grasp.place(finger, grasp.seen.state) - place) for finger, (place, _) in before.items()
    )
    remains = grasp.off_axis(true_state(grasp.seen))
    return Lift(*about, off, moved, False, shift, min(map(grasp.force, fingers)), remains)


def _foreseen(grasp: Regrasp, finger: str, place: float) -> tuple[bool, float]:
    """Whether the model can hold the object without a finger, and how far it is off the axis then [deg]."""
    seen, model = grasp.seen, grasp.model
    contacts = model.contacts(seen.state)
    others = contacts.select([k for k, name in enumerate(contacts.finger) if name != finger])
    try:
        regular = float(model.linearize(seen.state, others, on_unstable="flag").stability) > 0
    except GraspError:
        regular = False
    delta = torch.zeros(model.hand.n_a, dtype=torch.float64)
    for motor, to in grasp.motors(finger, place, CLEAR, 0.0).items():
        delta[motor] = to - seen.a[motor]
    try:
        step = model.step(seen.state, delta, fingertip_force=seen.fingertip_force)
    except GraspError:  # no equilibrium is near
        return regular, math.nan
    return regular, grasp.off_axis(step.state)


def session(
    setting: Setting, item: str, seed: int, cases: Sequence[tuple[tuple[str, ...], bool]]
) -> list[Any]:
    """All lifts of one grasp."""
    config = setting.plant_config("KM+I")  # increments add up: what a servo leaves undone is commanded again
    plant = SimulatedHand(setting.hand, item, config, setting.parameters, engine=setting.engine)
    plant.reset(seed)
    model, begun = KinematicModel(plant.hand, plant.object, setting.model), plant.snapshot()
    lifts = []
    for fingers, support in cases:
        plant.restore(begun)
        lifts.append(asdict(lift(Regrasp(plant, model), plant.object.name, seed, fingers, support)))
    plant.close()
    return lifts


def verdict_of(lifts: Sequence[Lift]) -> str:
    """The last line."""
    said = []
    for support, name in ((False, "two fingers alone"), (True, "with support")):
        some = [one for one in lifts if one.support == support]
        near, again = sum(one.off <= AXIS and not one.lost for one in some), sum(map(set_again, some))
        lost = sum(one.lost for one in some)
        said.append(f"{name}: within {AXIS:g} deg {near} of {len(some)}, set again {again}, lost {lost}")
    return "; ".join(said)


def table(lifts: Sequence[Lift]) -> Table:
    """A row for each case."""
    rows: list[list[Cell]] = []
    for case in dict.fromkeys(one.case for one in lifts):
        some = [one for one in lifts if one.case == case]
        off = [one.off for one in some if not one.lost]
        foreseen = [one.foreseen for one in some if not math.isnan(one.foreseen)]
        again = list(filter(set_again, some))
        shifts = f"{len(again)} ({np.median([one.shift for one in again]):.1f} mm)" if again else "0"
        rows.append(
            [
                case, f"{sum(one.regular for one in some)} of {len(some)}",
                f"{np.median(foreseen):.0f} ({len(foreseen)})" if foreseen else "none",
                sum(one.lost for one in some),
                f"{np.median(off):.0f} (to {max(off):.0f})" if off else math.nan,
                median(one.moved for one in some if not one.lost), shifts,
                median(one.remains for one in again),
            ]
        )  # fmt: skip
    columns: list[str | Column] = [
        "lifted", "regular in the model", "foreseen [deg]", "lost", "off the axis [deg]",
        Column("moved [mm]", ".1f"), "set again", Column("in the end [deg]", ".0f"),
    ]  # fmt: skip
    note = (
        "Regular: the contacts that remain hold the object in the model, stably. Foreseen: off the axis after"
        " `KinematicModel.step`, median of the lifts for which it finds an equilibrium (how many). Off the"
        " axis and moved: objects that are held, at most while fingers are lifted; median, and the largest."
        f" Set again: held, and each finger bears {BEARS:g} N at a place {SHIFTED:g} mm or more further on"
        " (median shift); in the end: off the axis then, median."
    )
    return Table("lifts", "Fingers lifted and set elsewhere", columns, rows, note)


def median(values: Iterable[float]) -> float:
    """NaN of none."""
    return float(np.median([*values] or [math.nan]))


def picture(lifts: Sequence[Lift]) -> Figure:
    """Off the axis of each lift, by case; what was lost at the upper edge."""
    figure, (axes,) = new_figure(6.5, 3.0)
    cases = list(dict.fromkeys(one.case for one in lifts))
    top = 1.1 * max((one.off for one in lifts if not one.lost), default=AXIS)
    objects = list(dict.fromkeys(one.object for one in lifts))
    colours = COLOURS["E-KM"], COLOURS["KM+I"], COLOURS["KM+S"]  # not the KM's
    for k, item in enumerate(objects):
        colour = colours[k % len(colours)]
        for lost, mark in ((False, "o"), (True, "x")):
            some = [one for one in lifts if one.object == item and one.lost == lost]
            at = [cases.index(one.case) + 0.2 * (k - 0.5) for one in some]
            height = [top if lost else one.off for one in some]
            axes.plot(at, height, mark, color=colour, ms=4, alpha=0.7, label=f"{item}{', lost' * lost}")
    axes.axhline(AXIS, color="0.4", linewidth=0.8)
    axes.set_xticks(range(len(cases)), [case.replace(", ", "\n") for case in cases], fontsize="small")
    axes.set_ylabel("off the axis [deg]")
    axes.legend(frameon=False)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    parser = study_parser(
        __doc__, "regrasp", objects="box,can", seeds="1000:1010", engine="mujoco",
        quick="one object, one seed, the middle finger with and without support",
    )  # fmt: skip
    given = parser.parse_args(arguments)
    objects, seeds, cases = given.objects.split(","), given.seeds, CASES
    if given.quick:
        objects, seeds, cases = objects[:1], seeds[:1], (CASES[1], CASES[4])
    setting, todo = Setting(engine=given.engine), {}
    for seed in seeds:
        for item in objects:
            mark = digest(setting, (item,), cases, CLEAR, FURTHER, SUPPORT)
            todo[f"{Path(item).stem}_{mark}_{seed}"] = setting.hardware_instance(seed), item, seed, cases
    with progress("running", len(todo)) as advance:
        results = run_jobs(session, todo, given.out, given.jobs, advance)
    lifts = [Lift(**one) for some in results.values() for one in some]
    caption = f"How far the object is off its axis while a finger is lifted; line: {AXIS:g} deg."
    verdict, shown = verdict_of(lifts), save_figure(picture(lifts), given.out, "regrasp", caption)
    report = Report("Regrasp", f"{verdict[0].upper()}{verdict[1:]}.", [table(lifts)], [shown])
    report.write(given.out)
    print(report.markdown())
    print(verdict)


if __name__ == "__main__":
    main()
