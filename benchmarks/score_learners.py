"""Errors of the learners on a real hand and on public streams, as in docs/choosing_a_learner.md.

``benchmarks/score_learners.py hand --half reported`` and ``... streams --seed 1000 --stream kin40k``.
Needs the recordings (``TORCH_EKM_DATA``). Settings were chosen on the development half and on seeds below
100; ``--quick`` runs the first samples only. Rows of the table appear as they are ready.
"""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from stream_scores import load_split, score_objects, score_split

from torch_ekm.experiments.learner_comparison.recordings import load_t42
from torch_ekm.experiments.learner_comparison.stream import Stream
from torch_ekm.residual import (
    DeepKernelSOGP,
    GPyTorchSVGP,
    GPyTorchWindow,
    KRLSTracker,
    LocalGPs,
    MixtureResidual,
    RandomFeatureRLS,
    RecursiveLeastSquares,
    ReplayMLP,
    ResidualLearner,
    RiverResidual,
    SparseOnlineGP,
    WindowGP,
    ZeroResidual,
)

Factory = Callable[[int, int], ResidualLearner]
_OLD: dict[str, Any] = {"noise_variance": 0.3, "forgetting": 0.99, "robust": 3.0}
_NEW: dict[str, Any] = {"noise_variance": 0.3, "diffusion": 0.003, "robust": 3.0}


def sogp(**options: Any) -> Factory:
    return lambda d, m: SparseOnlineGP(d, m, **options)


def deep(**options: Any) -> Factory:
    return lambda d, m: DeepKernelSOGP(d, m, **options)


HAND: dict[str, Factory] = {
    "zero": lambda d, m: ZeroResidual(d, m),
    "SOGP as published (100 points)": sogp(noise_variance=0.3),
    "SOGP, forgetting .99, robust 3, calibrated": sogp(calibrate=True, **_OLD),
    "SOGP, diffusion .003, robust 3, calibrated": sogp(calibrate=True, **_NEW),
    "SOGP, diffusion .003, robust 3": sogp(**_NEW),
    "SOGP, diffusion .003, robust 3, adaptation": sogp(adapt=True, **_NEW),
    "deep SOGP, diffusion .003, robust 3": deep(**_NEW),
    "RLS, forgetting .99, robust 3": lambda d, m: RecursiveLeastSquares(d, m, **_OLD),
    "random features, forgetting .99, robust 3": lambda d, m: RandomFeatureRLS(d, m, **_OLD),
    "sliding-window GP 100, robust 3": lambda d, m: WindowGP(d, m, noise_variance=0.3, robust=3.0),
    "KRLS-T 100, forgetting .99": lambda d, m: KRLSTracker(d, m, noise_variance=0.3, forgetting=0.99),
    "local GPs, 40 x 100": lambda d, m: LocalGPs(d, m, noise_variance=0.3),
    "ensemble of four networks": lambda d, m: ReplayMLP(d, m, members=4),
    "river, adaptive random forest": lambda d, m: RiverResidual(d, m),
}

_START: dict[str, Any] = {"noise_variance": 0.1}
STREAMS: dict[str, Factory] = {
    "zero": lambda d, m: ZeroResidual(d, m),
    "RLS": lambda d, m: RecursiveLeastSquares(d, m, **_START),
    "random features, 2 x 100": lambda d, m: RandomFeatureRLS(d, m, **_START),
    "SOGP 100": sogp(**_START),
    "SOGP 100, adaptation": sogp(adapt=True, **_START),
    "SOGP 300, adaptation": sogp(capacity=300, adapt=True, **_START),
    "deep SOGP 100": deep(**_START),
    "deep SOGP 300": deep(capacity=300, **_START),
    "sliding-window GP 100": lambda d, m: WindowGP(d, m, **_START),
    "KRLS-T 100": lambda d, m: KRLSTracker(d, m, **_START),
    "local GPs, 40 x 100": lambda d, m: LocalGPs(d, m, **_START),
    "GPyTorch SVGP 100": lambda d, m: GPyTorchSVGP(d, m, inducing=100),
    "GPyTorch window 100": lambda d, m: GPyTorchWindow(d, m, window=100, **_START),
    "river, adaptive random forest": lambda d, m: RiverResidual(d, m),
    "ensemble of four networks, all replayed": lambda d, m: ReplayMLP(d, m, members=4, memory=10_000),
}


def hand(names: list[str], half: str, quick: bool, kept: bool) -> None:
    """Every second object; a learner is kept over all of them, or fresh for each."""
    objects = load_t42()[0 if half == "development" else 1 :: 2]
    if quick:
        objects = [Stream(o.name, o.x[:60], o.y[:60]) for o in objects[:2]]
    d, m = objects[0].x.shape[1], objects[0].y.shape[1]
    print(f"{half} half: {len(objects)} objects, {sum(len(o.x) for o in objects)} samples, kept: {kept}\n")
    print("| learner | rms, second half, winsorised | median, second half | rms, all | median, all |")
    print("| | worst object: winsorised 2nd half; rms | NLL normal; own law | coverage | ms |")
    for name in names:
        for title, wrap in ((name, lambda learner: learner), (f"{name}, in a mixture", MixtureResidual)):

            def make(wrap=wrap, name=name) -> ResidualLearner:
                torch.manual_seed(0)
                return wrap(HAND[name](d, m))

            begin = time.perf_counter()
            scores = score_objects(make, objects, kept=kept)
            cost = (time.perf_counter() - begin) / sum(len(o.x) for o in objects) * 1e3

            def mean(field: str, scores=scores) -> float:
                return float(np.mean([getattr(score, field) for score in scores]))

            worst = max(s.winsorised_second_half for s in scores), max(s.rms for s in scores)
            coverage = np.mean([s.coverage for s in scores], axis=0)
            print(
                f"| {title} | {mean('winsorised_second_half'):.3f} | {mean('median_second_half'):.3f} "
                f"| {mean('rms'):.3f} | {mean('median'):.3f} | {worst[0]:.3f}; {worst[1]:.3f} "
                f"| {mean('nll'):.2f}; {mean('predictive_nll'):.2f} "
                f"| {' '.join(f'{c:.2f}' for c in coverage)} | {cost:.1f} |",
                flush=True,
            )


def streams(names: list[str], which: list[str], seed: int, quick: bool) -> None:
    """One pass, a tenth held out, targets of unit variance, nothing tuned per set."""
    print("| learner | stream | test RMSE | NLL | us per sample |")
    for stream_name in which:
        split = load_split(stream_name, seed)
        if quick:
            split = split._replace(x=split.x[:200], y=split.y[:200])
        for name in names:
            torch.manual_seed(seed)
            s = score_split(STREAMS[name], split)
            print(
                f"| {name} | {split.name} | {s.rmse:.4f} | {s.nll:.2f} | {s.microseconds:.0f} |", flush=True
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("hand", "streams"))
    parser.add_argument("--half", choices=("development", "reported"), default="development")
    parser.add_argument("--fresh", action="store_true", help="a fresh learner for each object")
    parser.add_argument("--stream", nargs="+", default=["sarcos", "kin40k", "powerplant"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--learner", default="", help="regular expression of the learners' names")
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(1)
    table = HAND if options.what == "hand" else STREAMS
    names = [name for name in table if re.search(options.learner, name)]
    if options.what == "hand":
        hand(names, options.half, options.quick, kept=not options.fresh)
    else:
        streams(names, options.stream, options.seed, options.quick)


if __name__ == "__main__":
    main()
