"""What the sensing benchmark found: its tables and picture. See benchmarks/sensing.py."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from simulated_hand.lens import LENSES

from torch_ekm.experiments.protocols.generalize import TABLE_II
from torch_ekm.experiments.reporting.plots import COLOURS, new_figure, save_figure
from torch_ekm.experiments.reporting.report import Cell, Column, Report, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BLIND = 15.0  # [deg] there, and back
#: What is read in a turn -> lens (None: true poses), and whether joints are read by Hall sensors.
READINGS: dict[str, tuple[str | None, bool]] = {
    "all sensed": ("20 pictures", True),
    "true joint angles": ("20 pictures", False),
    "lens exact": ("exact", True),
    "lens not calibrated": ("not calibrated", True),
    "all true": (None, False),
}
#: What measures a blind turn.
BLIND_BY = {"camera on": None, "touch": True, "prediction alone": False}
_COLOURS = ("#CC79A7", "#0072B2", "#E69F00")  # no controllers: not the KM's grey


@dataclass(frozen=True)
class Turn:
    """One turn, and what its readings were worth; angles [deg]."""

    readings: str
    controller: str
    object: str
    seed: int
    angle: float
    lost: bool
    reached: bool
    motions: int
    error: float
    """True, at the end."""
    one_step: list[float]
    """Errors of the controller's predictions, by the truth."""
    one_step_km: list[float]
    """Those of the KM of the same motions."""
    motors: list[float]
    """What each motor did in each motion less what was asked of it."""
    joints: list[list[float]]
    """Measured less true angle of each joint, a row for each reading at rest."""
    rotation: list[float]
    """Measured less true rotation about the axis since the grasp."""
    position: list[float]
    """Distance of the measured from the true position [mm]."""


def rms(values: Iterable[float]) -> float:
    """Root of the mean square; NaN of none."""
    squares = np.square(np.fromiter(values, dtype=float))
    return float(np.sqrt(squares.mean())) if squares.size else math.nan


class Outcome:
    """What all jobs left.

    Args:
        hall: of each channel of each hand.
        lenses: of each hand.
        turns: all.
        blind: series of motions without the camera.
        joints: names of the hand's.
    """

    def __init__(
        self,
        hall: Sequence[dict[str, Any]],
        lenses: Sequence[dict[str, Any]],
        turns: Sequence[Turn],
        blind: Sequence[dict[str, Any]],
        joints: Sequence[str],
    ) -> None:
        self.hall, self.lenses, self.turns, self.blind, self.joints = hall, lenses, turns, blind, joints

    def of(self, controller: str, readings: str = "all sensed", item: str | None = None) -> list[Turn]:
        """Turns of a controller with some readings, of an object or of all."""
        kind = controller, readings
        found = [turn for turn in self.turns if (turn.controller, turn.readings) == kind]
        return [turn for turn in found if item in (None, turn.object)]

    def joint(self, names: Iterable[str]) -> float:
        """rms error of joints in the turns with everything sensed [deg]."""
        at = [self.joints.index(name) for name in names]
        rows = (row for turn in self.of("E-KM") for row in turn.joints)
        return rms(row[k] for row in rows for k in at)

    def lens(self, name: str, figure: str) -> float:
        """rms over the lenses."""
        return rms(lens["known"][name][figure] for lens in self.lenses)

    def dark(self, by: str, motion: int, figure: str) -> float:
        """rms over the series that come to a motion (from 1) of "error" or "sd" [deg]."""
        rows = [one["motions"] for one in self.blind if one["by"] == by]
        found = [row[motion - 1][figure] for row in rows if len(row) >= motion]
        return rms(value for value in found if value is not None)

    def first(self, by: str) -> list[float]:
        """True errors at the end of the first turn of each series [deg]."""
        return [one["turns"][0]["error"] for one in self.blind if one["by"] == by]

    @property
    def motors(self) -> dict[str, list[float]]:
        """Errors of the motors with the position controller alone, and with a servo inverse [deg]."""
        named = {"position controller alone": "KM", "with the servo inverse": "E-KM"}
        return {name: [e for t in self.of(who) for e in t.motors] for name, who in named.items()}

    @property
    def verdict(self) -> str:
        """The last line."""
        wrong, calibrated = (self.lens(name, "depth") for name in ("not calibrated", "20 pictures"))
        alone = rms(self.motors["position controller alone"])
        steps = [_mean(e for t in self.of("E-KM", name) for e in t.one_step) for name in list(READINGS)[:2]]
        dark = float(np.median(self.first("touch") or [math.nan]))
        most = max((len(one["motions"]) for one in self.blind if one["by"] == "touch"), default=0)
        return (
            f"Hall fit {rms(row['rms'] for row in self.hall):.2f} deg; depth {wrong:.1f} mm, calibrated "
            f"{calibrated:.2f} mm; motors {alone:.2f} deg; prediction of one motion {steps[0]:.2f} deg, with "
            f"true joint angles {steps[1]:.2f} deg; a turn without the camera {dark:.2f} deg, after {most} "
            f"motions {self.dark('touch', most, 'error') if most else math.nan:.1f} deg"
        )

    def paper_table(self) -> Table:
        """What the paper states, and the same here."""
        sensed = list(dict.fromkeys(row["joint"] for row in self.hall))
        others = [name for name in self.joints if name not in sensed]
        worst = max((row["largest"] for row in self.hall), default=math.nan)
        ekm, km = self.of("E-KM"), self.of("KM")
        alone = np.abs(self.motors["position controller alone"])
        steps = [_mean(e for t in ekm for e in getattr(t, name)) for name in ("one_step_km", "one_step")]
        items = [item for item in TABLE_II if self.of("E-KM", item=item)]
        stated = [f"{item} {TABLE_II[item][0]}, {TABLE_II[item][1]}" for item in items]
        errors = {item: [_error(self.of(who, item=item)) for who in ("KM", "E-KM")] for item in items}
        here = [f"{item} {first:.1f}, {second:.1f}" for item, (first, second) in errors.items()]
        blind, unstated = self.first("touch"), "not stated"
        rows: list[list[Cell]] = [
            ["Hall fit over a sweep: rms, largest", "cubic; not stated",
             f"{rms(row['rms'] for row in self.hall):.2f}, {worst:.1f} deg"],
            ["joints in turns: with, without Hall sensor", unstated,
             f"{self.joint(sensed):.2f}, {self.joint(others):.2f} deg"],
            ["depth of a board, lens not calibrated", unstated,
             f"{self.lens('not calibrated', 'depth'):.1f} mm"],
            ["depth of a board, lens calibrated", '"reduced"',
             f"{self.lens('20 pictures', 'depth'):.2f} mm"],
            ["position controller: rms, within 1 deg", "±1 deg",
             f"{rms(alone):.2f} deg, {100 * float((alone <= 1).mean()) if len(alone) else math.nan:.0f} %"],
            ["one motion's prediction: KM, E-KM", "E-KM at least 0.57 deg better",
             f"{steps[0]:.2f}, {steps[1]:.2f} deg"],
            ["end of a turn: KM, E-KM", f"{'; '.join(stated)} deg",
             f"{'; '.join(here)} deg" if km else f"E-KM {_error(ekm):.2f} deg"],
            [f"a blind turn of {BLIND:g} deg: median, largest", "not tried",
             f"{np.median(blind or [math.nan]):.2f}, {max(blind, default=math.nan):.2f} deg"],
        ]  # fmt: skip
        middle = float(np.median([turn.error for turn in ekm if not turn.lost] or [math.nan]))
        note = (
            "Depth: rms, 0.35 to 0.45 m from the camera. One motion: mean, here on the E-KM's motions. End "
            "of a turn: mean; here of turns of 9, 19 and 27 deg, not of Table I's; the largest of the E-KM's "
            f"is {max((turn.error for turn in ekm if not turn.lost), default=math.nan):.1f}, their median "
            f"{middle:.2f} deg."
        )
        return Table(
            "paper", "The paper's sensing, and the same here", ["figure", "paper", "here"], rows, note
        )

    def turn_table(self) -> Table:
        """What each reading is worth."""
        rows: list[list[Cell]] = []
        for who, readings in [*(("E-KM", name) for name in READINGS), ("KM", "all sensed")]:
            if turns := self.of(who, readings):
                held = [turn for turn in turns if not turn.lost]
                count = f"{sum(turn.reached for turn in turns)} of {len(turns)}", sum(t.lost for t in turns)
                motions = _mean(turn.motions for turn in turns if turn.reached)
                figures = (
                    _mean(e for turn in held for e in turn.one_step),
                    rms(e for turn in held for row in turn.joints for e in row),
                    rms(e for turn in held for e in turn.rotation),
                )
                rows.append([f"{who}, {readings}", *count, motions, _error(turns), *figures])
        columns: list[str | Column] = [
            "readings", "reached", "lost", Column("motions", ".1f"), "error [deg]", "one motion [deg]",
            "joints [deg]", Column("rotation [deg]", ".3f"),
        ]  # fmt: skip
        note = (
            "Means: motions of turns that reached the target, true error of objects that were not lost, "
            "error of the prediction of one motion by the truth. Root mean squares: joint angles, measured "
            "rotation since the grasp. All sensed: lens from 20 pictures, Hall sensors, fingertips."
        )
        return Table("turns", "Effect of the readings on turns", columns, rows, note)

    def hall_table(self) -> Table:
        """A row for each joint."""
        rows: list[list[Cell]] = []
        for name in self.joints:
            mine = [row for row in self.hall if row["joint"] == name]
            largest = max((row["largest"] for row in mine), default=math.nan)
            stated, misfit = (rms(row[key] for row in mine) for key in ("stated", "misfit"))
            blind = float(np.mean([row["blind"] for row in mine])) if mine else math.nan
            rows.append(
                [name, rms(row["rms"] for row in mine), largest, stated, misfit, blind, self.joint([name])]
            )
        columns: list[str | Column] = [
            "joint", "fit, rms [deg]", "largest [deg]", "stated sd [deg]", "misfit [deg]",
            Column("no reading [%]", ".0f", percent=True), "in turns, rms [deg]",
        ]  # fmt: skip
        note = (
            "Over a second sweep of the whole range, where the channel is not saturated; no reading: share "
            "of the range where it is. Misfit: what a cubic misses; the rest is noise, rounding. A count is "
            f"about {90 / 255:.2f} deg. In turns: after encoders, couplings and contacts are joined."
        )
        return Table("hall", "Hall fit of each joint", columns, rows, note)

    def lens_table(self) -> Table:
        """What a calibration leaves."""
        figures = {
            Column("focal length [%]"): "focal", Column("axis [px]"): "axis", Column("depth [mm]"): "depth",
            Column("object, position [mm]"): "position", Column("object, rotation [deg]"): "rotation",
        }  # fmt: skip
        columns = {
            column: partial(lambda figure, name: self.lens(name, figure), key)
            for column, key in figures.items()
        }
        left = rms(lens["reprojection"] for lens in self.lenses)
        note = (
            f"rms over {len(self.lenses)} lenses: what is wrong in focal length and axis, and the poses of "
            "boards in random poses: depth from the camera, object in the palm's frame. Calibrated from "
            f"pictures of a ChArUco board, {left:.2f} px reprojection; print and sheet have no errors."
        )
        return Table.of(
            "lenses", "Camera calibration", "lens", {name: name for name in LENSES}, columns, note
        )

    def motor_table(self) -> Table:
        """The position controller's errors."""
        items = {name: np.abs(errors) for name, errors in self.motors.items() if errors}
        columns: dict[Column, Callable[[Any], Cell]] = {
            Column("motor motions"): lambda e: len(e),
            Column("rms [deg]"): rms,
            Column("95 % below [deg]"): lambda e: float(np.quantile(e, 0.95)),
            Column("largest [deg]"): lambda e: float(e.max()),
            Column("within 1 deg [%]", ".0f", percent=True): lambda e: float((e <= 1).mean()),
        }
        note = "Encoder's change minus the planned one, of each motor in each motion that moves it."
        return Table.of("motors", "Position controller", "controller", items, columns, note)

    def blind_table(self) -> Table:
        """Turns without the camera, from its first picture on."""
        rows: list[list[Cell]] = []
        for by in BLIND_BY:
            for name, later in (("first turn", False), ("later turns", True)):
                series = [one["turns"] for one in self.blind if one["by"] == by]
                turns = [turn for one in series for turn in (one[1:] if later else one[:1])]
                if turns:
                    errors = [turn["error"] for turn in turns if not turn["lost"]] or [math.nan]
                    ended = sum(turn["reason"] == "reached" for turn in turns), sum(t["lost"] for t in turns)
                    figures = float(np.median(errors)), max(errors)
                    rows.append([f"{by}, {name}", len(turns), *ended, *figures])
        columns = ["measured by", "turns", "reached", "lost", "median error [deg]", "largest [deg]"]
        note = (
            f"Turns of {BLIND:g} deg there and back in one grasp, the camera off since its start. Reached: "
            "by the estimate. Touch: joints and fingertips correct the prediction. True error about the axis "
            "at the end, of objects in the hand."
        )
        return Table("blind", "Whole turns without the camera", columns, rows, note)

    def time_table(self) -> Table:
        """Error of the estimate over the motions since the last picture."""
        rows: list[list[Cell]] = []
        for motion in (1, 5, 10, 20, 30, 40):
            blind = [one["motions"] for one in self.blind if one["by"] == "touch"]
            there = [motions for motions in blind if len(motions) >= motion]
            if there:
                pairs = [self.dark(by, motion, key) for by in BLIND_BY for key in ("error", "sd")]
                seconds = float(np.mean([row[motion - 1]["s"] for row in there]))
                rows.append([motion, seconds, len(there), pairs[0], *pairs[2:]])
        columns: list[str | Column] = [
            "motions", Column("time [s]", ".1f"), "series", "camera on [deg]", "touch [deg]",
            "stated sd, touch [deg]", "prediction alone [deg]", "stated sd, alone [deg]",
        ]  # fmt: skip
        note = (
            "rms error of the estimated rotation about the axis, with the standard deviation stated for it."
        )
        return Table("time", "Error against time without the camera", columns, rows, note)

    def picture(self) -> Figure:
        """Depth before and after calibration, motors, and error without the camera."""
        figure, (depth, motors, dark) = new_figure(10.0, 3.3, 3)
        for k, name in enumerate(LENSES):
            values = [lens["known"][name]["depth"] for lens in self.lenses]
            depth.plot([k] * len(values), values, "o", ms=5, alpha=0.7, color=COLOURS["E-KM"])
        depth.set_xticks(range(len(LENSES)), [name.replace(" ", "\n") for name in LENSES], fontsize=8)
        depth.set(yscale="log", ylabel="depth, rms [mm]", xlabel="lens", xlim=(-0.5, len(LENSES) - 0.5))
        for (name, errors), colour in zip(self.motors.items(), _COLOURS, strict=False):
            if errors:
                motors.ecdf(np.abs(errors), color=colour, label=name)
        motors.axvline(1.0, color=COLOURS["limit"], linestyle="--", label="the paper's ±1 deg")
        motors.set(xlabel="error of a motor [deg]", ylabel="share of the motions", xlim=(0, 2))
        motors.legend(loc="lower right", frameon=False, fontsize=7)
        for name, colour in zip(BLIND_BY, _COLOURS, strict=True):
            most = max((len(one["motions"]) for one in self.blind if one["by"] == name), default=0)
            numbers = range(1, most + 1)
            dark.plot(numbers, [self.dark(name, n, "error") for n in numbers], color=colour, label=name)
            stated = [self.dark(name, n, "sd") for n in numbers]
            dark.plot(numbers, stated, "--", lw=1, color=colour)
        dark.set(xlabel="motions, camera off (dashed: stated)", ylabel="rotation, rms [deg]")
        dark.legend(frameon=False, fontsize=7)
        return figure

    def report(self, folder: Path) -> Report:
        """All of it, in ``folder``."""
        caption = (
            "Left: depth error of a board by calibration of the lens, a dot for each lens. Middle: errors "
            "of the motors. Right: error of the estimated rotation without the camera."
        )
        shown = save_figure(self.picture(), folder, "sensing", caption)
        parts = (
            self.turn_table(),
            self.lens_table(),
            self.motor_table(),
            self.blind_table(),
            self.time_table(),
        )
        made = [table for table in (self.paper_table(), *parts, self.hall_table()) if table.rows]
        report = Report("The paper's sensing, in simulation", f"{self.verdict}.", made, [shown])
        report.write(folder)
        return report


def _mean(values: Iterable[float]) -> float:
    """NaN of none."""
    found = list(values)
    return float(np.mean(found)) if found else math.nan


def _error(turns: Iterable[Turn]) -> float:
    """Mean true error of objects that were not lost [deg]."""
    return _mean(turn.error for turn in turns if not turn.lost)
