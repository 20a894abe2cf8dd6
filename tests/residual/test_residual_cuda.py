"""On a GPU: the same numbers, and no update or prediction waits for the device."""

import pytest
import torch
from as_published import sogp

from torch_ekm.residual import (
    CalibrateNoise,
    DeepKernel,
    ForgettingFactor,
    LearnHyperparameters,
    RecursiveLeastSquares,
    RobustWeight,
    SquaredExponential,
    Standardize,
)

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


def make(name: str, device: str):
    options = {"batch_shape": (16,), "on_invalid": "skip", "device": device}
    if name == "rls":
        return RecursiveLeastSquares(4, 2, forgetting_factor=0.99, robust=3.0, **options)
    options |= {"capacity": 12, "refresh_every": 8}
    parts = [RobustWeight(3.0), ForgettingFactor(0.99)]
    if name == "plain":
        return sogp(4, 2, parts=parts, **options)
    kernel = SquaredExponential(4, batch_shape=(16,), device=device)
    kernel = DeepKernel(kernel, hidden=(8,)) if name == "deep" else kernel
    parts += [CalibrateNoise(), Standardize(), LearnHyperparameters()]
    return sogp(4, 2, kernel=kernel, parts=parts, **options)


@pytest.mark.parametrize("name", ["rls", "plain", "adaptive", "deep"])
def test_no_host_synchronisation_and_the_same_numbers(name):
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(60, 16, 4, generator=generator, dtype=torch.float64)
    y = torch.randn(60, 16, 2, generator=generator, dtype=torch.float64)
    mask = torch.rand(60, 16, generator=generator) < 0.8
    host, device = make(name, "cpu"), make(name, "cuda")
    host.update(x, y, mask)
    xd, yd, md = x.cuda(), y.cuda(), mask.cuda()
    device.update(xd[:10], yd[:10], md[:10])  # libraries initialise themselves
    device.predict(xd[0])
    torch.cuda.synchronize()
    try:
        torch.cuda.set_sync_debug_mode("error")
        for t in range(10, 60):
            device.update(xd[t], yd[t], md[t])
            device.predict(xd[t])
            device.linearize(xd[t])
    finally:
        torch.cuda.set_sync_debug_mode("default")
    torch.testing.assert_close(device(xd[:5]).cpu(), host(x[:5]), atol=1e-7, rtol=1e-7)
