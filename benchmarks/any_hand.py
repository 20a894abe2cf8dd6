"""Hands that are wrong in many ways: what the E-KM holds and reaches where integral action does.

    python benchmarks/any_hand.py --families all --objects box,bottle --seeds 1000:1010

Each family is one way in which a plant departs from its description, at three strengths, on the preset
"nominal"; the mixtures are the presets "odd_1" to "odd_5". Turns of 9, 19 and 27 deg; the E-KM has three
turns of warm-up with the object. Finished sessions stay in ``--out``: an interrupted run goes on where it
stopped.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from command_line import study_parser

from torch_ekm._terminal import progress
from torch_ekm.experiments.config import Setting, digest, object_name
from torch_ekm.experiments.jobs import run_jobs
from torch_ekm.experiments.protocols.generalize import Generalize
from torch_ekm.experiments.records import TrialRecord
from torch_ekm.experiments.reporting.plots import COLOURS, new_figure, save_figure
from torch_ekm.experiments.reporting.report import Cell, Column, Report, Table
from torch_ekm.simulation import PlantParameters, preset

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DEG = math.pi / 180
CONTROLLERS = ("KM+I", "KM+S", "E-KM")
ANGLES = (9.0, 19.0, 27.0)
WARM_UP = 3
STRENGTHS = ("weak", "medium", "strong")
#: Family -> the plant's figures at the three strengths.
FAMILIES: dict[str, tuple[dict[str, Any], ...]] = {
    "arms": tuple({"arm_variation": v, "arm_phase": math.pi} for v in (0.1, 0.2, 0.3)),
    "springs_stiffen": tuple({"spring_stiffening": s} for s in (0.25, 0.5, 1.0)),
    "springs_sag": tuple({"spring_stiffening": s} for s in (-0.1, -0.2, -0.3)),
    "cable_friction": tuple({"cable_friction": c} for c in (0.05, 0.1, 0.2)),
    "tendon_coupling": tuple({"tendon_coupling": c} for c in (0.05, 0.1, 0.2)),
    "soft_pads": tuple({"contact_stiffness": k} for k in (2e4, 1e4, 5e3)),
    "joint_play": tuple({"joint_play": p * _DEG} for p in (0.5, 1.0, 2.0)),
    "uneven_friction": tuple({"friction_unevenness": u} for u in (0.1, 0.25, 0.4)),
    "fingertip_scale": tuple({"force_scale": s} for s in (1.25, 1.5, 2.0)),
    "fingertip_drift": tuple({"force_drift": d} for d in (0.02, 0.05, 0.1)),
    "hysteresis": tuple({"hysteresis": h} for h in (0.03, 0.06, 0.1)),
}
#: Name -> the plant, one strength.
OTHERS: dict[str, PlantParameters] = {
    "nominal": preset("nominal"),
    "worn": preset("worn"),
    # no mixture, and the same for every hardware instance
    "odd_hand": preset("nominal").replace(arm_variation=0.25, spring_stiffening=0.5),
    "odd_other": preset("nominal").replace(arm_variation=-0.25, spring_stiffening=-0.3),
    **{name: preset(name) for name in ("odd_1", "odd_2", "odd_3", "odd_4", "odd_5", "hostile")},
    "low_friction": preset("nominal").replace(friction=0.4),
    "no_fingertips": preset("nominal").replace(force_sensors=False),
}


def plants(names: list[str]) -> dict[tuple[str, str], PlantParameters]:
    """The plants of some families, by name and strength."""
    found: dict[tuple[str, str], PlantParameters] = {}
    strong = [f"{family}:strong" for family in FAMILIES]
    groups = {"all": [*FAMILIES, *OTHERS], "strong": [*strong, *OTHERS]}
    for name in itertools.chain.from_iterable(groups.get(name, [name]) for name in names):
        if name in OTHERS:
            found[name, ""] = OTHERS[name]
            continue
        family, _, only = name.partition(":")
        if family not in FAMILIES:
            raise SystemExit(f"'{family}' is no family: {', '.join((*FAMILIES, *OTHERS))}")
        for strength, figures in zip(STRENGTHS, FAMILIES[family], strict=True):
            if only in ("", strength):
                found[family, strength] = preset("nominal").replace(**figures)
    return found


def setting_of(plant: PlantParameters, engine: str = "sapien") -> Setting:
    """True poses plus noise; a dead joint sensor is known as such from the Hall sensors' calibration only."""
    return Setting(plant=plant, engine=engine, sensing=bool(plant.stuck_joints))


def session(
    plant: PlantParameters, item: str, controller: str, seed: int, engine: str = "sapien"
) -> list[dict[str, Any]]:
    """Warm-up (E-KM only), then the turns: how each ended."""
    return turns_of(setting_of(plant, engine), item, controller, seed, ANGLES, WARM_UP)


def turns_of(
    setting: Setting, item: str, controller: str, seed: int, angles: tuple[float, ...], warm_up: int
) -> list[dict[str, Any]]:
    """Warm-up (E-KM only), then the turns: how each ended."""
    protocol = Generalize(setting, (item,), angles, warm_up, 0.0, 0.0)
    return [one.to_json() for one in protocol.session(item, controller, seed) if one.kind == "turn"]


def jobs(
    found: dict[tuple[str, str], PlantParameters],
    objects: list[str],
    seeds: Sequence[int],
    controllers: list[str],
    engine: str,
) -> dict[str, Any]:
    """One for each plant, object, controller and seed."""
    return {
        "_".join(
            [
                *filter(None, (family, strength)),
                object_name(item),
                controller,
                digest(setting_of(plant, engine), (item,), ANGLES, WARM_UP),
                str(seed),
            ]
        ): (plant, item, controller, seed, engine)
        for (family, strength), plant in found.items()
        for seed in seeds
        for item in objects
        for controller in controllers
    }


@dataclass(frozen=True)
class Turns:
    """What came of some turns."""

    records: tuple[TrialRecord, ...]

    @property
    def lost(self) -> int:
        """Objects dropped, or turned off the axis beyond help."""
        return sum(one.lost for one in self.records)

    @property
    def missed(self) -> int:
        """Turns that ended elsewhere with the object in the hand."""
        return sum(one.not_reached for one in self.records)

    @property
    def reached(self) -> int:
        return len(self.records) - self.lost - self.missed

    @property
    def motions(self) -> float:
        """Mean of the turns that reached the target."""
        steps = [one.steps for one in self.records if not (one.lost or one.not_reached)]
        return float(np.mean(steps)) if steps else math.nan

    @property
    def error(self) -> float:
        """Mean true error at the end [deg]; a lost object counts with the whole angle."""
        wrong = [one.angle_deg if one.lost else one.true_error_deg for one in self.records]
        return float(np.mean(wrong)) if wrong else math.nan

    @property
    def other_ends(self) -> str:
        """How those ended that did not reach the target."""
        return count_of(one.reason for one in self.records if one.lost or one.not_reached)

    def __str__(self) -> str:
        return f"{self.lost}, {self.reached}, {self.motions:.1f}"


def count_of(reasons: Iterable[str]) -> str:
    """Each with its number, the most frequent first."""
    return ", ".join(f"{n} {reason}" for reason, n in Counter(reasons).most_common())


class Survey:
    """All turns, by plant and controller."""

    def __init__(self, turns: dict[tuple[str, str, str], list[TrialRecord]]) -> None:
        self.turns = turns
        self.plants = list(dict.fromkeys((family, strength) for family, strength, _ in turns))
        self.controllers = [name for name in CONTROLLERS if any(key[2] == name for key in turns)]

    def of(self, controller: str, plant: tuple[str, str] | None = None) -> Turns:
        """Those of one controller, on one plant or on all."""
        found = (
            records
            for (family, strength, name), records in self.turns.items()
            if name == controller and plant in (None, (family, strength))
        )
        return Turns(tuple(itertools.chain.from_iterable(found)))

    def ratio(self, plant: tuple[str, str] | None = None) -> float:
        """Motions of the E-KM over those of KM+I, of the turns that both reached."""
        ours, theirs = (
            {
                (*key[:2], one.object, one.seed, one.trial): one.steps
                for key, records in self.turns.items()
                for one in records
                if key[2] == name and plant in (None, key[:2]) and not (one.lost or one.not_reached)
            }
            for name in ("E-KM", "KM+I")
        )
        same = ours.keys() & theirs.keys()
        return sum(ours[key] for key in same) / sum(theirs[key] for key in same) if same else math.nan

    @property
    def verdict(self) -> str:
        """The last line."""
        ours, theirs = self.of("E-KM"), self.of("KM+I")
        return "; ".join(
            f"{name} lost {one.lost} of {len(one.records)}, reached {one.reached}, motions {one.motions:.1f}"
            for name, one in (("E-KM", ours), ("KM+I", theirs))
        )

    def totals(self) -> Table:
        """A row for each controller."""
        columns: dict[Column, Callable[[Turns], Cell]] = {
            Column("turns"): lambda turns: len(turns.records),
            Column("lost"): lambda turns: turns.lost,
            Column("reached"): lambda turns: turns.reached,
            Column("motions", ".1f"): lambda turns: turns.motions,
        }
        all_turns = {name: self.of(name) for name in self.controllers}
        return Table.of("totals", "All plants", "controller", all_turns, columns)

    def table(self) -> Table:
        """A row for each plant."""
        rows: list[list[Cell]] = []
        for plant in [*self.plants, None]:
            one = [self.of(name, plant) for name in self.controllers]
            name = "all" if plant is None else " ".join(plant).replace("_", " ").strip()
            rows.append(
                [
                    name,
                    len(one[-1].records),
                    *map(str, one),
                    self.ratio(plant),
                    self.of("E-KM", plant).other_ends,
                ]
            )
        columns = [
            "plant",
            "turns",
            *self.controllers,
            Column("E-KM:KM+I [%]", ".0f", percent=True),
            "other ends of the E-KM",
        ]
        note = (
            "Lost, reached, and mean motions of the turns that reached the target; E-KM:KM+I: motions of the"
            " turns that both reached. Every plant is preset nominal with the family's figures, but worn,"
            " hostile and the mixtures odd 1 to odd 5, which are presets. Poses are true plus noise; of"
            " hostile, which has a dead sensor, from camera and Hall sensors."
        )
        return Table("plants", "Hands of other kinds than described", columns, rows, note)

    def picture(self) -> Figure:
        """Turns lost and not reached, and motions, for each plant."""
        figure, (ends, motions) = new_figure(8.5, 0.24 * len(self.plants) + 1.2, 2, 1, sharey=True)
        for k, name in enumerate(self.controllers):
            colour = COLOURS[name]
            for i, plant in enumerate(self.plants):
                turns = self.of(name, plant)
                at, n = i + 0.26 * (k - 1), max(len(turns.records), 1)
                ends.barh(at, 100 * turns.lost / n, 0.24, color=colour)
                left = 100 * turns.lost / n
                ends.barh(at, 100 * turns.missed / n, 0.24, left=left, color=colour, alpha=0.35)
                motions.plot(turns.motions, i, "o", color=colour, label=name if i == 0 else None)
        names = [" ".join(plant).replace("_", " ").strip() for plant in self.plants]
        ends.set_yticks(range(len(names)), names, fontsize=8)
        ends.set_ylim(len(names) - 0.4, -0.6)
        ends.set_xlabel("turns lost, pale: not reached [%]")
        ends.set_xlim(0, 100)
        motions.set_xlabel("motions of a turn that reached the target")
        motions.set_xlim(0, None)
        motions.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False, fontsize=8)
        return figure

    def report(self, folder: Path, engine: str) -> Report:
        """Table, picture and verdict, in ``folder``."""
        caption = "Ends of the turns on each plant; filled: lost, pale: the target was not reached."
        shown = save_figure(self.picture(), folder, f"any_hand_{engine}", caption)
        report = Report("Hands of other kinds", f"{self.verdict}.", [self.totals(), self.table()], [shown])
        report.write(folder)
        return report


def records_by(
    keys: Mapping[str, Any], results: Mapping[str, Any], kind: type[TrialRecord] = TrialRecord
) -> dict[Any, list[Any]]:
    """What finished sessions left, under the key of each; trials without a grasp are left out."""
    turns: dict[Any, list[Any]] = defaultdict(list)
    for job, trials in results.items():
        made = (kind.from_json(trial) for trial in trials)
        turns[keys[job]] += [one for one in made if isinstance(one, kind)]
    return turns


def main() -> None:
    names = ", ".join((*FAMILIES, *OTHERS))
    parser = study_parser(
        __doc__, "any_hand", objects="box,bottle", seeds="1000:1010", engine="sapien",
        quick="one plant, object and seed",
    )  # fmt: skip
    parser.add_argument(
        "--families", default="all", help=f"all, strong, or of {names}; FAMILY:weak for one strength"
    )
    parser.add_argument("--controllers", default=",".join(CONTROLLERS))
    given = parser.parse_args()
    wanted = given.families.split(",")
    objects, seeds = given.objects.split(","), given.seeds
    if given.quick:
        wanted, objects, seeds = ["odd_1"], objects[:1], seeds[:1]
    found = plants(wanted)
    todo = jobs(found, objects, seeds, given.controllers.split(","), given.engine)
    with progress("running", len(todo)) as advance:
        results = run_jobs(session, todo, given.out, given.jobs, advance)
    where = {plant: key for key, plant in found.items()}
    keys = {name: (*where[plant], controller) for name, (plant, _, controller, *_) in todo.items()}
    survey = Survey(records_by(keys, results))
    print(survey.report(given.out, given.engine).markdown())
    print(survey.verdict)


if __name__ == "__main__":
    main()
