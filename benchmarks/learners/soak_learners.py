"""Does the learner survive a long smooth trajectory? ``soak_learners.py --samples 1000000``

A 100 Hz trajectory that stands still at times, so samples repeat exactly; its system jumps every 1e5 samples,
and one sample in a thousand is an outlier of a hundred times the noise. Reports, over the whole run:
whether all was finite, the smallest variance, the largest difference between the carried state and one
rebuilt from the natural form, the condition of the basis, and the process' memory.
"""

from __future__ import annotations

import argparse
import copy
import resource
import time

import torch

from torch_ekm.residual import SparseOnlineGP, SquaredExponential

_BLOCK = 5_003  # samples between looks: no divisor of the trajectory's periods


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=100_000)
    samples = parser.parse_args().samples
    torch.set_num_threads(1)
    kernel = SquaredExponential(4, lengthscale=1.0)
    gp = SparseOnlineGP(4, 2, capacity=30, kernel=kernel, noise_variance=1e-4, parts=(), standardize=False)
    drift, smallest, begin, errors = 0.0, float("inf"), time.perf_counter(), []
    for start in range(0, samples, _BLOCK):
        x, y = trajectory(start, min(_BLOCK, samples - start))
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
        f"{samples} samples, {gp.capacity} points: finite, smallest variance {smallest:.2e}, "
        f"largest drift {drift:.1e}, condition {float(torch.linalg.cond(gp.posterior.gram(gp.kernel))):.1e}, "
        f"{memory:.0f} MB, {(time.perf_counter() - begin) / samples * 1e6:.0f} us per sample, "
        f"rms of the next {_BLOCK} samples {first:.4f} in the first quarter, {last:.4f} in the last"
    )


if __name__ == "__main__":
    main()
