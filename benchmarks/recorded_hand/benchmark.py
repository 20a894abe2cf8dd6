"""How well a model from published figures foresees what a real hand did, with and without learners."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import joblib
import numpy as np

from torch_ekm.description import load_hand
from torch_ekm.exceptions import DescriptionError, UnknownNameError
from torch_ekm.experiments.learners import LEARNERS
from torch_ekm.typing import Array

from .fingers import FingerMarkers, identify_markers
from .learning import adapting_predictions, learned_predictions
from .nominal import (
    NOMINALS,
    Samples,
    jacobians,
    predictions,
    take_samples,
    through_play,
)
from .recordings import APART, RecordedPath, known_diameter, read_recordings
from .report import Row, score
from .states import States, estimate_states
from .synthetic import write_synthetic

HAND = "yale_t42"
HORIZONS = (10, 50)
"""[steps of 0.1 s] at which learners are scored, too."""
LEARNER = "SOGP mixture"
_LEARNED = [nominal for nominal in NOMINALS if nominal.kind in ("none", "online")]

Predicted = dict[str, Array]


@dataclass(frozen=True)
class RecordedHandResult:
    """What was predicted, and how well."""

    paths: dict[str, list[RecordedPath]]
    states: dict[str, States]
    samples: dict[int, dict[str, Samples]]
    """Of each horizon and object, the one set apart included."""
    predicted: dict[tuple[str, int], Predicted]
    """By name of the predictor and horizon; "NAME + LEARNER" where there is a learner."""
    rows: list[Row]
    markers: FingerMarkers

    @property
    def reported(self) -> list[str]:
        """Objects on which nothing was identified."""
        return [name for name in self.paths if name != APART]


def predict_recorded_hand(
    data: str | Path | None = None,
    *,
    learners: Sequence[str] = (LEARNER,),
    processes: int = 1,
    quick: bool = False,
) -> RecordedHandResult:
    """Predict the recorded motions of the Yale T42, ten and fifty steps ahead, with every nominal model.

    Everything is causal: camera, sizes of objects and states come from frames up to the moment of prediction,
    and learners see a motion when it is over. Markers are identified on one recording set apart, which is not
    scored.

    Args:
        data: ``t42_testpaths.npz`` or the folder that holds it, read in place. None: a small synthetic one,
            made by the model itself: it shows that everything runs, and says nothing of a real hand.
        learners: names of learners, each kept over all objects in alphabetical order.
        processes: how many at once.
        quick: two paths of each of four objects, forty samples for the learners.

    Raises:
        DescriptionError: the file is missing, or the recording set apart is not in it.
        UnknownNameError: no such learner; the message lists them.
    """
    for name in learners:
        if name not in LEARNERS:
            raise UnknownNameError("learner", name, LEARNERS)
    with TemporaryDirectory() as temporary:
        paths = read_recordings(write_synthetic(temporary) if data is None else data)
    if APART not in paths:
        raise DescriptionError(data or "", f"'{APART}', on which figures are identified, is not in it")
    if quick:
        few = sorted({APART, *[name for name in paths if name != APART][:3]})
        paths = {name: paths[name][:2] for name in few}
    hand, apart, diameter = load_hand(HAND), paths[APART], known_diameter(APART)
    assert diameter is not None  # its name states it
    seen, pose = (np.concatenate([getattr(path, part) for path in apart]) for part in ("markers", "pose"))
    markers = identify_markers(hand, seen, pose, diameter)
    each = {name: (name, own, markers, hand) for name, own in paths.items()}
    states: dict[str, States] = _at_once(processes, estimate_states, each)
    published = {name: jacobians(hand, own) for name, own in states.items()}
    moved = {name: through_play(own, hand) for name, own in paths.items()}
    samples = {
        horizon: {name: take_samples(own, states[name], moved[name], horizon) for name, own in paths.items()}
        for horizon in HORIZONS
    }
    predicted = {
        (nominal.name, horizon): predictions(nominal, taken, published, APART)
        for horizon, taken in samples.items()
        for nominal in NOMINALS
        if nominal.kind != "online"
    }
    order = sorted(name for name in states if name != APART)
    (online,) = (nominal.name for nominal in NOMINALS if nominal.kind == "online")
    adapting = states, published, [APART, *order]
    jobs: dict[Any, Any] = {(online, horizon): (hand, samples[horizon], *adapting) for horizon in HORIZONS}
    predicted |= _at_once(processes, adapting_predictions, jobs)
    limit = 40 if quick else None
    jobs = {
        (f"{nominal.name} + {learner}", horizon): (
            learner, nominal, samples[horizon], states, predicted[nominal.name, horizon], order, APART, limit
        )
        for horizon, nominal, learner in itertools.product(HORIZONS, _LEARNED, learners)
    }  # fmt: skip
    predicted |= _at_once(processes, learned_predictions, jobs)
    rows = []
    for (name, horizon), own in predicted.items():
        taken = {key: samples[horizon][key] for key in order}
        unit = samples[horizon][APART].motion.std(axis=0)
        rows.append(score(name, horizon, taken, own, unit))
    return RecordedHandResult(paths, states, samples, predicted, rows, markers)


def _at_once(
    processes: int, function: Callable[..., Any], jobs: Mapping[Any, tuple[Any, ...]]
) -> dict[Any, Any]:
    """``{key: function(*arguments)}``."""
    run = joblib.Parallel(processes)
    return dict(zip(jobs, run(joblib.delayed(function)(*given) for given in jobs.values()), strict=True))
