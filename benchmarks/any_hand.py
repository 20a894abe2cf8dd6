"""Hands that are wrong in many ways: what the E-KM holds and reaches where integral action does.

    python benchmarks/any_hand.py --families all --objects box,bottle --seeds 1000:1003

Each family is one way in which a plant departs from its description, at three strengths, on the preset
"nominal"; the mixtures are the presets "odd_1" to "odd_5". Turns of 9, 19 and 27 deg; the E-KM has three
turns of warm-up with the object. Finished sessions stay in ``--out``: an interrupted run goes on where it
stopped.
"""

from __future__ import annotations

import argparse
import math
import os
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import Progress

from torch_ekm.experiments.config import Setting, object_name
from torch_ekm.experiments.jobs import run_jobs
from torch_ekm.experiments.protocols.generalize import Generalize
from torch_ekm.experiments.records import TrialRecord
from torch_ekm.simulation import PlantParameters, preset

_DEG = math.pi / 180
CONTROLLERS = ("KM+I", "KM+S", "E-KM")
ANGLES = (9.0, 19.0, 27.0)
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
    # the plant that showed what was wrong: round pulleys and linear springs are taken for granted
    "odd_hand": preset("nominal").replace(arm_variation=0.25, spring_stiffening=0.5),
    "odd_other": preset("nominal").replace(arm_variation=-0.25, spring_stiffening=-0.3),
    **{name: preset(name) for name in ("odd_1", "odd_2", "odd_3", "odd_4", "odd_5", "hostile")},
    "low_friction": preset("nominal").replace(friction=0.4),
    "no_fingertips": preset("nominal").replace(force_sensors=False),
}


def plants(names: list[str]) -> dict[tuple[str, str], PlantParameters]:
    """The plants of some families, by name and strength."""
    found: dict[tuple[str, str], PlantParameters] = {}
    for name in names:
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


def session(plant: PlantParameters, item: str, controller: str, seed: int) -> list[dict[str, Any]]:
    """Warm-up (E-KM only), then the turns: how each ended."""
    setting = Setting(plant=plant)
    protocol = Generalize(setting, (item,), ANGLES, 3, 0.0, 0.0)
    return [one.to_json() for one in protocol.session(item, controller, seed) if one.kind == "turn"]


def jobs(found: dict[tuple[str, str], PlantParameters], objects: list[str], seeds: range) -> dict[str, Any]:
    """One for each plant, object, controller and seed."""
    return {
        "_".join(filter(None, (family, strength, object_name(item), controller, str(seed)))): (
            plant, item, controller, seed
        )
        for (family, strength), plant in found.items()
        for seed in seeds
        for item in objects
        for controller in CONTROLLERS
    }  # fmt: skip


@dataclass(frozen=True)
class Row:
    """What came of one plant with one controller."""

    family: str
    strength: str
    controller: str
    turns: int
    lost: int
    reached: int
    motions: float
    """Mean of the turns that reached the target."""
    ends: str
    """How the other turns ended."""

    @classmethod
    def of(cls, family: str, strength: str, controller: str, records: list[TrialRecord]) -> Row:
        """The figures of some turns."""
        reached = [one for one in records if not (one.lost or one.not_reached)]
        motions = float(np.mean([one.steps for one in reached])) if reached else math.nan
        ends = Counter(
            "object lost" if one.lost else one.reason for one in records if one.lost or one.not_reached
        )
        text = ", ".join(f"{n} {reason}" for reason, n in ends.most_common())
        lost = sum(one.lost for one in records)
        return cls(family, strength, controller, len(records), lost, len(reached), motions, text)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    names = ", ".join((*FAMILIES, *OTHERS))
    parser.add_argument("--families", default="all", help=f"of {names}; FAMILY:strong for one strength")
    parser.add_argument("--objects", default="box,bottle", help="names or paths")
    parser.add_argument("--seeds", default="1000:1003", help="FIRST:END")
    parser.add_argument("--controllers", default=",".join(CONTROLLERS))
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--out", type=Path, default=Path("any_hand_output"))
    parser.add_argument("--quick", action="store_true", help="one seed, one object")
    given = parser.parse_args()
    wanted = [*FAMILIES, *OTHERS] if given.families == "all" else given.families.split(",")
    found, objects = plants(wanted), given.objects.split(",")
    seeds = range(*map(int, given.seeds.split(":")))
    if given.quick:
        objects, seeds = objects[:1], seeds[:1]
    todo = jobs(found, objects, seeds)
    todo = {name: job for name, job in todo.items() if job[2] in given.controllers.split(",")}
    with Progress() as progress:
        bar = progress.add_task("sessions", total=len(todo))
        results = run_jobs(session, todo, given.out, given.processes, lambda _: progress.advance(bar))
    records: dict[tuple[str, str, str], list[TrialRecord]] = defaultdict(list)
    where = {plant: key for key, plant in found.items()}
    for name, turns in results.items():
        plant, _, controller, _ = todo[name]
        made = [TrialRecord.from_json(turn) for turn in turns]
        records[*where[plant], controller] += [one for one in made if isinstance(one, TrialRecord)]
    rows = [Row.of(*key, turns) for key, turns in records.items()]
    print("| plant | strength | controller | turns | lost | reached | motions | else |")
    print("|---|---|---|---|---|---|---|---|")
    for row in rows:
        figures = f"{row.turns} | {row.lost} | {row.reached} | {row.motions:.1f} | {row.ends}"
        print(f"| {row.family} | {row.strength} | {row.controller} | {figures} |")
    totals = {
        name: Row.of(
            "all", "", name, [one for key, turns in records.items() if key[2] == name for one in turns]
        )
        for name in CONTROLLERS
    }
    ours, theirs = totals["E-KM"], totals["KM+I"]
    print(
        f"E-KM lost {ours.lost} of {ours.turns}, reached {ours.reached}, motions {ours.motions:.1f}; "
        f"KM+I lost {theirs.lost} of {theirs.turns}, reached {theirs.reached}, motions {theirs.motions:.1f}"
    )


if __name__ == "__main__":
    main()
