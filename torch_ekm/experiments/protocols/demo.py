"""The main job: a grasped object turned through the paper's angles, with the KM and with the E-KM."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from ...description import load_hand, load_object
from ...rendering import make_scene, save_animation, save_picture
from ..records import Record, TrialRecord
from ..reporting.plots import plot_convergence, plot_prediction_error, save_figure
from ..reporting.report import Cell, Column, FigureFile, Report, Table
from ..reporting.statistics import Array, select, steady_state_error
from .generalize import Generalize
from .protocol import Results, records_of


@dataclass(frozen=True)
class Demo(Generalize):
    """One object of :class:`Generalize` with the KM and with an E-KM that starts empty, without the probes
    and with pictures.

    Raises:
        UnknownNameError: no such object; the message lists them.
        DescriptionError: its files are missing or wrong.
        ParameterError: an angle that is no rotation.
    """

    objects: tuple[str, ...] = ("box",)
    warm_up: int = 0
    long_step_deg: float = 0.0
    blind_deg: float = 0.0
    controllers: tuple[str, ...] = ("KM", "E-KM")
    poses: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        load_object(self.object)

    @property
    def object(self) -> str:
        """The one that is turned."""
        return self.objects[0]

    def quick(self) -> Self:
        """The first two angles."""
        return dataclasses.replace(self, angles_deg=self.angles_of(self.object)[:2])

    def report(self, seeds: Sequence[int], results: Results[Record], folder: Path) -> Report:
        """That of the turns, each target on its own, the motions, and pictures."""
        report, records = super().report(seeds, results, folder), select(records_of(results))
        what, hand = _spoken(self.object), _spoken(self.setting.hand)
        report.title = f"Turning the {what} with the hand {hand}: KM and E-KM"
        shown = ("stop_reasons", "controllers", "motions", "comparison", "prediction", "timing")
        report.tables = [self.angle_table(records)] + [t for t in report.tables if t.name in shown]
        report.leading = 1
        report.figures = [*self._pictures(records, folder), *self._motions(records, folder), *report.figures]
        return report

    def angle_table(self, records: Sequence[TrialRecord]) -> Table:
        """Each target on its own."""
        columns: list[Column | str] = [Column("target [deg]", "g")]
        for name in self.controllers:
            columns += [f"{name}: error [deg]", Column(f"{name}: motions", ".1f"), f"{name}: lost"]
        rows: list[list[Cell]] = []
        for angle in self.angles_of(self.object):
            row: list[Cell] = [float(angle)]
            for name in self.controllers:
                mine = select(records, controller=name, angle_deg=angle)
                figures = np.array([(steady_state_error(r), r.steps, r.lost) for r in mine])
                row += [*map(float, figures.mean(0)[:2]), int(figures[:, 2].sum())] if mine else [None] * 3
            rows.append(row)
        caption = "Mean steady-state error, motions and lost objects for each target"
        return Table("by_angle", caption, columns, rows)

    def _motions(self, records: Sequence[TrialRecord], folder: Path) -> list[FigureFile]:
        """How the prediction improves with each motion, and how the error falls in the longest turn."""
        mine = select(records, controller="E-KM")
        runs = [select(mine, seed=seed) for seed in sorted({r.seed for r in mine})]
        ekm, km = (
            [_running_mean(np.concatenate([getattr(r, name) for r in run])) for run in runs]
            for name in ("prediction_ekm_deg", "prediction_km_deg")
        )
        shortest, figures = min(map(len, ekm), default=0), []
        if shortest >= 5:
            over = f"median and quartiles over {len(runs)} seeds" if len(runs) > 1 else "one seed"
            caption = (
                f"One-step prediction error of KM and E-KM on the E-KM's first {shortest} motions, running "
                f"mean over 5 motions, {over}; the learner starts empty at motion 1 (the paper's Fig. 5a)."
            )
            curves = (np.stack([curve[:shortest] for curve in found]) for found in (ekm, km))
            figure = plot_prediction_error(*curves, xlabel="motion")
            figures.append(save_figure(figure, folder, "prediction_error", caption))
        last = self.angles_of(self.object)[-1]
        histories = {
            name: [np.array(r.errors_deg) for r in select(records, controller=name, angle_deg=last)]
            for name in self.controllers
        }
        figure = plot_convergence(histories, f"{last:g} deg")
        caption = f"Measured error on the way to {last:g} deg: a line for each grasp."
        return [*figures, save_figure(figure, folder, "convergence", caption)]

    def _pictures(self, records: Sequence[TrialRecord], folder: Path) -> list[FigureFile]:
        """The E-KM's best long turn: before and after, and as an animation."""
        turns = [r for r in select(records, controller="E-KM") if r.poses and not r.lost]
        if not turns:
            return []
        turn = max(turns, key=lambda r: (r.reason == "reached", r.angle_deg, -r.true_error_deg))
        q, position, rotation = (np.array(part) for part in zip(*turn.poses, strict=True))
        hand, obj = load_hand(self.setting.hand), load_object(self.object)
        scene = make_scene(hand, obj, q, position, rotation, np.array(hand.gravity))
        save_picture(scene, folder / "hand.png", frames=(0, -1))
        save_animation(scene, folder / "animation.html")
        what = f"a turn of {turn.angle_deg:g} deg (seed {turn.seed})"
        return [
            FigureFile(
                "hand.png",
                f"The {_spoken(self.object)} before and after {what} by the E-KM, seen along the axis.",
            ),
            FigureFile("animation.html", "The same turn, motion by motion: drag to look around."),
        ]


def _spoken(name: str) -> str:
    """A name, or the stem of a path, as words."""
    return Path(name).stem.replace("_", " ")


def _running_mean(values: Array, window: int = 5) -> Array:
    """Mean over the last ``window`` values (fewer at the start)."""
    total = np.cumsum(np.insert(values, 0, 0.0))
    end = np.arange(1, len(values) + 1)
    start = np.maximum(end - window, 0)
    return (total[end] - total[start]) / (end - start)
