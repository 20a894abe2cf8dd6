"""How far each object can be turned: the upper end of its workspace, of which Table I asks for five shares.

    python benchmarks/workspace.py --seeds 0:8 --out FOLDER

Each seed is another hand; an E-KM makes a turn of 8 deg with the object, then two from fresh grasps toward 90
deg, as far as they go. The end of an object is what three of four grasps reach, in whole degrees. The ends in
``torch_ekm/experiments/protocols/generalize.py`` come from here, on seeds that no page reports. Poses are
true plus noise. Finished sessions stay in ``--out``: an interrupted run goes on where it stopped.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from any_hand import count_of
from command_line import study_parser

from torch_ekm._terminal import progress
from torch_ekm.experiments.config import Setting, digest
from torch_ekm.experiments.jobs import run_jobs
from torch_ekm.experiments.protocols.generalize import ENDS
from torch_ekm.experiments.records import TrialRecord, true_state
from torch_ekm.experiments.reporting.report import Cell, Column, Report, Table
from torch_ekm.experiments.runner import Bench

FAR = 90.0  # [deg] farther than grasps go
WARM_UP = 8.0  # [deg]
SHARE = 0.25  # of the grasps may end before the end
_FIRST = 3000  # number of the first grasp
_GRASPS = 2


def session(setting: Setting, item: str, far_deg: float, seed: int) -> list[dict[str, Any]]:
    """The turns of one hand: the largest true angle while the object was held, and how each ended."""
    bench, found = Bench(setting.hardware_instance(seed), item, "E-KM"), []
    bench.trial(seed, _FIRST - 1, WARM_UP, "warm-up")
    axis = bench.hand.rotation_axis
    for k in range(_GRASPS):
        done = bench.trial(seed, _FIRST + k, far_deg, "far")
        if isinstance(done, TrialRecord) and bench.last is not None:
            states = [true_state(step.before) for step in bench.last.steps]
            states += [] if done.lost else [true_state(bench.last.stop.final)]
            turned = [float(axis @ state.minus(states[0])[-3:]) for state in states]
            largest = float(np.rad2deg(max(turned, default=0.0)))
            found.append({"object": bench.name, "angle": largest, "end": done.reason, "lost": done.lost})
    bench.close()
    return found


def end_of(angles: Sequence[float]) -> int:
    """What three of four grasps reach, in whole degrees."""
    return int(np.quantile(angles, SHARE))


def ends_table(turns: Sequence[dict[str, Any]]) -> Table:
    """A row for each object."""
    by: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for turn in turns:
        by[turn["object"]].append(turn)
    rows: list[list[Cell]] = []
    for item, mine in by.items():
        angles = [turn["angle"] for turn in mine]
        ends = count_of(turn["end"] for turn in mine)
        spread = min(angles), float(np.median(angles)), max(angles)
        lost = sum(turn["lost"] for turn in mine)
        rows.append([item, len(mine), *spread, end_of(angles), lost, ends])
    columns: list[str | Column] = [
        "object", "grasps", Column("least [deg]", ".1f"), Column("median [deg]", ".1f"),
        Column("most [deg]", ".1f"), "end [deg]", "lost", "how they ended",
    ]  # fmt: skip
    note = f"Largest true angle of turns toward {FAR:g} deg; end: what three of four grasps reach."
    return Table("ends", "How far each object turns", columns, rows, note)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = study_parser(
        __doc__, "workspace", objects=",".join(ENDS), seeds="0:8", engine="sapien",
        quick="one object, one seed",
    )  # fmt: skip
    given = parser.parse_args(arguments)
    objects, seeds, far = given.objects.split(","), given.seeds, FAR
    if given.quick:
        objects, seeds, far = objects[:1], seeds[:1], 5.0
    setting = Setting(engine=given.engine)
    todo = {
        f"{Path(item).stem}_{digest(setting, (item,), far, WARM_UP)}_{seed}": (setting, item, far, seed)
        for seed in seeds
        for item in objects
    }
    with progress("running", len(todo)) as advance:
        results = run_jobs(session, todo, given.out, given.jobs, advance)
    table = ends_table([turn for turns in results.values() for turn in turns])
    ends = ", ".join(f"{row[0]} {row[5]}" for row in table.rows)
    report = Report("Workspaces", f"Ends [deg]: {ends}.", [table])
    report.write(given.out)
    print(report.markdown())
    print(f"ends [deg]: {ends}")


if __name__ == "__main__":
    main()
