"""What does the physics allow? ``python oracle.py --objects tea_tin,carton --seeds 1000:1010``

On the same grasps and angles as ``torch-ekm reproduce generalize``: the E-KM with camera and Hall sensors,
and an oracle, which plans with the true model of hand and object, the true pose and the true contact forces.
It has no doubts: it goes on until its model says that a finger leaves the object, or that this is dislocated.
Where both end away from the target, no better model would help. Interrupted, it goes on where it stopped.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

from torch_ekm.cli._app import parse_seeds
from torch_ekm.control import StoppingRule, StopReason, WholeTurn
from torch_ekm.experiments.config import Setting
from torch_ekm.experiments.jobs import run_jobs
from torch_ekm.experiments.protocols.generalize import Generalize
from torch_ekm.experiments.records import TrialRecord
from torch_ekm.experiments.reporting.report import Cell, Column, Table
from torch_ekm.experiments.reporting.statistics import DataFrame, estimate, rate
from torch_ekm.experiments.reporting.trials import select, trial_frame
from torch_ekm.experiments.runner import Bench
from torch_ekm.model import KinematicModel, ModelOptions
from torch_ekm.plant import Observation, PlantStatus
from torch_ekm.plant.wrapper import PlantWrapper
from torch_ekm.simulation import SimulatedHand
from torch_ekm.simulation.mechanism.assembly import true_hand, true_object

_REACHED = StopReason.REACHED.value
_NO_DOUBTS = WholeTurn(deviations=0.0, off_rotation=StoppingRule().off_limit, force=0.0)


class Omniscient(PlantWrapper):
    """A simulated plant whose joints, pose and fingertip forces are reported as they are."""

    def observation(self, seen: Observation) -> Observation:
        truth = seen.truth
        if truth is None or seen.status is PlantStatus.LOST:
            return seen
        known = {name: getattr(truth, name) for name in ("q", "position", "rotation", "fingertip_force")}
        return dataclasses.replace(seen, **known)


def true_model(plant: SimulatedHand, options: ModelOptions) -> KinematicModel:
    """The kinematic model of the plant's own tendons, springs and object."""
    hand, obj = true_hand(plant.hand, plant.parameters), true_object(plant.object, plant.parameters)
    return KinematicModel(hand, obj, options)


class OracleBench(Bench):
    """A bench whose model is the plant's own, and whose pose, joints and forces are the true ones."""

    def __init__(self, setting: Setting, *arguments: Any, **options: Any) -> None:
        super().__init__(setting.replace(planner=_NO_DOUBTS), *arguments, **options)
        self.plant = Omniscient(self.plant)
        self.model = true_model(self.hand, self.setting.model)


@dataclasses.dataclass(frozen=True)
class OracleGeneralize(Generalize):
    """The turns of :class:`Generalize`, by an oracle."""

    bench: ClassVar[type[Bench]] = OracleBench

    def jobs(self, seeds: Sequence[int]) -> dict[str, tuple[str, str, int]]:
        """Under names of their own."""
        return {f"oracle_{name}": job for name, job in super().jobs(seeds).items()}


#: Figures of :class:`Generalize` without probes and new objects.
TURNS_ALONE: dict[str, Any] = {"long_step_deg": 0.0, "blind_deg": 0.0, "new_objects": False}
#: Name -> how its turns are run, and the controller of the bench.
CONTENDERS: dict[str, tuple[type[Generalize], str]] = {
    "E-KM": (Generalize, "E-KM"),
    "oracle": (OracleGeneralize, "KM+S"),
}


def run(objects: Sequence[str], seeds: Sequence[int], folder: Path, jobs: int) -> DataFrame:
    """The turns of ``generalize`` of each contender, without the probes and the new objects."""
    found = {}
    for name, (protocol, controller) in CONTENDERS.items():
        plan = protocol(Setting(sensing=True), tuple(objects), controllers=(controller,), **TURNS_ALONE)
        kept = run_jobs(plan.run, plan.jobs(seeds), folder, jobs)
        found[name] = [TrialRecord.from_json(figures) for session in kept.values() for figures in session]
    trials = trial_frame(found, Setting().safety.rule.max_steps).rename(columns={"job": "contender"})
    return select(trials, kind="turn")


def table(turns: DataFrame) -> Table:
    """One row for each object, angle and contender."""
    rows: list[list[Cell]] = []
    for (object, angle), place in turns.groupby(["object", "angle_deg"], sort=False):
        for name, mine in place.groupby("contender", sort=False):
            ends = mine["reason"].value_counts().drop(_REACHED, errors="ignore")
            others = ", ".join(f"{n} {reason}" for reason, n in ends.items())
            reached, lost = rate(mine["reason"] == _REACHED), rate(mine["lost"])
            rows.append([object, angle, name, reached, lost, estimate(mine, "error_deg"), others])
    columns = [
        "object", Column("angle [deg]", ".0f"), "contender", "reached", "lost",
        Column("error [deg]", ".2f"), "why the others ended",
    ]  # fmt: skip
    return Table("oracle", "The E-KM and an oracle", columns, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--objects", default="tea_tin,carton", help="names separated by commas")
    parser.add_argument("--seeds", type=parse_seeds, default=range(1000, 1010), help="FIRST:END")
    parser.add_argument(
        "--out", type=Path, default=Path("benchmark_output/oracle"), help="keeps what is finished"
    )
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--quick", action="store_true", help="one seed: to see that it works")
    options = parser.parse_args()
    seeds = list(options.seeds)[: 1 if options.quick else None]
    found = table(run(options.objects.split(","), seeds, options.out, options.jobs))
    for line in (found.header, ["---"] * len(found.columns), *found.text()):
        print("|", " | ".join(line), "|")


if __name__ == "__main__":
    main()
