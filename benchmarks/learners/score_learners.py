"""Errors of the learners on a real hand and on public streams, as in docs/benchmarks/learners.md.

``score_learners.py hand --half reported`` and ``... streams --seed 1000 --stream kin40k``.
Needs the recordings (``TORCH_EKM_DATA``). Settings were chosen on the development half and on seeds below
100; ``--quick`` runs the first samples only. Rows of the table appear as they are ready.
"""

from __future__ import annotations

import argparse
import re
import time
from typing import Any

import numpy as np
import torch
from gpytorch_svgp import GPyTorchSVGP
from stream_scores import load_split, score_objects, score_split

from torch_ekm.experiments.learner_comparison.recordings import load_t42
from torch_ekm.experiments.learner_comparison.stream import Stream
from torch_ekm.experiments.learners import LEARNERS, Factory
from torch_ekm.residual import (
    CalibrateNoise,
    LearnHyperparameters,
    MixtureResidual,
    ProcessNoise,
    ResidualLearner,
)


def chosen(name: str, **options: Any) -> Factory:
    """A learner of the registry with other figures."""
    return lambda d, m: LEARNERS[name](d, m, **options)


_LOUD: dict[str, Any] = {"noise_variance": 0.3}
_WANDERING = [ProcessNoise(0.003)]
_CALIBRATED = [*_WANDERING, CalibrateNoise()]
_ADAPTED = [*_WANDERING, LearnHyperparameters()]
HAND: dict[str, Factory] = {
    "zero": chosen("model alone"),
    "SOGP as published (100 points)": chosen("SOGP plain", **_LOUD),
    "SOGP, forgetting .99, robust 3, calibrated": chosen("SOGP", parts=[CalibrateNoise()], **_LOUD),
    "SOGP, process noise .003, robust 3, calibrated": chosen(
        "SOGP plain", robust=3.0, parts=_CALIBRATED, **_LOUD
    ),
    "SOGP, process noise .003, robust 3": chosen("SOGP plain", robust=3.0, parts=_WANDERING, **_LOUD),
    "SOGP, process noise .003, robust 3, adaptation": chosen(
        "SOGP plain", robust=3.0, parts=_ADAPTED, **_LOUD
    ),
    "deep SOGP, process noise .003, robust 3": chosen("SOGP deep", parts=_WANDERING, **_LOUD),
    "RLS, forgetting .99, robust 3": chosen("linear RLS", **_LOUD),
    "random features, forgetting .99, robust 3": chosen("random features", **_LOUD),
    "ensemble of four networks": chosen("MLP ensemble", members=4),
    "river, adaptive random forest": chosen("river forest"),
}

_STILL: dict[str, Any] = {"forgetting_factor": 1.0, "robust": None}
STREAMS: dict[str, Factory] = {
    "zero": chosen("model alone"),
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


def hand(names: list[str], half: str, quick: bool, kept: bool) -> None:
    """Every second object; a learner is kept over all of them, or fresh for each."""
    objects = load_t42()[0 if half == "development" else 1 :: 2]
    if quick:
        objects = [Stream(o.name, o.x[:60], o.y[:60]) for o in objects[:2]]
    d, m = objects[0].x.shape[1], objects[0].y.shape[1]
    print(f"{half} half: {len(objects)} objects, {sum(len(o.x) for o in objects)} samples, kept: {kept}\n")
    head = "learner | rms | median | rms, worst object | NLL, normal | NLL, own law | 90 % coverage | [ms]"
    for title, wrap in (("Learners alone", lambda learner: learner), ("In a mixture", MixtureResidual)):
        print(f"### {title}\n\n| {head} |\n|---|---|---|---|---|---|---|---|")
        for name in names:

            def make(wrap=wrap, name=name) -> ResidualLearner:
                torch.manual_seed(0)
                return wrap(HAND[name](d, m))

            begin = time.perf_counter()
            scores = score_objects(make, objects, kept=kept)
            cost = (time.perf_counter() - begin) / sum(len(o.x) for o in objects) * 1e3

            def mean(field: str, scores=scores) -> float:
                return float(np.mean([getattr(score, field) for score in scores]))

            worst = max(s.winsorised_second_half for s in scores)
            coverage = np.mean([s.coverage for s in scores], axis=0)
            print(
                f"| {name} | {mean('winsorised_second_half'):.3f} | {mean('median_second_half'):.3f} "
                f"| {worst:.3f} | {mean('nll'):.2f} | {mean('predictive_nll'):.2f} "
                f"| {' '.join(f'{c:.2f}' for c in coverage)} | {cost:.1f} |",
                flush=True,
            )
        print()


def streams(names: list[str], which: list[str], seed: int, quick: bool) -> None:
    """One pass, a tenth held out, targets of unit variance, nothing tuned per set."""
    splits = [load_split(stream_name, seed) for stream_name in which]
    if quick:
        splits = [split._replace(x=split.x[:200], y=split.y[:200]) for split in splits]
    titles = [split.name for split in splits]
    columns = ["learner", *titles, *(f"NLL, {title} [nats]" for title in titles), "time of a sample [µs]"]
    print("| " + " | ".join(columns) + " |\n" + "|---" * len(columns) + "|")
    for name in names:
        scores = []
        for split in splits:
            torch.manual_seed(seed)
            scores.append(score_split(STREAMS[name], split))
        time_of_all = float(np.mean([s.microseconds for s in scores]))
        cells = [*(f"{s.rmse:.3f}" for s in scores), *(f"{s.nll:.2f}" for s in scores), f"{time_of_all:.0f}"]
        print("| " + " | ".join([name, *cells]) + " |", flush=True)


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
