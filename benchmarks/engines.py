"""The same hands in two physics engines: what depends on the engine, and what does not.

    python benchmarks/engines.py --objects box,can --seeds 1000:1010

Turns of Table I by the E-KM, after three turns of warm-up, in SAPIEN and in MuJoCo, on presets nominal and
worn; then one step of the kinematic model, with nothing unknown to it, and how far a held object creeps.
Finished sessions stay in ``--out``: an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from any_hand import Turns, records_by

from torch_ekm._terminal import progress
from torch_ekm.cli._app import parse_seeds
from torch_ekm.exceptions import EKMError
from torch_ekm.experiments.config import Setting, digest, object_name
from torch_ekm.experiments.jobs import run_jobs
from torch_ekm.experiments.protocols.generalize import TABLE_I, Generalize
from torch_ekm.experiments.records import TrialRecord
from torch_ekm.experiments.reporting.plots import new_figure, save_figure
from torch_ekm.experiments.reporting.report import Cell, Column, Report, Table
from torch_ekm.kinematics.se3 import log
from torch_ekm.model import KinematicModel, ModelOptions
from torch_ekm.simulation import ENGINES, SimulatedHand

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from turning_step import true_state, turning_step

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DEG = np.pi / 180
_COLOURS = {"sapien": "#0072B2", "mujoco": "#D55E00"}
_STEPS, _STEP = 6, 1.5 * _DEG  # of the probe of the kinematic model
_TO_SPARE = 0.1  # of a contact's friction, from which on it may slide in a step
_REST = 20.0  # [s] that a held object is left alone
_WARM_UP = 3


def session(setting: Setting, item: str, controller: str, seed: int) -> list[dict[str, Any]]:
    """Turns of Table I, after the warm-up."""
    protocol = Generalize(setting, (item,), None, _WARM_UP, 0.0, 0.0)
    return [one.to_json() for one in protocol.session(item, controller, seed) if one.kind == "turn"]


def probe(engine: str, item: str, seed: int) -> dict[str, float] | None:
    """Error of a step [deg, mm], creep of a held object [deg, mm] and time of a command [s]; None: no grasp.

    Steps end where a contact has less than a tenth of its friction to spare, or a link touches.
    """
    plant = SimulatedHand("icub_right", item, engine=engine)
    try:
        observation = plant.reset(seed)
        rested = [true_state(observation)]
        plant.wait(_REST)
        observation = plant.observe()
        rested.append(true_state(observation))
        model = KinematicModel(plant.hand, plant.object, ModelOptions(on_unstable="flag"))
        axis, state, grip, errors, spent = plant.rotation_axis, rested[1], None, [], 0.0
        for _ in range(_STEPS):
            lin = model.linearize(state)
            grip = lin.forces.normal if grip is None else grip
            links = [name for name in model.touching(state).finger if name in model.link_names]
            if errors and (links or float(lin.forces.relative_margin.min()) < _TO_SPARE):
                break
            da = turning_step(lin, axis, _STEP, grip)
            start = time.process_time()
            observation = plant.command(da)
            spent += time.process_time() - start
            after = true_state(observation)
            off = after.minus(state) - lin.step(da)
            errors.append((float(off[-3:].norm()) / _DEG, 1e3 * float(off[-6:-3].norm())))
            state = after
    except EKMError:
        return None
    creep = log(rested[1].rotation @ rested[0].rotation.T).norm() / _DEG
    moved = 1e3 * (rested[1].position - rested[0].position).norm()
    turned, shifted = np.mean(errors, axis=0).tolist()
    return {
        "error": turned, "shift": shifted, "creep": float(creep), "moved": float(moved),
        "time": spent / len(errors),
    }  # fmt: skip


class Comparison:
    """Turns by engine, preset and controller; probes by engine and object."""

    def __init__(
        self,
        turns: dict[tuple[str, str, str], list[TrialRecord]],
        probes: dict[tuple[str, str], list[dict[str, float]]],
    ) -> None:
        self.turns, self.probes = turns, probes

    @property
    def verdict(self) -> str:
        """The last line."""
        found = {engine: self.turns.get((engine, "nominal", "E-KM"), []) for engine in ENGINES}
        return "; ".join(
            f"{engine} {_error(records):.3f} deg {turns.motions:.1f} motions lost {turns.lost}"
            for engine, records in found.items()
            if (turns := Turns(tuple(records))).records
        )

    def table(self) -> Table:
        rows: list[list[Cell]] = []
        for (engine, preset, controller), records in self.turns.items():
            turns = Turns(tuple(records))
            rows.append(
                [
                    f"{preset}, {controller}", ENGINES[engine], len(records), turns.lost, turns.reached,
                    turns.motions, _error(records), self._one_step(records),
                ]
            )  # fmt: skip
        rows.sort(key=lambda row: str(row[0]))
        columns = [
            "preset, controller", "engine", "turns", "lost", "reached", Column("motions", ".1f"),
            Column("error [deg]", ".3f"), "one step: KM, E-KM [deg]",
        ]  # fmt: skip
        note = (
            "Motions and errors at the end are means of the turns that reached the target; one step ahead,"
            " those of all motions, against what really happened. Camera images and Hall counts."
        )
        return Table("engines", "The same turns in two engines", columns, rows, note)

    def _one_step(self, records: Sequence[TrialRecord]) -> str:
        km = [error for one in records for error in one.true_prediction_km_deg]
        ekm = [error for one in records for error in one.true_prediction_ekm_deg]
        return f"{np.mean(km):.2f}, " + (f"{np.mean(ekm):.2f}" if ekm else "-")

    def probe_table(self) -> Table:
        rows: list[list[Cell]] = []
        for (engine, item), found in self.probes.items():
            if not found:
                continue
            middle = {key: float(np.median([one[key] for one in found])) for key in found[0]}
            rows.append(
                [
                    item.replace("_", " "), ENGINES[engine], len(found), middle["error"], middle["shift"],
                    f"{middle['creep']:.3f}, {middle['moved']:.3f}", middle["time"],
                ]
            )  # fmt: skip
        rows.sort(key=lambda row: str(row[0]))
        columns = [
            "object", "engine", "grasps", Column("step [deg]", ".3f"), Column("step [mm]", ".3f"),
            f"creep in {_REST:.0f} s [deg, mm]", Column("time of a command [s]", ".3f"),
        ]  # fmt: skip
        note = (
            "Medians over grasps. Error of the kinematic model, with all figures of the hand, in a step of"
            f" {_STEP / _DEG:g} deg, mean of up to {_STEPS}, until a contact may slide or a link touches;"
            " drift of an object without commands; processor time of a command."
        )
        return Table("probes", "The kinematic model with nothing unknown, and creep", columns, rows, note)

    def picture(self) -> Figure:
        """Errors of a step of the model, and motions of the turns."""
        figure, (steps, motions) = new_figure(9.0, 3.2, 2, 1)
        items = sorted({item for _, item in self.probes})
        for k, engine in enumerate(ENGINES):
            for i, item in enumerate(items):
                errors = [one["error"] for one in self.probes.get((engine, item), [])]
                at = i + 0.16 * (2 * k - 1)
                steps.plot([at] * len(errors), errors, "o", ms=4, color=_COLOURS[engine], alpha=0.6)
            counted = sorted(
                one.steps for one in self.turns.get((engine, "nominal", "E-KM"), []) if not one.lost
            )
            share = np.arange(1, len(counted) + 1) / max(len(counted), 1)
            motions.step(counted, 100 * share, where="post", color=_COLOURS[engine], label=ENGINES[engine])
        steps.set_xticks(range(len(items)), [item.replace("_", "\n") for item in items], fontsize=8)
        steps.set_ylabel("error of a step [deg]")
        steps.set_ylim(0, None)
        steps.set_title("KM with nothing unknown", fontsize=9)
        motions.set_xlabel("motions of a turn, E-KM, nominal")
        motions.set_ylabel("share of turns [%]")
        motions.legend(frameon=False, fontsize=8)
        return figure

    def report(self, folder: Path) -> Report:
        """Tables, picture and verdict, in ``folder``."""
        caption = "Left: each point is a grasp. Right: turns of Table I."
        shown = save_figure(self.picture(), folder, "engines", caption)
        report = Report("Two engines", f"{self.verdict}.", [self.table(), self.probe_table()], [shown])
        report.write(folder)
        return report


def _error(records: Sequence[TrialRecord]) -> float:
    """Mean error at the end of the turns that reached the target [deg]."""
    errors = [abs(one.true_error_deg) for one in records if not (one.lost or one.not_reached)]
    return float(np.mean(errors)) if errors else float("nan")


def main() -> None:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--objects", default=",".join(TABLE_I), help="names or paths")
    parser.add_argument("--seeds", type=parse_seeds, default=parse_seeds("1000:1010"), help="FIRST:END")
    parser.add_argument("--presets", default="nominal,worn")
    parser.add_argument("--controllers", default="E-KM", help="of KM, KM+I, KM+S, E-KM")
    parser.add_argument("--jobs", type=int, default=2, help="processes at once")
    parser.add_argument("--out", type=Path, default=Path("engines_output"), help="keeps what is finished")
    parser.add_argument("--quick", action="store_true", help="one object, one seed, one preset")
    given = parser.parse_args()
    objects, seeds, presets = given.objects.split(","), given.seeds, given.presets.split(",")
    if given.quick:
        objects, seeds, presets = objects[:1], seeds[:1], presets[:1]
    todo, where = {}, {}
    for seed in seeds:
        for preset in presets:
            for item in objects:
                for controller in given.controllers.split(","):
                    for engine in ENGINES:
                        setting = Setting(preset=preset, engine=engine, sensing=True)
                        mark = digest(setting, (item,), TABLE_I.get(item), _WARM_UP)
                        key = f"{engine}_{preset}_{object_name(item)}_{controller}_{mark}_{seed}"
                        todo[key] = (setting, item, controller, seed)
                        where[key] = (engine, preset, controller)
    with progress("turning", len(todo)) as advance:
        results = run_jobs(session, todo, given.out, given.jobs, advance)
    turns = records_by(where, results)
    probes: dict[tuple[str, str], list[dict[str, float]]] = {}
    with progress("probing", len(objects)) as advance:
        for item in objects:
            for engine in ENGINES:
                found = [probe(engine, item, seed) for seed in seeds]
                probes[engine, object_name(item)] = [one for one in found if one is not None]
            advance(item)
    comparison = Comparison(turns, probes)
    print(comparison.report(given.out).markdown())
    print(comparison.verdict)


if __name__ == "__main__":
    main()
