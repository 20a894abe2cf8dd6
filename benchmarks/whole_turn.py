"""A turn as one movement: what a plan is worth without a learner, and what f that adapts and g add to it.

    python benchmarks/whole_turn.py --objects box,can,bottle --seeds 0:2

Hands: preset nominal, and three that lose objects. A session is one object, hand, seed and contender: turns
of 14, -8 and 22 deg, in which the hand is learned, then 9, 19 and 27 deg, each from a fresh grasp, the same
for all. The camera has 20 Hz and is 0.05 s late. With ``--variants`` parts of the plan are changed or left
out, on the hands that lose. Finished sessions stay in ``--out``: an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from any_hand import OTHERS, Turns, records_by
from command_line import study_parser

from torch_ekm._terminal import progress
from torch_ekm.control import ClosedLoop, Manipulation, OneStep, WholeTurn
from torch_ekm.experiments.config import Setting, digest, object_name
from torch_ekm.experiments.jobs import run_jobs
from torch_ekm.experiments.records import TrialRecord, true_state
from torch_ekm.experiments.reporting.plots import new_figure, save_figure
from torch_ekm.experiments.reporting.report import Cell, Column, Report, Table
from torch_ekm.experiments.reporting.statistics import Rate, rate
from torch_ekm.experiments.runner import Bench
from torch_ekm.simulation import PlantParameters, preset
from torch_ekm.typing import Float, Tensor

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DEG = math.pi / 180
LEARNS_BY, ANGLES = (14.0, -8.0, 22.0), (9.0, 19.0, 27.0)  # [deg]
_FIRST_GRASP = 1000  # its number, of the turns in which the hand is learned
_INTERVAL = 1.645  # standard deviations: 90 %
_MADE = 0.8  # of a movement: one that was ended on its way says nothing of the band at its end
PLANTS: dict[str, PlantParameters] = {
    "nominal": OTHERS["nominal"],
    "fingertips x 2": preset("nominal").replace(force_scale=2.0),
    "friction 0.4": OTHERS["low_friction"],
    "odd 4": OTHERS["odd_4"],
}


class UnwatchedLoop(ClosedLoop):
    """Readings on the way end no movement."""

    def __init__(self, *given: Any, **options: Any) -> None:
        super().__init__(*given, **options)
        send = self.plant.send_path
        self.plant.send_path = lambda path, watch, *rest: send(path, lambda seen: True, *rest)


class UnwatchedBench(Bench):
    """Movements go to their end."""

    loops = UnwatchedLoop


@dataclass(frozen=True)
class Contender:
    """A controller of the bench, and what it has other than a :class:`Setting` of its own."""

    controller: str = "E-KM"
    changes: Mapping[str, Any] | None = None
    bench: type[Bench] = Bench


def _plan(**figures: float) -> Contender:
    return Contender("E-KM", {"planner": WholeTurn(**figures)})


CONTENDERS = {
    "E-KM": Contender(),
    "without plan": Contender("E-KM", {"planner": OneStep()}),
    "KM": Contender("KM"),
    "KM+S": Contender("KM+S"),
    "KM + plan": Contender("KM", {"planner": WholeTurn()}),
    "KM+S + plan": Contender("KM+S", {"planner": WholeTurn()}),
    "f alone + plan": Contender("E-KM", {"learner": "model alone"}),
    "g alone + plan": Contender("E-KM", {"adapts": False}),
}
VARIANTS = {
    "as it is": Contender(),
    "1 deviation": _plan(deviations=1.0),
    "3 deviations": _plan(deviations=3.0),
    "off the axis by 4 deg": _plan(off_rotation=4 * _DEG),
    "off the axis by 16 deg": _plan(off_rotation=16 * _DEG),
    "no band of forces": _plan(force=-math.inf),
    "no bands": _plan(force=-math.inf, off_rotation=math.inf),
    "no watch on the way": Contender(bench=UnwatchedBench),
    "without plan": CONTENDERS["without plan"],
    "without plan and bound": Contender("E-KM", {"planner": OneStep(), "bound": None}),
}


@dataclass(frozen=True)
class Turn(TrialRecord):
    """A turn, and how it went on the way."""

    bands: tuple[Any, ...] = ()
    """Pieces of each movement, and its end in standard deviations: about the axis, off it, normal forces."""
    way: tuple[Any, ...] = ()
    """Time [s] and true rotation [deg] at rest."""


def session(name: str, one: Contender, setting: Setting, item: str, seed: int) -> list[dict[str, Any]]:
    """The turns in which the hand is learned, of which the first counts apart, then the others."""
    setting = setting.hardware_instance(seed).replace(**(one.changes or {}))
    bench, made = one.bench(setting, item, one.controller), []
    kinds = "first", *("learning",) * (len(LEARNS_BY) - 1)
    trials = [*zip(itertools.count(_FIRST_GRASP), LEARNS_BY, kinds, strict=False)]
    for trial, angle, kind in [*trials, *((k, angle, "turn") for k, angle in enumerate(ANGLES))]:
        record = bench.trial(seed, trial, angle, kind)
        if isinstance(record, TrialRecord) and bench.last is not None:
            axis = bench.hand.rotation_axis
            record = Turn(**vars(record), bands=bands_of(bench.last, axis), way=way_of(bench.last, axis))
        made.append(record.to_json())
    bench.close()
    return made


def bands_of(done: Manipulation, axis: Float[Tensor, " 3"]) -> tuple[Any, ...]:
    """What :attr:`Turn.bands` keeps; the covariance of the axis with other directions is left out."""
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
    return tuple(found)


def way_of(done: Manipulation, axis: Float[Tensor, " 3"]) -> tuple[Any, ...]:
    """What :attr:`Turn.way` keeps."""
    seen = [one for step in done.steps for one in (step.before, step.after)] + [done.stop.final]
    first = true_state(seen[0])
    turned = (float(axis @ true_state(one).minus(first)[-3:]) / _DEG for one in seen)
    return tuple([one.time - seen[0].time, angle] for one, angle in zip(seen, turned, strict=True))


class Movements(Turns):
    """What came of some turns, movements counted."""

    def of(self, name: str, summary: Callable[..., Any] = np.mean) -> float:
        """A figure of the turns that reached the target; NaN: there is none."""
        found = [getattr(one, name) for one in self.records if not (one.lost or one.not_reached)]
        return float(summary(found)) if found else math.nan

    def off(self, share: float) -> float:
        """Quantile of the rotation off the axis at the end, lost objects left out [deg]."""
        held = [one.off_rotation_deg for one in self.records if not one.lost]
        return float(np.quantile(held, share)) if held else math.nan

    def __str__(self) -> str:
        ends = f"lost {self.lost} of {len(self.records)}, reached {self.reached}, turning movements "
        ends += f"{self.of('turning'):.1f}, all motions {self.motions:.1f}, seconds "
        return f"{ends}{self.of('simulated_s'):.1f}"


_NOTE = "Motions and seconds of turns that reached the target; a lost object's error is the whole angle."
_COLUMNS: dict[Column, Callable[[Movements], Cell]] = {
    Column("turns"): lambda turns: len(turns.records),
    Column("lost"): lambda turns: turns.lost,
    Column("reached"): lambda turns: turns.reached,
    Column("turning movements, median", ".1f"): lambda turns: turns.of("turning", np.median),
    Column("mean", ".1f"): lambda turns: turns.of("turning"),
    Column("all motions", ".1f"): lambda turns: turns.motions,
    Column("seconds", ".1f"): lambda turns: turns.of("simulated_s"),
    Column("off the axis, median [deg]", ".1f"): lambda turns: turns.off(0.5),
    Column("largest [deg]", ".1f"): lambda turns: turns.off(1.0),
    Column("true error [deg]"): lambda turns: turns.error,
    Column("other ends"): lambda turns: turns.other_ends,
}


class Comparison:
    """All turns, by contender, plant, object and seed."""

    def __init__(self, turns: Mapping[tuple[str, str, str, int], Sequence[Turn]]) -> None:
        self.turns = turns
        self.names = list(dict.fromkeys(name for name, *_ in turns))
        self.plants = list(dict.fromkeys(plant for _, plant, *_ in turns))

    def of(self, name: str, plant: str | None = None, kind: str = "turn") -> list[Turn]:
        """Those of one contender, on one plant or on all."""
        found = (turns for key, turns in self.turns.items() if key[0] == name and plant in (None, key[1]))
        return [one for one in itertools.chain.from_iterable(found) if one.kind == kind]

    def table(self, kind: str, title: str) -> Table:
        """A row for each contender."""
        items = {name: Movements(tuple(self.of(name, kind=kind))) for name in self.names}
        return Table.of(f"whole_turn_{kind}", title, "contender", items, _COLUMNS, _NOTE)

    def by_plant(self) -> Table:
        """Lost, reached, turning movements and seconds on each plant."""

        def cell(one: Movements) -> str:
            return f"{one.lost}, {one.reached}, {one.of('turning'):.1f}, {one.of('simulated_s'):.1f} s"

        found = {name: [Movements(tuple(self.of(name, p))) for p in self.plants] for name in self.names}
        rows = [[name, *map(cell, turns)] for name, turns in found.items()]
        return Table("plants", "Lost, reached, turning movements, time", ["contender", *self.plants], rows)

    def calibration(self) -> Table:
        """How much the stated 90 % intervals hold."""
        first = self.names[0]
        groups: dict[str, Iterable[Turn]] = {f"{first}, {p}": self.of(first, p) for p in self.plants}
        groups |= {name: self.of(name) for name in self.names}
        bands = {name: [band for one in turns for band in one.bands] for name, turns in groups.items()}
        for size, low, high in (("1 piece", 1, 1), ("2 to 4 pieces", 2, 4), ("5 pieces or more", 5, 99)):
            bands[f"{first}, {size}"] = [band for band in bands[first] if low <= band[0] <= high]

        def held(deviations: Iterable[float]) -> Rate | None:
            found = [abs(z) < _INTERVAL for z in deviations]
            return rate(found) if found else None

        columns: dict[Column, Callable[[list[Any]], Cell]] = {
            Column("movements"): len,
            Column("about the axis"): lambda found: held(band[1] for band in found),
            Column("off the axis"): lambda found: held(band[2] for band in found),
            Column("normal forces"): lambda found: held(z for band in found for z in band[3]),
        }
        note = "Share of what was measured after a planned movement that is in its stated 90 % interval."
        items = {name: found for name, found in bands.items() if found}
        return Table.of("calibration", "Bands of the plans", "group", items, columns, note)

    def picture(self) -> Figure:
        """Angle against time: the first object and seed, the largest angle."""
        figure, (axis,) = new_figure(7.0, 3.6)
        for k, name in enumerate(self.names):
            turns = self.of(name, self.plants[0])
            if turns:
                turn = max(turns[: len(ANGLES)], key=lambda one: one.angle_deg)
                time, angle = zip(*turn.way, strict=True)
                axis.plot(time, angle, color=f"C{k}", marker="o", markersize=2.5, label=name)
        axis.set(xlabel="time [s]", ylabel="rotation [deg]")
        axis.legend(frameon=False, fontsize=8)
        return figure

    @property
    def verdict(self) -> str:
        """The last line."""
        return "; ".join(f"{name} {Movements(tuple(self.of(name)))}" for name in self.names)

    def report(self, folder: Path) -> Report:
        """Tables and picture, in ``folder``."""
        shown = save_figure(self.picture(), folder, "whole_turn", "One turn: true angles at rest.")
        known = self.table("turn", "Turns after the hand is learned")
        unknown = self.table("first", "The first turn of a hand of which nothing is known")
        tables = [known, unknown, self.by_plant(), self.calibration()]
        report = Report("Whole turns", f"{self.verdict}.", tables, [shown], leading=2)
        report.write(folder)
        return report


def main(arguments: Sequence[str] | None = None) -> None:
    parser = study_parser(
        __doc__, "whole_turn", objects="box,can,bottle", seeds="0:2", engine="mujoco",
        quick="one object, seed and hand, two contenders",
    )  # fmt: skip
    parser.add_argument("--variants", action="store_true", help="of the plan, on hands that lose")
    parser.add_argument("--contenders", help=f"some of {', '.join(CONTENDERS)}; or variants")
    parser.add_argument("--plants", help=f"some of {', '.join(PLANTS)}")
    given = parser.parse_args(arguments)
    known, plants = (VARIANTS, [*PLANTS][1:]) if given.variants else (CONTENDERS, [*PLANTS])
    names = given.contenders.split(",") if given.contenders else list(known)
    plants, objects = given.plants.split(",") if given.plants else plants, given.objects.split(",")
    if given.quick:
        names, plants, objects, given.seeds = names[:2], plants[:1], objects[:1], given.seeds[:1]
    todo, keys = {}, {}
    for plant, seed, item, name in itertools.product(plants, given.seeds, objects, names):
        figures = PLANTS[plant].replace(frame_rate=20.0, latency=0.05)
        setting, one = Setting(plant=figures, engine=given.engine), known[name]
        decides = digest(setting.replace(**(one.changes or {})), (item,), LEARNS_BY, ANGLES, one.bench)
        job = f"{plant}_{object_name(item)}_{name}_{decides}_{seed}".replace(" ", "_")
        todo[job], keys[job] = (name, one, setting, item, seed), (name, plant, object_name(item), seed)
    with progress("running", len(todo)) as advance:
        results = run_jobs(session, todo, given.out, given.jobs, advance)
    comparison = Comparison(records_by(keys, results, Turn))
    print(comparison.report(given.out).markdown(), comparison.verdict, sep="\n")


if __name__ == "__main__":
    main()
