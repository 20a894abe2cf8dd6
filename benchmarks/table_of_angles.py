"""Which angles of Table I does an exact model reach? ``benchmarks/table_of_angles.py --out DIR``

The controller's model is made of the hand and object as the plant has them (an upper bound, no learner);
what is left of preset "nominal" is the noise, friction, dead band and the error of the position
controller. Increments add up on the set-points. An angle counts as reached when the object is held and
its true error about the axis is below 1 deg. Interrupted, it goes on where it stopped.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from pathlib import Path
from typing import Any

import torch

from torch_ekm.control import ClosedLoop, LookAndMoveController, PoseTarget
from torch_ekm.exceptions import EKMError
from torch_ekm.experiments.config import Setting, digest
from torch_ekm.experiments.jobs import run_jobs
from torch_ekm.experiments.protocols.generalize import TABLE_I
from torch_ekm.model import KinematicModel
from torch_ekm.simulation import SimulatedHand

_DEG = math.pi / 180
_REACHED = 1.0  # [deg]


def turn(object: str, seed: int, level: str) -> list[dict[str, Any]]:
    """All angles of Table I from the grasp of one seed, each from a new grasp."""
    torch.set_num_threads(1)
    setting = Setting(preset=level)
    plant = SimulatedHand("icub_right", object, setting.plant_config("KM+I"), setting.parameters())
    model = KinematicModel(*plant.true_descriptions(), setting.model_options())
    rule = setting.stopping_rule()
    records: list[dict[str, Any]] = []
    for angle in TABLE_I[object]:
        record: dict[str, Any] = {"object": object, "seed": seed, "angle_deg": angle, "error_deg": None}
        try:
            start = plant.reset(seed).state
            axis = plant.rotation_axis
            target = PoseTarget.turned(start, axis, degrees=angle)
            done = ClosedLoop(plant, LookAndMoveController(model, axis), rule).run(target)
            assert done.stop.final.truth is not None  # a simulated hand tells
            error, lost = done.focus.error(target, done.stop.final.truth.state) / _DEG, done.lost
            record |= {
                "reason": done.reason.value,
                "steps": len(done.steps),
                "error_deg": error,
                "reached": error < _REACHED and not lost,
            }
        except EKMError as problem:  # no pinch, or none that held: the table must say so
            record |= {"reason": type(problem).__name__, "message": str(problem), "reached": False}
        records.append(record)
    plant.close()
    return records


def table(records: list[dict[str, Any]]) -> str:
    """Markdown: reached out of how many, and why the others stopped."""
    lines = ["| object | angle [deg] | reached | median true error [deg] | why the others stopped |"]
    lines.append("|---|---|---|---|---|")
    for object, angles in TABLE_I.items():
        for angle in angles:
            rows = [r for r in records if (r["object"], r["angle_deg"]) == (object, angle)]
            if not rows:
                continue
            errors = torch.tensor([r["error_deg"] for r in rows if r["error_deg"] is not None])
            median = f"{float(errors.quantile(0.5)):.2f}" if len(errors) else "-"
            why = Counter(r["reason"] for r in rows if not r["reached"]).most_common()
            text = ", ".join(f"{count} {reason}" for reason, count in why)
            reached = sum(r["reached"] for r in rows)
            lines.append(f"| {object} | {angle:g} | {reached}/{len(rows)} | {median} | {text} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("table_of_angles"))
    parser.add_argument("--seeds", type=int, default=20, help="how many")
    parser.add_argument("--first", type=int, default=1000, help="the first seed; below 100: for development")
    parser.add_argument("--objects", nargs="+", default=list(TABLE_I), choices=list(TABLE_I))
    parser.add_argument("--preset", default="nominal")
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    level = options.preset
    # seeds outermost: an interrupted run has the same seeds of every object
    seeds = range(options.first, options.first + options.seeds)
    jobs = {f"{o}_{s}": (o, s, level) for s in seeds for o in options.objects}
    count = iter(range(1, len(jobs) + 1))
    folder = options.out / digest(Setting(preset=level), TABLE_I)  # other figures of the plant: other results
    done = run_jobs(
        turn, jobs, folder, options.jobs, lambda name: print(f"{next(count)}/{len(jobs)} {name}", flush=True)
    )
    text = table([record for records in done.values() for record in records])
    (options.out / "table.md").write_text(text + "\n", encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
