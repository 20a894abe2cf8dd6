"""What learners say on streams that are meant to break them: NaN, and |g| by the largest |y| seen.

``hostile_streams.py --seeds 1000:1040``; ``--quick`` runs short streams of one seed. A stream draws, from its
seed, the units of x and y from 1e-9 to 1e9, an origin of x, a jitter from 1e-15 to 1e-2 of an input or output
that stands still before it moves, and one or two events. Each learner is asked for everything at the sample
that comes, at the last one and far away, one query by one and as a batch.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch

from torch_ekm.cli._app import parse_seeds
from torch_ekm.residual import (
    ActionLinearKernel,
    DeepKernelSOGP,
    ForgettingFactor,
    LinearKernel,
    MixtureResidual,
    ProcessNoise,
    RandomFeatureRLS,
    RecursiveLeastSquares,
    ReplayMLP,
    ResidualLearner,
    SparseOnlineGP,
    ZeroResidual,
    default_learner,
)
from torch_ekm.typing import Tensor

IN, OUT = 4, 2
#: Made from their two sizes and a capacity.
LEARNERS: dict[str, Callable[[int], ResidualLearner]] = {
    "default": lambda b: default_learner(IN, OUT, capacity=b),
    "SparseOnlineGP": lambda b: SparseOnlineGP(IN, OUT, capacity=b),
    "DeepKernelSOGP": lambda b: DeepKernelSOGP(IN, OUT, capacity=b),
    "linear kernel": lambda b: SparseOnlineGP(IN, OUT, capacity=b, kernel=LinearKernel(IN)),
    "linear kernel, forgetting": lambda b: SparseOnlineGP(
        IN, OUT, capacity=b, kernel=LinearKernel(IN), parts=[ForgettingFactor(0.98)]
    ),
    "linear in the action": lambda b: SparseOnlineGP(IN, OUT, capacity=b, kernel=ActionLinearKernel(IN, 1)),
    "wandering": lambda b: SparseOnlineGP(IN, OUT, capacity=b, parts=[ProcessNoise(0.01)]),
    "as given": lambda b: SparseOnlineGP(IN, OUT, capacity=b, standardize=False),
    "RecursiveLeastSquares": lambda b: RecursiveLeastSquares(IN, OUT),
    "RLS, forgetting": lambda b: RecursiveLeastSquares(IN, OUT, forgetting_factor=0.98, robust=3.0),
    "RLS, as given": lambda b: RecursiveLeastSquares(IN, OUT, standardize=False),
    "RandomFeatureRLS": lambda b: RandomFeatureRLS(IN, OUT, n_frequencies=b),
    "ReplayMLP": lambda b: ReplayMLP(IN, OUT, hidden=(b,)),
    "mixture": lambda b: MixtureResidual(
        [SparseOnlineGP(IN, OUT, capacity=b), RecursiveLeastSquares(IN, OUT)]
    ),
    "ZeroResidual": lambda b: ZeroResidual(IN, OUT),
}
EVENTS = (
    "input stands still", "output stands still", "all stands still", "steps of x", "steps of y", "y shrinks",
    "y grows", "outliers of x", "outliers of y", "duplicates", "a constant input", "equal inputs",
)  # fmt: skip


class Hostile(NamedTuple):
    """A stream: units of x and y, origin of x in units, jitter of what stands still in units, and events."""

    seed: int
    n: int
    x_unit: float
    y_unit: float
    origin: float
    jitter: float
    events: tuple[str, ...]

    def samples(self) -> tuple[Tensor, Tensor]:
        """x ``(n, 4)``, y ``(n, 2)``."""
        g = torch.Generator().manual_seed(self.seed)

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=g, dtype=torch.float64)

        n, late = self.n, torch.arange(self.n) >= self.n // 2
        x = normal(n, IN)
        y = torch.stack([torch.sin(x[:, 0]) + 0.3 * x[:, 1], x[:, 2] * x[:, 1]], -1) + 0.05 * normal(n, OUT)
        still = torch.where(late, 1.0, self.jitter).unsqueeze(-1)
        few = (torch.rand(n, 1, generator=g) < 0.05).double()
        for event in self.events:
            size = 10.0 ** float(6.0 * torch.rand((), generator=g))
            if event == "input stands still":
                x[:, 3:] = 0.3 * normal(n, 1) * still
            elif event == "output stands still":
                y = y * still
            elif event == "all stands still":
                x, y = x * still, y * still
            elif event == "steps of x":
                x = x + size * late.unsqueeze(-1)
            elif event == "steps of y":
                y = y + size * late.unsqueeze(-1)
            elif event == "y shrinks":
                y = torch.where(late.unsqueeze(-1), y / size, y)
            elif event == "y grows":
                y = torch.where(late.unsqueeze(-1), y * size, y)
            elif event == "outliers of x":
                x = x * (1.0 + size * few)
            elif event == "outliers of y":
                y = y * (1.0 + size * few)
            elif event == "duplicates":
                x[n // 4 : n // 2] = x[n // 4]
            elif event == "a constant input":
                x[:, 1] = self.jitter
            elif event == "equal inputs":
                x[:, 2:] = x[:, :1] + self.jitter * x[:, 2:]
        return (x + self.origin) * self.x_unit, y * self.y_unit


def drawn(seed: int, n: int) -> Hostile:
    """The stream of a seed."""
    g = torch.Generator().manual_seed(seed)

    def within(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=g))

    events = torch.randperm(len(EVENTS), generator=g)[: 1 + seed % 2].tolist()
    origin = (0.0, within(-1e3, 1e3))[seed % 3 == 0]
    units = 10.0 ** within(-9.0, 9.0), 10.0 ** within(-9.0, 9.0)
    return Hostile(seed, n, *units, origin, 10.0 ** within(-15.0, -2.0), tuple(EVENTS[e] for e in events))


class Verdict(NamedTuple):
    """What a learner said on a stream: answers that are not finite, largest |g| over the largest |y| seen."""

    not_finite: int
    ratio: float


def judge(learner: ResidualLearner, x: Tensor, y: Tensor) -> Verdict:
    """Ask for everything before each update, then learn."""
    most, spread, ratio, wrong = torch.zeros(OUT, dtype=torch.float64), x.std(0), 0.0, 0
    for t in range(len(x)):
        far = x[t] + spread * 10.0 ** (t % 7 - 1)
        batch = torch.stack([x[t], x[t - 1], far])
        said = [*learner.linearize(x[t]), *learner.linearize(batch), learner.predict(far).stddev]
        law = learner.predict(x[t], observation=True)
        said += [law.mean, law.stddev, learner(batch), learner.predict(batch).stddev]
        wrong += not all(bool(value.isfinite().all()) for value in said)
        mean = torch.cat([said[0].unsqueeze(0), said[2], said[-2], said[5].unsqueeze(0)]).abs().amax(0)
        over = torch.where(mean > 0, mean / most, 0.0)  # before the first sample g is 0
        ratio = max(ratio, float(over.nan_to_num(math.inf).max()))
        learner.update(x[t], y[t])
        most = torch.maximum(most, y[t].abs())
    return Verdict(wrong, ratio)


def table(seeds: Sequence[int], n: int, capacity: int) -> None:
    """Each learner over all streams, and a last line over all learners."""
    print("| learner | not finite | largest &#124;g&#124;/&#124;y&#124; | on |\n|---|---|---|---|")
    found: list[Verdict] = []
    for name, make in LEARNERS.items():
        verdicts = [judge(make(capacity), *drawn(seed, n).samples()) for seed in seeds]
        worst = max(range(len(seeds)), key=lambda i: (verdicts[i].not_finite, verdicts[i].ratio))
        not_finite, events = sum(v.not_finite for v in verdicts), ", ".join(drawn(seeds[worst], n).events)
        print(f"| {name} | {not_finite} | {verdicts[worst].ratio:.2f} | {events} |", flush=True)
        found += verdicts
    print(
        f"\nstreams {len(seeds)}, learners {len(LEARNERS)}, NaN {sum(v.not_finite for v in found)}, "
        f"largest |g|/|y| {max(v.ratio for v in found):.2f}"
    )


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=parse_seeds, default=tuple(range(40)), help="FIRST:END")
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    if options.quick:
        table(options.seeds[:1], 20, 8)
    else:
        table(options.seeds, 240, 100)


if __name__ == "__main__":
    main()
