"""Streams on which the default learner is measured: made here, and recordings where they are at hand."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch

from torch_ekm.exceptions import EKMError
from torch_ekm.experiments.learner_comparison.recordings import load_recording
from torch_ekm.typing import Tensor

#: Real hands, a radio channel, series, regression sets: see ``torch-ekm compare --help``.
RECORDINGS = (
    "t42", "icub_grasp", "mimo", "lorenz", "mackey_glass", "santafe", "sarcos", "kin40k", "powerplant",
)  # fmt: skip


class Samples(NamedTuple):
    """x ``(n, d)``, y ``(n, m)`` and, where the noise is known, what y is without it."""

    x: Tensor
    y: Tensor
    clean: Tensor


def smooth(n: int, seed: int) -> Samples:
    """Two sines of random directions in four inputs."""
    g = torch.Generator().manual_seed(seed)
    w = torch.randn(4, 2, generator=g, dtype=torch.float64)
    x = torch.randn(n, 4, generator=g, dtype=torch.float64)
    f = torch.sin(x @ w)
    f = f / f.std(0)
    return Samples(x, f + 0.1 * torch.randn(n, 2, generator=g, dtype=torch.float64), f)


def friedman(n: int, seed: int) -> Samples:
    """Friedman's function of five of ten inputs (Annals of Statistics 19, 1991) without its mean."""
    g = torch.Generator().manual_seed(seed)
    x = torch.rand(n, 10, generator=g, dtype=torch.float64)
    f = 10 * torch.sin(math.pi * x[:, 0] * x[:, 1]) + 20 * (x[:, 2] - 0.5) ** 2 + 10 * x[:, 3] + 5 * x[:, 4]
    f = f.unsqueeze(-1) - 14.4
    return Samples(x, f + torch.randn(n, 1, generator=g, dtype=torch.float64), f)


def wide_and_noisy(n: int, seed: int) -> Samples:
    """32 inputs of which three matter; noise as large as the signal."""
    g = torch.Generator().manual_seed(seed)
    x = torch.randn(n, 32, generator=g, dtype=torch.float64)
    f = torch.sin(x[:, :1]) + 0.7 * x[:, 1:2] * x[:, 2:3]
    f = f / f.std()
    return Samples(x, f + torch.randn(n, 1, generator=g, dtype=torch.float64), f)


def pure_noise(n: int, seed: int) -> Samples:
    """Nothing to learn."""
    g = torch.Generator().manual_seed(seed)
    x = torch.randn(n, 5, generator=g, dtype=torch.float64)
    y = torch.randn(n, 2, generator=g, dtype=torch.float64)
    return Samples(x, y, y)


def jumping(n: int, seed: int, at: int = 400) -> Samples:
    """The system shifts by three standard deviations after ``at`` samples."""
    x, y, f = smooth(n, seed)
    shift = torch.zeros(n, 1, dtype=torch.float64)
    shift[at:] = 3.0
    return Samples(x, y + shift, f + shift)


def there_and_back(n: int, seed: int) -> Samples:
    """Two systems of four inputs; from 4/9 to 8/9 of the samples it is the second one."""
    g = torch.Generator().manual_seed(seed)
    first, second = 0.7 * torch.randn(2, 4, 2, generator=g, dtype=torch.float64)
    x = torch.randn(n, 4, generator=g, dtype=torch.float64)
    t = torch.arange(n).unsqueeze(-1)
    f = torch.where((t >= 4 * n // 9) & (t < 8 * n // 9), torch.sin(x @ second), torch.sin(x @ first))
    return Samples(x, f + 0.05 * torch.randn(n, 2, generator=g, dtype=torch.float64), f)


def noisy_side(n: int, seed: int) -> Samples:
    """A sine whose noise grows from 0.08 to 0.71 along the input."""
    g = torch.Generator().manual_seed(seed)
    x = 2.0 * torch.rand(n, 1, generator=g, dtype=torch.float64) - 1.0
    f, noise = torch.sin(3.0 * x), 0.08 + 0.63 * (x + 1.0) / 2.0
    return Samples(x, f + noise * torch.randn(n, 1, generator=g, dtype=torch.float64), f)


def with_outliers(n: int, seed: int) -> Samples:
    """A tenth of y lies 30 standard deviations off."""
    x, y, f = smooth(n, seed)
    g = torch.Generator().manual_seed(seed + 10_000)
    hit = torch.rand(n, 1, generator=g) < 0.1
    return Samples(x, y + 30.0 * torch.randn(n, 2, generator=g, dtype=torch.float64).sign() * hit, f)


def from_rest(n: int, seed: int, rest: int = 300) -> Samples:
    """It stands still for ``rest`` samples, then moves by millimetres, in metres."""
    g = torch.Generator().manual_seed(seed)
    moved = (0.01 * (torch.arange(n, dtype=torch.float64) - rest)).clamp_min(0.0).unsqueeze(-1)
    w, phase = (1.0 + 3.0 * torch.rand(4, generator=g, dtype=torch.float64) for _ in range(2))
    x = torch.sin(w * moved + phase) - torch.sin(phase)
    y = torch.sin(2.0 * x @ torch.randn(4, 2, generator=g, dtype=torch.float64))
    return Samples(1e-3 * x, 1e-4 * y, 1e-4 * y)


def arm(n: int, seed: int) -> Samples:
    """Torques of a two-link arm at 100 Hz that a model with other masses and no friction leaves over.

    x holds joint angles and speeds [rad, rad/s]; accelerations are not given. Masses 1.2 and 0.9 kg, in the
    model 1.0 and 0.7; links of 1 and 0.8 m with their masses at the ends; Coulomb and viscous friction.
    """
    g = torch.Generator().manual_seed(seed)

    def draw(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(4, 1, 2, generator=g, dtype=torch.float64)

    t = torch.arange(n, dtype=torch.float64).unsqueeze(-1) / 100.0
    size, omega, phase = draw(0.1, 0.5), 2 * math.pi * draw(0.05, 0.65), draw(0.0, 6.28)
    q = (size * torch.sin(omega * t + phase)).sum(0)
    v = (size * omega * torch.cos(omega * t + phase)).sum(0)
    a = -(size * omega**2 * torch.sin(omega * t + phase)).sum(0)

    def torque(m1: float, m2: float) -> Tensor:
        l1, l2, gravity = 1.0, 0.8, 9.81
        cos, sin = q[:, 1].cos(), q[:, 1].sin()
        coupling = m2 * l1 * l2
        m11, m22 = (m1 + m2) * l1**2 + m2 * l2**2 + 2 * coupling * cos, m2 * l2**2
        m12 = m22 + coupling * cos
        g2 = m2 * gravity * l2 * (q[:, 0] + q[:, 1]).cos()
        g1 = (m1 + m2) * gravity * l1 * q[:, 0].cos() + g2
        first = m11 * a[:, 0] + m12 * a[:, 1] - coupling * sin * (2 * v[:, 0] + v[:, 1]) * v[:, 1] + g1
        second = m12 * a[:, 0] + m22 * a[:, 1] + coupling * sin * v[:, 0] ** 2 + g2
        return torch.stack([first, second], dim=1)

    f = torque(1.2, 0.9) - torque(1.0, 0.7) + 0.8 * torch.tanh(v / 0.05) + 0.3 * v
    noise = 0.002 * f.std(0) * torch.randn(n, 2, generator=g, dtype=torch.float64)
    return Samples(torch.cat([q, v], dim=1), f + noise, f)


MADE = {
    "smooth": smooth, "friedman": friedman, "wide and noisy": wide_and_noisy, "from rest": from_rest,
    "arm": arm, "pure noise": pure_noise,
}  # fmt: skip


def streams(n: int, seeds: Sequence[int]) -> dict[str, list[Samples]]:
    """Those made here, and the recordings that are at hand: one of each seed, or one that depends on none."""
    found = {name: [make(n, seed) for seed in seeds] for name, make in MADE.items()}
    for name in RECORDINGS:
        try:
            one = load_recording(name, n)
        except EKMError:
            continue
        x, y, orders = one.x.double(), one.y.double(), [torch.arange(len(one.x))]
        if name in ("sarcos", "kin40k", "powerplant"):  # files are sorted in ways of their own
            orders = [torch.randperm(len(x), generator=torch.Generator().manual_seed(seed)) for seed in seeds]
        found[name] = [Samples(x[order], y[order], y[order]) for order in orders]
    return found
