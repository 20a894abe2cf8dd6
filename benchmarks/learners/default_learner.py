"""The default learner against each of ours on many streams, and what it must bear.

``default_learner.py --seeds 1000:1010`` (settings were chosen on seeds below 100); ``--quick`` runs
thirty samples of one stream. Recordings are taken along where ``TORCH_EKM_DATA`` names their folder.
Errors are rms of the second half over that of the model alone; rows appear as they are ready.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from default_streams import (
    Samples,
    arm,
    from_rest,
    jumping,
    noisy_side,
    pure_noise,
    streams,
    there_and_back,
    wide_and_noisy,
    with_outliers,
)

sys.path.insert(0, str(Path(__file__).parents[1]))
from dots import dot_chart

from torch_ekm.cli._app import parse_seeds
from torch_ekm.experiments.learner_comparison.prequential import Prequential, run_prequential
from torch_ekm.experiments.reporting.plots import save_figure
from torch_ekm.experiments.reporting.report import Column, Report, Table
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
    """Predict each sample, then learn it; learners seed themselves."""
    return run_prequential(make(samples.x.shape[1], samples.y.shape[1], **options), samples.x, samples.y)


def ratio(mean: Tensor, truth: Tensor) -> float:
    """rms of what is left over, over that of the model alone."""
    return float((truth - mean).square().mean().sqrt() / truth.square().mean().sqrt())


def left(make: Make, samples: Samples, begin: int) -> float:
    """Error over that of the model alone, from a sample on."""
    return ratio(run(make, samples).mean[begin:], samples.y[begin:])


def table(n: int, seeds: Sequence[int], only: Sequence[str] = ()) -> Table:
    """Each learner on each stream."""
    drawn, rows = streams(n, seeds), []
    for name in only or drawn:
        errors, coverages = [], []
        for samples in drawn[name]:
            half = len(samples.x) // 2
            runs = [run(make, samples) for make in LEARNERS.values()]
            errors.append([ratio(r.mean[half:], samples.y[half:]) for r in runs])
            coverages.append(float(runs[0].coverage(half).mean()))
        mean = np.mean(errors, 0)
        rows.append([name, *mean.tolist(), float(mean[0] / mean.min()), float(np.mean(coverages))])
        print(*rows[-1], file=sys.stderr, flush=True)
    figures = [*(Column(name, ".3f") for name in LEARNERS), Column("default : best")]
    columns = ["stream", *figures, Column("coverage of 90 % [%]", ".0f", percent=True)]
    return Table("streams", "Error of each learner over that of the model alone", columns, rows)


def jump(n: int, seed: int) -> float:
    """Error 50 to 100 samples after the system shifts, in shifts."""
    at = min(400, n // 2)
    late = run(default_learner, jumping(at + 100, seed, at)).error[at + 50 :]
    return float(late.square().mean().sqrt()) / 3.0


def outliers(n: int, seed: int) -> float:
    """Error with outliers over that without them."""
    dirty = with_outliers(n, seed)
    pair = [run(default_learner, s) for s in (dirty, dirty._replace(y=_without_outliers(dirty)))]
    spoiled, clean = (float((dirty.clean - r.mean)[n // 2 :].square().mean().sqrt()) for r in pair)
    return spoiled / clean


def start_at_rest(n: int, seed: int) -> float:
    """Error from a hundred samples behind the start on."""
    rest = min(300, n // 2)
    return left(default_learner, from_rest(max(n, 2 * rest), seed, rest), rest + rest // 3)


def wide(n: int, seed: int) -> float:
    """Error over that of the best single learner."""
    samples, half = wide_and_noisy(n, seed), n // 2
    single = min(left(make, samples, half) for make in (SparseOnlineGP, DeepKernelSOGP))
    return left(default_learner, samples, half) / single


def fast_arm(n: int, seed: int) -> float:
    """Error over that of the residual before as a prediction."""
    samples, half = arm(n, seed), n // 2
    after = run(default_learner, samples).error[half:].square().mean().sqrt()
    before = (samples.y[half:] - samples.y[half - 1 : -1]).square().mean().sqrt()
    return float(after / before)


def back(n: int, seed: int) -> float:
    """Error over the first 50 samples after a system that was known came back."""
    n = min(n, 900)
    samples, at = there_and_back(n, seed), 8 * n // 9
    error = run(default_learner, samples).error[at : at + 50]
    return float(error.square().mean().sqrt() / samples.y[at : at + 50].square().mean().sqrt())


def thirds(n: int, seed: int) -> float:
    """Largest distance from 0.9 of what 90 % intervals hold, in thirds by the predicted deviation."""
    samples, learner, held = noisy_side(min(n, 1000), seed), default_learner(1, 1), []
    for x, y in zip(samples.x, samples.y, strict=True):
        inside = abs(float(learner.predictive(x).cdf(y)) - 0.5) <= 0.45
        held.append([float(learner.predict(x, observation=True).stddev), float(inside)])
        learner.update(x, y)
    deviation, within = torch.tensor(held[len(held) // 10 :]).unbind(-1)
    return max(abs(float(part.mean()) - 0.9) for part in within[deviation.argsort()].chunk(3))


#: What the default must bear: ``measure(n, seed)``, at most allowed.
BARS: dict[str, tuple[Callable[[int, int], float], float]] = {
    "pure noise, error / model alone": (
        lambda n, seed: left(default_learner, pure_noise(n, seed), n // 2),
        1.01,
    ),
    "jump of 3 sd, error 50 to 100 samples later / 3 sd": (jump, 0.3),
    "10 % outliers of 30 sd, error / without them": (outliers, 1.1),
    "start at rest, error after it": (start_at_rest, 0.75),
    "32 inputs, three matter: error / best single one's": (wide, 1.05),
    "arm at 100 Hz, error / that of the residual before": (fast_arm, 0.95),
    "a system that comes back, error of its first 50 samples": (back, 0.3),
    "noise of x, thirds by what is predicted: coverage of 90 % off by": (thirds, 0.05),
}


def bars(n: int, seeds: Sequence[int]) -> Table:
    """Mean and largest of the seeds."""
    rows = []
    for name, (measured, most) in BARS.items():
        found = [measured(n, seed) for seed in seeds]
        rows.append([name, float(np.mean(found)), max(found), most])
        print(*rows[-1], file=sys.stderr, flush=True)
    figures = Column("mean", ".3f"), Column("largest", ".3f"), Column("aim: at most", "g")
    columns = ["test of the default learner", *figures]
    return Table("bars", "What the default learner must bear", columns, rows)


def _without_outliers(samples: Samples) -> Tensor:
    hit = (samples.y - samples.clean).abs().amax(-1, keepdim=True) > 10.0
    g = torch.Generator().manual_seed(0)
    noise = 0.1 * torch.randn(samples.y.shape, generator=g, dtype=samples.y.dtype)
    return torch.where(hit, samples.clean + noise, samples.y)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=parse_seeds, default=(0,), help="FIRST:END")
    parser.add_argument("--out", type=Path, default=Path("default_learner_output"))
    parser.add_argument("--quick", action="store_true")
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)
    n, seeds, only = (30, given.seeds[:1], ["smooth"]) if given.quick else (2000, given.seeds, [])
    tables = [table(n, seeds, only), bars(n, seeds)]
    caption = "Errors of the learners on each stream, over those of the model alone."
    figure = dot_chart(tables[:1], list(LEARNERS), "error / model alone", log=True)
    shown = save_figure(figure, given.out, "streams", caption)
    summary = f"rms errors of the second half, means over {len(seeds)} seeds."
    report = Report("The default learner", summary, tables[::-1], [shown])
    report.write(given.out)
    print(report.markdown())


if __name__ == "__main__":
    main()
