"""The default learner against each of ours on many streams, and what it must bear.

``default_learner.py --seed 1000`` (settings were chosen on seeds below 100); ``--quick`` runs
thirty samples of one stream. Recordings are taken along where ``TORCH_EKM_DATA`` names their folder.
Errors are rms of the second half over that of the model alone; rows appear as they are ready.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import torch
from default_streams import (
    Samples,
    arm,
    from_rest,
    jumping,
    product_of_two,
    pure_noise,
    streams,
    wide_and_noisy,
    with_outliers,
)

from torch_ekm.experiments.learner_comparison.prequential import Prequential, run_prequential
from torch_ekm.residual import (
    DeepKernelSOGP,
    RandomFeatureRLS,
    RecursiveLeastSquares,
    ResidualLearner,
    SparseOnlineGP,
    default_learner,
)
from torch_ekm.typing import Tensor

Make = Callable[..., ResidualLearner]
#: All made from their two sizes; the default first.
LEARNERS: dict[str, Make] = {
    "default": default_learner,
    "SparseOnlineGP": SparseOnlineGP,
    "DeepKernelSOGP": DeepKernelSOGP,
    "RecursiveLeastSquares": RecursiveLeastSquares,
    "RandomFeatureRLS": RandomFeatureRLS,
}


def run(make: Make, samples: Samples, **options: Any) -> Prequential:
    """Predict each sample, then learn it."""
    torch.manual_seed(0)
    return run_prequential(make(samples.x.shape[1], samples.y.shape[1], **options), samples.x, samples.y)


def ratio(mean: Tensor, truth: Tensor) -> float:
    """rms of what is left over, over that of the model alone."""
    return float((truth - mean).square().mean().sqrt() / truth.square().mean().sqrt())


def table(n: int, seed: int, only: tuple[str, ...] = ()) -> dict[str, float]:
    """Each learner on each stream; returns the default's error over the best one's."""
    print("| stream | " + " | ".join(LEARNERS) + " | default : best | coverage of 90 % |")
    print("|---" * (len(LEARNERS) + 3) + "|")
    against = {}
    for name, samples in streams(n, seed).items():
        if only and name not in only:
            continue
        half = len(samples.x) // 2
        runs = {learner: run(make, samples) for learner, make in LEARNERS.items()}
        errors = {learner: ratio(r.mean[half:], samples.y[half:]) for learner, r in runs.items()}
        against[name] = errors["default"] / min(errors.values())
        figures = " | ".join(f"{error:.3f}" for error in errors.values())
        coverage = float(runs["default"].coverage(half).mean())
        print(f"| {name} | {figures} | {against[name]:.2f} | {100 * coverage:.0f} % |", flush=True)
    return against


def bars(n: int, seed: int) -> dict[str, tuple[float, float]]:
    """What the default must bear: measured, and at most allowed."""
    found: dict[str, tuple[float, float]] = {}

    def say(name: str, value: float, most: float) -> None:
        found[name] = value, most
        print(f"| {name} | {value:.3f} | {most:g} |", flush=True)

    print("\n| test of the default learner | measured | aim: at most |\n|---|---|---|")
    samples = pure_noise(n, seed)
    half = n // 2
    error = ratio(run(default_learner, samples).mean[half:], samples.y[half:])
    say("pure noise, error / model alone", error, 1.01)
    at = min(400, half)
    late = run(default_learner, jumping(at + 100, seed, at)).error[at + 50 :]
    say("jump of 3 sd, error 50 to 100 samples later / 3 sd", float(late.square().mean().sqrt()) / 3.0, 0.3)
    dirty = with_outliers(n, seed)
    pair = [run(default_learner, s) for s in (dirty, dirty._replace(y=_without_outliers(dirty)))]
    spoiled, clean = (float((dirty.clean - r.mean)[half:].square().mean().sqrt()) for r in pair)
    say("10 % outliers of 30 sd, error / without them", spoiled / clean, 1.1)
    rest = min(300, half)
    samples, later = from_rest(max(n, 2 * rest), seed, rest), rest + rest // 3
    error = ratio(run(default_learner, samples).mean[later:], samples.y[later:])
    say("start at rest, error after it", error, 0.75)
    samples = wide_and_noisy(n, seed)
    error = ratio(run(default_learner, samples).mean[half:], samples.y[half:])
    single = min(
        ratio(run(make, samples).mean[half:], samples.y[half:]) for make in (SparseOnlineGP, DeepKernelSOGP)
    )
    say("32 inputs, three matter: error / best single one's", error / single, 1.05)
    samples = arm(n, seed)
    left = run(default_learner, samples).error[half:].square().mean().sqrt()
    before = (samples.y[half:] - samples.y[half - 1 : -1]).square().mean().sqrt()
    say("arm at 100 Hz, error / that of the residual before", float(left / before), 0.95)
    return found


def _without_outliers(samples: Samples) -> Tensor:
    hit = (samples.y - samples.clean).abs().amax(-1, keepdim=True) > 10.0
    g = torch.Generator().manual_seed(0)
    noise = 0.1 * torch.randn(samples.y.shape, generator=g, dtype=samples.y.dtype)
    return torch.where(hit, samples.clean + noise, samples.y)


def overfitting(n: int, seed: int, capacity: int) -> None:
    """The product of two of 32 inputs: the deep learner compared with the plain one."""
    samples = product_of_two(n, seed)
    print(
        f"\n| product of two of 32 inputs, {capacity} points | error of y | coverage of 90 % |\n|---|---|---|"
    )
    for name, make in (("SparseOnlineGP", SparseOnlineGP), ("DeepKernelSOGP", DeepKernelSOGP)):
        r = run(make, samples, capacity=capacity)
        error, coverage = ratio(r.mean[n // 2 :], samples.y[n // 2 :]), float(r.coverage(n // 2).mean())
        print(f"| {name} | {error:.3f} | {100 * coverage:.0f} % |", flush=True)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--samples", type=int, default=2000)
    parser.add_argument("--stream", nargs="+", default=[], help="only these")
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    if options.quick:
        table(30, options.seed, ("smooth",))
        bars(30, options.seed)
        overfitting(30, options.seed, 15)
        return
    table(options.samples, options.seed, tuple(options.stream))
    if not options.stream:
        bars(options.samples, options.seed)
        overfitting(7000, options.seed, 300)


if __name__ == "__main__":
    main()
