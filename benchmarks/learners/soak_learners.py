"""Does the learner survive a long smooth trajectory? ``soak_learners.py --samples 1000000``

A 100 Hz trajectory that stands still at times, so samples repeat exactly; its system jumps every 1e5 samples,
and one sample in a thousand is an outlier of a hundred times the noise. Reports, over the whole run:
whether all was finite, the smallest variance, the largest difference between the carried state and one
rebuilt from the natural form, the condition of the basis, and the process' memory.

``--compare``: compiled loops and torch side by side, for every option, on inputs drawn at random; the largest
difference of what they predict, in units of the largest target, and that of torch with the last bit of its
targets changed.

``--deep``: the same of a deep kernel that adapts all the time, with its error in the first and last
quarter against that of the plain SOGP with adaptation: features must not collapse.
"""

from __future__ import annotations

import argparse
import copy
import resource
import time
from typing import Any

import torch

from torch_ekm.residual import (
    ActionLinearKernel,
    CalibrateNoise,
    DeepKernel,
    DeepKernelSOGP,
    DetectChanges,
    ForgettingFactor,
    LearnHyperparameters,
    Matern32,
    ProcessNoise,
    RobustWeight,
    SparseOnlineGP,
    SquaredExponential,
    Standardize,
)


def trajectory(start: int, n: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Samples ``start`` to ``start + n`` of the trajectory."""
    t = torch.arange(start, start + n, dtype=torch.float64) / 100.0
    t = torch.where((t % 10) < 1, t - t % 10, t)
    parts = [torch.sin(0.3 * t), torch.sin(0.41 * t + 1), torch.cos(0.17 * t), torch.sin(0.07 * t)]
    x = torch.stack(parts, -1)
    y = torch.stack([torch.sin(2 * x[:, 0] + x[:, 1]), x[:, 2] * x[:, 3]], -1)
    number = torch.arange(start, start + n)
    y += (number // 100_000 % 2).unsqueeze(-1)
    y[number % 1000 == 500] += 1.0
    return x, y


def make(options: argparse.Namespace, deep: bool) -> SparseOnlineGP:
    """The learner under test."""
    dtype = torch.float32 if options.float32 else torch.float64
    common = {"capacity": options.capacity, "dtype": dtype, "standardize": False}
    if options.deep:
        if deep:
            return DeepKernelSOGP(4, 2, base=SquaredExponential(4), parts=(), **common)
        return SparseOnlineGP(4, 2, kernel=SquaredExponential(4), parts=[LearnHyperparameters()], **common)
    kernel = SquaredExponential(4, lengthscale=1.0)
    gp = SparseOnlineGP(4, 2, kernel=kernel, noise_variance=1e-4, parts=(), **common)
    return gp if options.engine == "auto" else by_torch(gp)


def by_torch(gp: SparseOnlineGP) -> SparseOnlineGP:
    """The learner without compiled loops."""
    gp.engine = None
    return gp


#: As published: no parts, no units.
BARE: dict[str, Any] = {"parts": (), "standardize": False}


def options_of_all_kinds() -> dict[str, dict[str, Any]]:
    """What a learner may be made with."""
    kernel = SquaredExponential(4, lengthscale=1.0)
    return {
        "bare": {"kernel": kernel},
        "Matern 3/2": {"kernel": Matern32(4, lengthscale=1.0)},
        "action-linear": {"kernel": ActionLinearKernel(4, 2)},
        "deep": {"kernel": DeepKernel(SquaredExponential(4))},
        "robust, forgets": {"kernel": kernel, "parts": [RobustWeight(3.0), ForgettingFactor(0.99)]},
        "process noise": {"kernel": kernel, "parts": [ProcessNoise(0.003)]},
        "units, calibrated": {"kernel": kernel, "parts": [Standardize(), CalibrateNoise()]},
        "detects changes": {"kernel": kernel, "parts": [DetectChanges()]},
        "learns its kernel": {"kernel": kernel, "parts": [LearnHyperparameters(memory=200)]},
    }


def drawn(start: int, n: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Inputs at random, with rests, outliers and jumps: two computations do not drift apart by themselves."""
    generator = torch.Generator().manual_seed(start)
    x = torch.randn(n, 4, generator=generator, dtype=torch.float64)
    noise = torch.randn(n, 2, generator=generator, dtype=torch.float64)
    x[n // 4 : n // 4 + 50] = x[n // 4].clone()
    y = torch.sin(x[:, :2] + x[:, 2:]) + 0.1 * noise + float(start // n % 2)
    y[::100] += 3.0 * noise[::100]
    return x, y


def compare(samples: int, capacity: int, only: str | None) -> None:
    """Both engines, option by option, and torch once more with the last bit of its targets changed."""
    for name, options in options_of_all_kinds().items():
        if only not in (None, name):
            continue
        trio = [
            SparseOnlineGP(4, 2, capacity=capacity, noise_variance=0.01, **{**BARE, **options})
            for _ in range(3)
        ]
        by_torch(trio[0]), by_torch(trio[2])
        worst, largest, begin = [0.0, 0.0], 0.0, time.perf_counter()
        for start in range(0, samples, 1000):
            x, y = drawn(start, 1000)
            largest = max(largest, float(y.abs().max()))
            for gp, targets in zip(trio, (y, y, torch.nextafter(y, y + 1.0)), strict=True):
                gp.update(x, targets)
            for query in x[::97]:
                exact, *others = (torch.cat([gp(query), gp.predict(query).variance]) for gp in trio)
                worst = [max(w, float((exact - o).abs().max())) for w, o in zip(worst, others, strict=True)]
        loops, rounding = (value / largest for value in worst)
        seconds = time.perf_counter() - begin
        print(f"{name}: {loops:.1e}, last bit {rounding:.1e}; {samples} samples, {seconds:.0f} s", flush=True)


def soak(gp: SparseOnlineGP, samples: int) -> None:
    """Run and report; raises AssertionError as soon as a prediction is not finite."""
    drift, smallest, begin, block = 0.0, float("inf"), time.perf_counter(), 5_003
    errors = []
    for start in range(0, samples, block):
        x, y = (a.to(gp.dtype) for a in trajectory(start, min(block, samples - start)))
        errors.append(float((gp(x) - y).square().mean().sqrt()))
        gp.update(x, y)
        rebuilt = copy.deepcopy(gp)
        rebuilt.refresh()
        query = x[::53]
        assert bool(gp(query).isfinite().all()), f"not finite after {start} samples"
        drift = max(drift, float((gp(query) - rebuilt(query)).abs().max()))
        smallest = min(smallest, float(gp.predict(query).variance.min()))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    quarter = max(len(errors) // 4, 1)
    first, last = (sum(part) / quarter for part in (errors[:quarter], errors[-quarter:]))
    print(
        f"{type(gp.kernel).__name__}, {samples} samples, {gp.dtype}, {gp.capacity} points: finite, "
        f"smallest variance {smallest:.2e}, largest drift {drift:.1e}, "
        f"condition {float(torch.linalg.cond(gp.posterior.gram(gp.kernel))):.1e}, {memory:.0f} MB, "
        f"{(time.perf_counter() - begin) / samples * 1e6:.0f} us per sample, rms of the next "
        f"{block} samples {first:.4f} in the first quarter, {last:.4f} in the last",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=100_000)
    parser.add_argument("--capacity", type=int, default=30)
    parser.add_argument("--float32", action="store_true")
    parser.add_argument("--deep", action="store_true")
    parser.add_argument("--compare", action="store_true")
    parser.add_argument("--only", choices=tuple(options_of_all_kinds()), help="one of the options to compare")
    parser.add_argument("--engine", choices=("auto", "torch"), default="auto")
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.compare:
        return compare(options.samples, options.capacity, options.only)
    for deep in (True, False) if options.deep else (False,):
        soak(make(options, deep), options.samples)


if __name__ == "__main__":
    main()
