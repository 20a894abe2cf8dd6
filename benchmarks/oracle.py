"""What does the physics allow? ``python benchmarks/oracle.py --objects tea_tin,carton --seeds 1000:1010``

On the same grasps and angles as ``torch-ekm reproduce generalize``: the E-KM with camera and Hall sensors,
and an oracle, which chooses each motion by the true model of hand and object, the true pose and the true
contact forces. Where both end away from the target, no better model would help. Interrupted, it goes on where
it stopped.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from torch_ekm.cli import parse_seeds
from torch_ekm.control import StopReason
from torch_ekm.experiments.config import Setting
from torch_ekm.experiments.jobs import run_jobs
from torch_ekm.experiments.protocols.foresight import CONTENDERS
from torch_ekm.experiments.protocols.generalize import Generalize
from torch_ekm.experiments.records import TrialRecord
from torch_ekm.experiments.reporting.report import Cell, Column, Table
from torch_ekm.experiments.reporting.statistics import estimate, rate, select, steady_state_error

_REACHED = StopReason.REACHED.value

#: Name here -> name among the contenders of ``reproduce foresight``.
NAMES = {"E-KM": "one-step E-KM", "oracle": "oracle"}


def run(
    objects: Sequence[str], seeds: Sequence[int], folder: Path, jobs: int
) -> dict[str, list[TrialRecord]]:
    """Contender -> its turns of ``generalize``, whose probes are left out."""
    found: dict[str, list[TrialRecord]] = {}
    for name, contender in NAMES.items():
        changes, controller = CONTENDERS[contender]
        plan = Generalize(
            Setting(sensing=True, **changes), tuple(objects), long_step_deg=0.0, blind_deg=0.0,
            controllers=(controller,),
        )  # fmt: skip
        kept = run_jobs(plan.run, plan.jobs(seeds), folder, jobs)
        records = [TrialRecord.from_json(figures) for session in kept.values() for figures in session]
        found[name] = select(records, kind="turn")
    return found


def table(turns: dict[str, list[TrialRecord]]) -> Table:
    """One row for each object, angle and contender."""
    rows: list[list[Cell]] = []
    places = dict.fromkeys((r.object, r.angle_deg) for mine in turns.values() for r in mine)
    for object, angle in places:
        for name, records in turns.items():
            mine = select(records, object=object, angle_deg=angle)
            if not mine:
                continue
            ends = Counter(r.reason for r in mine)
            others = ", ".join(f"{n} {reason}" for reason, n in ends.most_common() if reason != _REACHED)
            reached, lost = rate(r.reason == _REACHED for r in mine), rate(r.lost for r in mine)
            rows.append([object, angle, name, reached, lost, estimate(mine, steady_state_error), others])
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
