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
        return _Run(load_hand(HAND), paths, cache, processes, quick, on_done).result(tuple(learners))


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


@dataclass(frozen=True)
class _Run:
    """The recordings of a run, and where and how its jobs are done."""

    hand: HandDescription
    paths: dict[str, list[RecordedPath]]
    cache: Path
    processes: int
    quick: bool
    on_done: Callable[[str], None] | None

    def __call__(
        self, kind: str, function: Callable[..., Any], jobs: dict[str, tuple[Any, ...]]
    ) -> dict[str, Any]:
        """:func:`run_jobs`, in the folder of these recordings."""
        files = {f"{kind}_{''.join(c if c.isalnum() else '_' for c in name)}": name for name in jobs}
        named = {file: jobs[name] for file, name in files.items()}
        results = run_jobs(function, named, self.cache, self.processes, self.on_done)
        return {files[file]: result for file, result in results.items()}

    def result(self, learners: tuple[str, ...]) -> RecordedHandResult:
        """Everything, from markers to scores."""
        hand, apart = self.hand, self.paths[APART]
        diameter = known_diameter(APART)
        assert diameter is not None  # its name states it
        seen, pose = (np.concatenate([getattr(path, part) for path in apart]) for part in ("markers", "pose"))
        markers = identify_markers(hand, seen, pose, diameter)
        found = self(
            "states", _states, {name: (name, own, markers, hand) for name, own in self.paths.items()}
        )
        states = {name: States.of(plain) for name, plain in found.items()}
        calibration = self("calibration", _calibration, {APART: (hand, apart, states[APART], diameter)})[
            APART
        ]
        calibrated = _calibrated(hand, calibration)
        by_state = {
            "published": {name: jacobians(hand, own, rigid=True) for name, own in states.items()},
            "calibrated": {name: jacobians(calibrated, own, rigid=False) for name, own in states.items()},
        }
        moved = {name: through_play(own, hand) for name, own in self.paths.items()}
        samples = {
            horizon: {
                name: take_samples(own, states[name], moved[name], horizon)
                for name, own in self.paths.items()
            }
            for horizon in HORIZONS
        }
        predicted = {
            (nominal.name, horizon): predictions(nominal, taken, by_state, APART)
            for horizon, taken in samples.items()
            for nominal in NOMINALS
            if nominal.kind != "online"
        }
        order = sorted(name for name in states if name != APART)
        (online,) = (nominal for nominal in NOMINALS if nominal.kind == "online")
        adapting = hand, states, by_state["published"], [APART, *order]
        jobs = {str(horizon): (taken, *adapting) for horizon, taken in samples.items()}
        for horizon, result in self("online", _adapting, jobs).items():
            predicted[online.name, int(horizon)] = _arrays(result)
        jobs, keys, limit = {}, {}, 40 if self.quick else None
        for horizon, nominal, learner in itertools.product(
            sorted(HORIZONS, reverse=True), _LEARNED, learners
        ):
            key = f"{nominal.name} + {learner}"  # few samples first
            own = samples[horizon], states, predicted[nominal.name, horizon]
            jobs[f"{key} {horizon}"] = learner, nominal, *own, order, APART, limit
            keys[f"{key} {horizon}"] = key, horizon
        for job, result in self("learned", _learned, jobs).items():
            predicted[keys[job]] = _arrays(result)
        rows = []
        for (name, horizon), own in predicted.items():
            taken = {key: samples[horizon][key] for key in order}
            unit = samples[horizon][APART].motion.std(axis=0)
            rows += [score(name, horizon, subset, taken, own, unit) for subset in SUBSETS]
        return RecordedHandResult(
            self.paths, states, samples, predicted, rows, markers, calibration, self.quick
        )


def _arrays(plain: dict[str, Any]) -> Predicted:
    return {name: np.array(values).reshape(-1, 3) for name, values in plain.items()}


def _plain(found: Predicted) -> dict[str, Any]:
    return {name: values.tolist() for name, values in found.items()}


def _states(*given: Any) -> dict[str, Any]:
    return estimate_states(*given).plain()


def _adapting(samples: dict[str, Samples], hand: HandDescription, *given: Any) -> dict[str, Any]:
    return _plain(adapting_predictions(hand, samples, *given))


def _learned(*given: Any) -> dict[str, Any]:
    return _plain(learned_predictions(*given))


def _calibration(*given: Any) -> dict[str, Any]:
    found = calibrate_hand(*given)
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
    springs, arms = np.array(found["springs"]), np.array(found["moment_arms"])
    return dataclasses.replace(hand, spring_stiffness=springs, actuation_jacobian=arms, actuators=actuators)
