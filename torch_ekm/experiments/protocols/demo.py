"""The main job: a grasped object turned through the paper's angles, then objects that are new to the hand."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from ...control import StopReason
from ...description import load_hand, load_object
from ...exceptions import EKMError
from ...rendering import Captions, make_scene, save_animation, save_picture
from ..config import digest
from ..records import TrialRecord
from ..reporting.plots import plot_prediction_error, save_figure
from ..reporting.report import FigureFile, Report, Table
from ..reporting.statistics import DataFrame, select
from ..reporting.tables import error_table, pivot
from ..runner import Bench, new_objects
from .generalize import Generalize

#: Turns of each new object [deg].
_NEW_ANGLES = (9.0, 19.0)


@dataclass(frozen=True)
class Demo(Generalize):
    """One object of :class:`Generalize` with the KM and with an E-KM that starts empty, and with pictures.

    Then, on the first seed, objects that the hand has never held; what it learned with the first one stays.
    """

    objects: tuple[str, ...] = ("box",)
    warm_up: int = 0
    controllers: tuple[str, ...] = ("KM", "E-KM")
    poses: bool = True
    new: tuple[str, ...] = ("can", "bottle", "weighted_box", "applier")

    @property
    def object(self) -> str:
        """Name or path of the one that is turned."""
        return self.objects[0]

    def quick(self) -> Self:
        """The same with the first two angles only, and without new objects."""
        return dataclasses.replace(self, angles_deg=self.angles_of(self.object)[:2], new=())

    def jobs(self, seeds: Sequence[int]) -> dict[str, tuple[Any, ...]]:
        """Those of the object, and for each controller one with the new objects."""
        alone = dataclasses.replace(self, new=())
        items = self.object, *(item for item in self.new if item != self.object)
        own = digest(self.setting, items, "new objects", _NEW_ANGLES)
        new = {f"new_{own}_{name}_{seeds[0]}": (items, name, seeds[0]) for name in self.controllers}
        return super(Demo, alone).jobs(seeds) | (new if self.new else {})

    def session(self, object: str | tuple[str, ...], controller: str, seed: int) -> list[TrialRecord]:
        """Turns of one object; of several, those of objects that are new to the hand."""
        if isinstance(object, str):
            return super().session(object, controller, seed)
        setting = self.setting.hardware_instance(seed)
        return new_objects(
            lambda item: Bench(setting, item, controller), object, seed, angles=_NEW_ANGLES, kind="new"
        )

    def report(self, seeds: Sequence[int], trials: DataFrame, folder: Path) -> Report:
        """Report the turns, each target on its own, the motions, and pictures."""
        report, turns = super().report(seeds, trials, folder), select(trials, kind="turn")
        what, hand = _spoken(self.object), _spoken(self.setting.hand)
        report.title = f"Turning the {what} with the hand {hand}: KM and E-KM"
        shown = ("by_reason", "controllers")
        leading = [error_table(turns, "angle_deg"), *([new_table(trials)] if self.new else [])]
        report.tables = leading + [table for table in report.tables if table.name in shown]
        report.leading = len(leading)
        report.figures = [*self._pictures(turns, folder), *self._motions(turns, folder), *report.figures]
        return report

    def _motions(self, turns: DataFrame, folder: Path) -> list[FigureFile]:
        """How the prediction improves with each motion."""
        names, figures = ["prediction_ekm_deg", "prediction_km_deg"], []
        motions = select(turns, controller="E-KM").dropna(subset="prediction_ekm").explode(names)
        motions["motion"] = motions.groupby("seed").cumcount() + 1
        runs = (motions.pivot(index="seed", columns="motion", values=name).astype(float) for name in names)
        curves = [run.dropna(axis=1).T.rolling(5, min_periods=1).mean().T for run in runs]
        n, shortest = curves[0].shape
        if shortest >= 5:
            over = f"median and quartiles over {n} seeds" if n > 1 else "one seed"
            caption = (
                f"One-step prediction error of KM and E-KM on the E-KM's first {shortest} motions, running "
                f"mean over 5 motions, {over}; the learner starts empty at motion 1 (the paper's Fig. 5a)."
            )
            figure = plot_prediction_error(*curves, xlabel="motion")
            figures.append(save_figure(figure, folder, "prediction_error", caption))
        return figures

    def _pictures(self, turns: DataFrame, folder: Path) -> list[FigureFile]:
        """The E-KM's best long turn: before and after, and as an animation."""
        mine = select(turns, controller="E-KM", lost=False)
        mine = mine[mine["poses"].map(len) > 0]
        if mine.empty:
            return []
        mine = mine.assign(reached=mine["reason"] == StopReason.REACHED.value)
        best = mine.sort_values(["reached", "angle_deg", "true_error_deg"], ascending=[False, False, True])
        turn = best.iloc[0]
        q, position, rotation = (np.array(part) for part in zip(*turn.poses, strict=True))
        hand, obj = load_hand(self.setting.hand).counted(), load_object(self.object)
        scene = make_scene(hand, obj, q, position, rotation, np.array(hand.gravity))
        what = f"{turn.angle_deg:g} deg (seed {turn.seed}) by the E-KM"
        left = np.array(turn.errors_deg)
        lines = tuple(f"motion {k}: {error:.2f} deg to go" for k, error in enumerate(left))
        captions = Captions(
            f"{hand.name} turns {obj.name}: E-KM", lines, turn.angle_deg - left, target=turn.angle_deg
        )
        save_animation(scene, folder / "animation.html", captions, seconds=0.5)
        moving = FigureFile("animation.html", f"A turn of {what}, motion by motion: drag to look around.")
        try:
            save_picture(scene, folder / "hand.png", frames=(0, -1))
        except EKMError:  # a machine that cannot draw; the animation needs a browser alone
            return [moving]
        caption = f"The {_spoken(self.object)} before and after a turn of {what}, seen along the axis."
        return [FigureFile("hand.png", caption), moving]


def new_table(trials: DataFrame) -> Table:
    """How each controller turns objects that the hand has never held; the E-KM has learned the hand."""

    def cell(turns: DataFrame) -> str:
        return f"{turns['error_deg'].mean():.2f}; {turns['motions'].mean():.1f}"

    what = "new to the hand, one seed; mean steady-state error [deg], and motions"
    return pivot(select(trials, kind="new"), "controller", "object", cell, what)


def _spoken(name: str) -> str:
    """A name, or the stem of a path, as words."""
    return Path(name).stem.replace("_", " ")
