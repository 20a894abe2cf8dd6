"""What a notebook shows: the hand as a picture, comparisons of learners as tables and figures."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from .experiments.learner_comparison.plots import plot_learning_curves, plot_scores
from .experiments.learner_comparison.recordings import load_recording
from .experiments.learner_comparison.report import curve_learners, overview_table, score_table
from .experiments.learner_comparison.stream import Stream, load_table
from .experiments.reporting.report import Table
from .rendering import Scene, save_picture

if TYPE_CHECKING:
    from IPython.display import Image

__all__ = [
    "Stream",
    "Table",
    "curve_learners",
    "hand_picture",
    "load_recording",
    "load_table",
    "overview_table",
    "plot_learning_curves",
    "plot_scores",
    "score_table",
]


def hand_picture(scene: Scene, frames: tuple[int, ...] = (0,)) -> Image:
    """A scene as the last line of a cell: these frames of it side by side.

    Raises:
        MissingExtraError: pyvista or trimesh is not installed.
        EKMError: this machine cannot draw.
    """
    from IPython.display import Image

    with tempfile.TemporaryDirectory() as folder:
        return Image(save_picture(scene, Path(folder) / "hand.png", frames=frames).read_bytes())
