"""Learners on a real hand and on regression sets: each sample is predicted, then learned.

``score_learners.py hand --half reported --out FOLDER`` and ``... streams --seed 1000 --out FOLDER``. Needs
the recordings (``TORCH_EKM_DATA``). Settings were chosen on the development half and on seeds below 100;
``--quick`` takes the first samples and learners only. Interrupted, it goes on where it stopped.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from gpytorch_svgp import GPyTorchSVGP

from torch_ekm.experiments import compare
from torch_ekm.experiments.learner_comparison.recordings import load_recording, load_t42
from torch_ekm.experiments.learner_comparison.stream import Stream
from torch_ekm.experiments.learners import LEARNERS, Factory
from torch_ekm.residual import CalibrateNoise, LearnHyperparameters, MixtureResidual, ProcessNoise

_SETS = ("sarcos", "kin40k", "powerplant")
_SAMPLES = 8000  # of a set


def chosen(name: str, **options: Any) -> Factory:
    """A learner of the registry with other figures."""
    return lambda d, m: LEARNERS[name](d, m, **options)


def in_mixture(make: Factory) -> Factory:
    """In addition to the model alone and the last residual."""
    return lambda d, m: MixtureResidual(make(d, m))


_LOUD: dict[str, Any] = {"noise_variance": 0.3}
_WANDERING: dict[str, Any] = {"robust": 3.0, **_LOUD}
_WANDERS = ProcessNoise(0.003)
_ALONE: dict[str, Factory] = {
    "SOGP as published": chosen("SOGP plain", **_LOUD),
    "SOGP, forgets, calibrated": chosen("SOGP", parts=[CalibrateNoise()], **_LOUD),
    "SOGP, wanders": chosen("SOGP plain", parts=[_WANDERS], **_WANDERING),
    "SOGP, wanders, calibrated": chosen("SOGP plain", parts=[_WANDERS, CalibrateNoise()], **_WANDERING),
    "SOGP, wanders, adapts": chosen("SOGP plain", parts=[_WANDERS, LearnHyperparameters()], **_WANDERING),
    "deep SOGP, wanders": chosen("SOGP deep", parts=[_WANDERS], **_LOUD),
    "RLS, forgets": chosen("linear RLS", **_LOUD),
    "random features, forgets": chosen("random features", **_LOUD),
    "ensemble of four networks": chosen("MLP ensemble", members=4),
    "river, adaptive random forest": chosen("river forest"),
}
HAND = {
    "model alone": chosen("model alone"),
    **_ALONE,
    **{f"{name}; mixture": in_mixture(make) for name, make in _ALONE.items()},
}
_STILL: dict[str, Any] = {"forgetting_factor": 1.0, "robust": None}
STREAMS: dict[str, Factory] = {
    "model alone": chosen("model alone"),
    "RLS": chosen("linear RLS", **_STILL),
    "random features, 2 x 100": chosen("random features", **_STILL),
    "SOGP 100": chosen("SOGP plain"),
    "SOGP 100, adaptation": chosen("SOGP plain", parts=[LearnHyperparameters()]),
    "SOGP 300, adaptation": chosen("SOGP plain", capacity=300, parts=[LearnHyperparameters()]),
    "deep SOGP 100": chosen("SOGP deep", parts=(), robust=None),
    "deep SOGP 300": chosen("SOGP deep", parts=(), robust=None, capacity=300),
    "GPyTorch SVGP 100": GPyTorchSVGP,
    "river, adaptive random forest": chosen("river forest"),
    "ensemble of four networks, all replayed": chosen("MLP ensemble", members=4, memory=10_000),
}


def hand(half: str, most: int | None) -> Stream:
    """Every second object, one after the other; a learner is kept over all of them."""
    objects = load_t42()[0 if half == "development" else 1 :: 2]
    objects = objects if most is None else objects[:2]
    x, y = (torch.cat([getattr(one, part)[:most] for one in objects]) for part in "xy")
    about = f"Yale T42, {len(objects)} objects; alone: one constant Jacobian"
    return Stream("t42", x, y, segments=tuple(len(one.x[:most]) for one in objects), about=about)


def shuffled(name: str, seed: int, most: int | None) -> Stream:
    """A regression set in the order of a seed: its file is sorted in a way of its own."""
    one = load_recording(name, None)
    order = torch.randperm(len(one), generator=torch.Generator().manual_seed(seed))[: most or _SAMPLES]
    return Stream(name, one.x[order], one.y[order], one.warm_up, about=one.about)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("hand", "streams"))
    parser.add_argument("--half", choices=("development", "reported"), default="development")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("score_learners_output"))
    parser.add_argument("--jobs", type=int, default=2, help="processes at once")
    parser.add_argument("--quick", action="store_true")
    given = parser.parse_args(arguments)
    most, learners = (250, 3) if given.quick else (None, None)
    if given.what == "hand":
        streams, factories = [hand(given.half, most)], HAND
    else:
        streams, factories = [shuffled(name, given.seed, most) for name in _SETS], STREAMS
    factories = dict(list(factories.items())[:learners])
    found = compare(streams, factories, folder=given.out / "runs", processes=given.jobs)
    print(found.write(given.out).markdown())


if __name__ == "__main__":
    main()
