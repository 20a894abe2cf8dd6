"""Does the learner survive a long smooth trajectory? ``benchmarks/soak_learners.py --samples 1000000``

A 100 Hz trajectory that stands still at times, so samples repeat exactly. Reports, over the whole run:
whether all was finite, the smallest variance, the largest difference between the carried state and one
rebuilt from the natural form, the condition of the basis, and the process' memory.

``--deep``: the same of a deep kernel that adapts all the time, with its error in the first and last
quarter against that of the plain SOGP with adaptation: features must not collapse.
"""

from __future__ import annotations

import argparse
import copy
import resource
import time

import torch

from torch_ekm.residual import DeepKernelSOGP, LearnHyperparameters, SparseOnlineGP, SquaredExponential


def trajectory(start: int, n: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Samples ``start`` to ``start + n`` of the trajectory."""
    t = torch.arange(start, start + n, dtype=torch.float64) / 100.0
    t = torch.where((t % 10) < 1, t - t % 10, t)
    parts = [torch.sin(0.3 * t), torch.sin(0.41 * t + 1), torch.cos(0.17 * t), torch.sin(0.07 * t)]
    x = torch.stack(parts, -1)
    return x, torch.stack([torch.sin(2 * x[:, 0] + x[:, 1]), x[:, 2] * x[:, 3]], -1)


def make(options: argparse.Namespace, deep: bool) -> SparseOnlineGP:
    """The learner under test."""
    dtype = torch.float32 if options.float32 else torch.float64
    common = {"capacity": options.capacity, "dtype": dtype, "standardize": False}
    if options.deep:
        if deep:
            return DeepKernelSOGP(4, 2, base=SquaredExponential(4), parts=(), **common)
        return SparseOnlineGP(4, 2, kernel=SquaredExponential(4), parts=[LearnHyperparameters()], **common)
    kernel = SquaredExponential(4, lengthscale=1.0)
    return SparseOnlineGP(4, 2, kernel=kernel, noise_variance=1e-4, parts=(), **common)


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
        smallest = min(smallest, float(gp.variance(query).min()))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    quarter = max(len(errors) // 4, 1)
    first, last = (sum(part) / quarter for part in (errors[:quarter], errors[-quarter:]))
    print(
        f"{type(gp.kernel).__name__}, {samples} samples, {gp.dtype}, {gp.capacity} points: finite, "
        f"smallest variance {smallest:.2e}, largest drift {drift:.1e}, "
        f"condition {float(gp.condition_number):.1e}, {memory:.0f} MB, "
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
    options = parser.parse_args()
    torch.set_num_threads(1)
    for deep in (True, False) if options.deep else (False,):
        soak(make(options, deep), options.samples)


if __name__ == "__main__":
    main()
