"""How well a model from published figures foresees what a real hand did, with and without learners."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import torch_ekm
from torch_ekm.description import HandDescription, load_hand
from torch_ekm.exceptions import DescriptionError, UnknownNameError
from torch_ekm.experiments.jobs import run_jobs
from torch_ekm.experiments.learners import LEARNERS
from torch_ekm.typing import Array

from .adapting import adapting_predictions
from .finger_markers import FingerMarkers
from .fingers import identify_markers
from .learning import learned_predictions
from .nominal import (
    NOMINALS,
    Nominal,
    Samples,
    calibrate_hand,
    jacobians,
    predictions,
    take_samples,
    through_play,
)
from .recordings import APART, RecordedPath, known_diameter, read_recordings
from .scores import SUBSETS, Row, score
from .states import States, estimate_states
from .synthetic import OBJECTS, write_synthetic

HAND = "yale_t42"
HORIZONS = (10, 50)
"""[steps of 0.1 s] at which learners are scored, too."""
LEARNER = "SOGP mixture"
_LEARNED = [nominal for nominal in NOMINALS if nominal.kind in ("none", "calibrated", "online")]

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
    calibration: dict[str, Any]
    """Figures found on the recording set apart, and "text", its table."""
    quick: bool

    @property
    def reported(self) -> list[str]:
        """Objects on which nothing was identified."""
        return [name for name in self.paths if name != APART]

    def row(self, name: str, horizon: int, subset: str = "all") -> Row:
        """One row of the results.

        Raises:
            UnknownNameError: there is none of that name at this horizon; the message lists all.
        """
        own = {r.name: r for r in self.rows if (r.horizon, r.subset) == (horizon, subset)}
        if name not in own:
            raise UnknownNameError("prediction", name, own)
        return own[name]


def predict_recorded_hand(
    data: str | Path | None = None,
    *,
    learners: Sequence[str] = (LEARNER,),
    folder: str | Path | None = None,
    processes: int = 1,
    quick: bool = False,
    on_done: Callable[[str], None] | None = None,
) -> RecordedHandResult:
    """Predict the recorded motions of the Yale T42, ten and fifty steps ahead, with every nominal model.

    Everything is causal: camera, sizes of objects and states come from frames up to the moment of prediction,
    and learners see a motion when it is over. Markers and calibration are identified on one recording set
    apart, which is not scored.

    Args:
        data: ``t42_testpaths.npz`` or the folder that holds it, read in place. None: a small synthetic one,
            made by the model itself: it shows that everything runs, and says nothing of a real hand.
        learners: names of learners, each kept over all objects in alphabetical order.
        folder: keeps what is finished, so that an interrupted run goes on where it stopped.
        processes: how many at once.
        quick: two paths of each of four objects, forty samples for the learners.
        on_done: called with each finished job's name.

    Raises:
        DescriptionError: the file is missing, or the recording set apart is not in it.
        UnknownNameError: no such learner; the message lists them.
    """
    for name in learners:
        if name not in LEARNERS:
            raise UnknownNameError("learner", name, LEARNERS)
    with TemporaryDirectory() as temporary:
        paths = _chosen(data, temporary, quick)
        cache = Path(folder or temporary) / _digest(paths, quick)
        return _run(paths, tuple(learners), cache, processes, quick, on_done)


def _digest(paths: dict[str, list[RecordedPath]], quick: bool) -> str:
    """Ten letters that change with the recordings and the version of the package."""
    found = hashlib.sha256(f"{torch_ekm.__version__} {quick} {list(paths)}".encode())
    for path in itertools.chain.from_iterable(paths.values()):
        for values in vars(path).values():
            found.update(values.tobytes())
    return found.hexdigest()[:10]


def count_jobs(data: str | Path | None, learners: int, *, quick: bool = False) -> int:
    """How often ``on_done`` is called.

    Raises:
        DescriptionError: as :func:`predict_recorded_hand`.
    """
    paths = OBJECTS if data is None else _chosen(data, "", quick)
    return len(paths) + 1 + len(HORIZONS) + learners * len(_LEARNED) * len(HORIZONS)


def _chosen(data: str | Path | None, temporary: str, quick: bool) -> dict[str, list[RecordedPath]]:
    paths = read_recordings(write_synthetic(temporary) if data is None else data)
    if APART not in paths:
        raise DescriptionError(data or "", f"'{APART}', on which figures are identified, is not in it")
    if not quick:
        return paths
    few = sorted({APART, *[name for name in paths if name != APART][:3]})
    return {name: paths[name][:2] for name in few}


def _run(
    paths: dict[str, list[RecordedPath]],
    learners: tuple[str, ...],
    cache: Path,
    processes: int,
    quick: bool,
    on_done: Callable[[str], None] | None,
) -> RecordedHandResult:
    hand, apart = load_hand(HAND), paths[APART]
    diameter = known_diameter(APART)
    assert diameter is not None  # its name states it
    markers = identify_markers(
        hand,
        np.concatenate([path.markers for path in apart]),
        np.concatenate([path.pose for path in apart]),
        diameter,
    )
    jobs = {name: (name, own, markers, hand) for name, own in paths.items()}
    states = {
        name: States.of(result)
        for name, result in _cached("states", _states, jobs, cache, processes, on_done).items()
    }
    job = {APART: (hand, apart, states[APART], diameter)}
    found = _cached("calibration", _calibration, job, cache, 1, on_done)[APART]

    moved = {name: through_play(own, hand) for name, own in paths.items()}
    by_state = {
        "published": {name: jacobians(hand, own, rigid=True) for name, own in states.items()},
        "calibrated": {
            name: jacobians(_calibrated(hand, found), own, rigid=False) for name, own in states.items()
        },
    }
    samples = {
        horizon: {name: take_samples(own, states[name], moved[name], horizon) for name, own in paths.items()}
        for horizon in HORIZONS
    }
    alone = {
        (nominal.name, horizon): predictions(nominal, taken, by_state, APART)
        for horizon, taken in samples.items()
        for nominal in NOMINALS
        if nominal.kind != "online"
    } | _online(hand, samples, states, by_state["published"], cache, processes, on_done)
    predicted = alone | _with_learners(learners, samples, states, alone, cache, processes, quick, on_done)
    reported = [name for name in paths if name != APART]
    rows = []
    for (name, horizon), own in predicted.items():
        taken = {key: samples[horizon][key] for key in reported}
        unit = samples[horizon][APART].motion.std(axis=0)
        for subset in SUBSETS:
            rows.append(score(name, horizon, subset, taken, own, unit))
    return RecordedHandResult(paths, states, samples, predicted, rows, markers, found, quick)


def _online(
    hand: HandDescription,
    samples: dict[int, dict[str, Samples]],
    states: dict[str, States],
    usual: dict[str, Array],
    cache: Path,
    processes: int,
    on_done: Callable[[str], None] | None,
) -> dict[tuple[str, int], Predicted]:
    """The figures begin as published, and see the recording set apart first."""
    order = [APART, *sorted(name for name in states if name != APART)]
    jobs = {str(horizon): (hand, taken, states, usual, order) for horizon, taken in samples.items()}
    results = _cached("online", _adapting, jobs, cache, processes, on_done)
    (online,) = [nominal for nominal in NOMINALS if nominal.kind == "online"]
    return {
        (online.name, int(horizon)): {name: np.array(one).reshape(-1, 3) for name, one in result.items()}
        for horizon, result in results.items()
    }


def _adapting(
    hand: HandDescription,
    samples: dict[str, Samples],
    states: dict[str, States],
    usual: dict[str, Array],
    order: list[str],
) -> dict[str, Any]:
    found = adapting_predictions(hand, samples, states, usual, order)
    return {name: values.tolist() for name, values in found.items()}


def _with_learners(
    learners: tuple[str, ...],
    samples: dict[int, dict[str, Samples]],
    states: dict[str, States],
    alone: dict[tuple[str, int], Predicted],
    cache: Path,
    processes: int,
    quick: bool,
    on_done: Callable[[str], None] | None,
) -> dict[tuple[str, int], Predicted]:
    order = sorted(name for name in states if name != APART)
    jobs, keys = {}, {}
    for horizon in sorted(HORIZONS, reverse=True):  # few samples first
        for nominal in _LEARNED:
            for learner in learners:
                key = f"{nominal.name} + {learner}"
                job = f"{key} {horizon}"
                own = samples[horizon], states, alone[nominal.name, horizon]
                jobs[job] = (learner, nominal, *own, order, 40 if quick else None)
                keys[job] = key, horizon
    results = _cached("learned", _learned, jobs, cache, processes, on_done)
    return {
        keys[job]: {name: np.array(values).reshape(-1, 3) for name, values in result.items()}
        for job, result in results.items()
    }


def _states(
    name: str, paths: list[RecordedPath], markers: FingerMarkers, hand: HandDescription
) -> dict[str, Any]:
    return estimate_states(name, paths, markers, hand).plain()


def _calibration(
    hand: HandDescription, paths: list[RecordedPath], states: States, diameter: float
) -> dict[str, Any]:
    found = calibrate_hand(hand, paths, states, diameter)
    return {
        "springs": found.hand.spring_stiffness.tolist(),
        "moment_arms": found.hand.actuation_jacobian.tolist(),
        "stiffness": [actuator.stiffness for actuator in found.hand.actuators],
        "text": str(found),
    }


def _calibrated(hand: HandDescription, found: dict[str, Any]) -> HandDescription:
    actuators = tuple(
        dataclasses.replace(actuator, stiffness=stiffness)
        for actuator, stiffness in zip(hand.actuators, found["stiffness"], strict=True)
    )
    return dataclasses.replace(
        hand,
        spring_stiffness=np.array(found["springs"]),
        actuation_jacobian=np.array(found["moment_arms"]),
        actuators=actuators,
    )


def _learned(
    learner: str,
    nominal: Nominal,
    samples: dict[str, Samples],
    states: dict[str, States],
    alone: Predicted,
    order: list[str],
    limit: int | None,
) -> dict[str, Any]:
    found = learned_predictions(learner, nominal, samples, states, alone, order, APART, limit)
    return {name: values.tolist() for name, values in found.items()}


def _cached(
    kind: str,
    function: Callable[..., Any],
    jobs: dict[str, tuple[Any, ...]],
    cache: Path,
    processes: int,
    on_done: Callable[[str], None] | None,
) -> dict[str, Any]:
    """:func:`run_jobs`, in the folder of these recordings."""
    files = {}
    for name in jobs:
        plain = "".join(c if c.isalnum() else "_" for c in name)
        files[f"{kind}_{plain}"] = name
    named = {file: jobs[name] for file, name in files.items()}
    results = run_jobs(function, named, cache, processes, on_done)
    return {files[file]: result for file, result in results.items()}
