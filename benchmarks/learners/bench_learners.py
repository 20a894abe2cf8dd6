"""Speed of the learners: ``pytest bench_learners.py``, or ``python bench_learners.py``
for a table of everything measured in one run with its ratios.

Twenty inputs, one thread, float64, a full basis with a point added and one pruned at every sample. Plain C,
compiled on the spot, is the limit; GPyTorch, scikit-learn and river take part where they are installed. What
is compared takes turns.
"""

from __future__ import annotations

import argparse
import ctypes
import functools
import importlib.util
import itertools
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from torch_ekm.residual import (
    CalibrateNoise,
    DeepKernel,
    DeepKernelSOGP,
    DetectChanges,
    ForgettingFactor,
    LearnHyperparameters,
    RobustWeight,
    SparseOnlineGP,
    SquaredExponential,
    Standardize,
    default_learner,
)
from torch_ekm.residual.sparse_gp.engine import recursion
from torch_ekm.residual.sparse_gp.engine.reference import ReferenceEngine

D = 20
SOURCE = Path(__file__).with_name("sogp_learners_reference.c")


def stream(n: int, m: int, shape: tuple[int, ...] = (), seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(n, *shape, D, generator=generator, dtype=torch.float64)
    y = torch.randn(n, *shape, m, generator=generator, dtype=torch.float64)
    return x, y


def as_published(shape: tuple[int, ...] = ()) -> dict[str, Any]:
    """What the reference in C does: x and y as they are, and no part."""
    return {"kernel": SquaredExponential(D, batch_shape=shape), "parts": (), "standardize": False}


def filled(
    capacity: int, m: int, shape: tuple[int, ...] = (), engine: str = "auto", **options
) -> SparseOnlineGP:
    options = {**as_published(shape), **options}
    gp = SparseOnlineGP(D, m, capacity=capacity, batch_shape=shape, **options)
    if engine == "torch":
        gp.engine = ReferenceEngine()
    gp.update(*stream(capacity + 3, m, shape, seed=1))
    return gp


class Timed:
    """Calls in a cycle through samples, so that no call sees what the last one saw."""

    def __init__(self, call: Callable, *arrays) -> None:
        self.call, self.items = call, itertools.cycle(list(zip(*arrays, strict=True)))

    def __call__(self):
        return self.call(*next(self.items))


def updates(gp: SparseOnlineGP, m: int, shape: tuple[int, ...] = ()) -> Timed:
    return Timed(gp.update, *stream(64, m, shape))


def predictions(gp: SparseOnlineGP, m: int, shape: tuple[int, ...] = ()) -> Timed:
    def call(x):
        with torch.no_grad():
            return gp.predict_with_jacobians(x)

    return Timed(call, stream(64, m, shape)[0])


class PlainC:
    """The textbook recursion in C; None if there is no compiler."""

    def __init__(self, capacity: int, m: int) -> None:
        compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
        if compiler is None:
            pytest.skip("no C compiler")
        library = Path(tempfile.mkdtemp()) / "reference.so"
        flags = ["-O3", "-march=native", "-ffast-math", "-fPIC", "-c"]
        subprocess.run([compiler, *flags, str(SOURCE), "-o", f"{library}.o"], check=True)
        # linked with -ffast-math, a library turns subnormal numbers off in the whole process
        subprocess.run([compiler, "-shared", f"{library}.o", "-o", str(library), "-lm"], check=True)
        self.lib = ctypes.CDLL(str(library))
        self.lib.predict.restype = ctypes.c_double
        n, self.m, self.n = capacity + 1, m, capacity + 1
        self.X, self.C, self.Q = np.zeros((n, D)), np.zeros((n, n)), np.zeros((n, n))
        self.alpha, self.work = np.zeros((n, m)), np.zeros(4 * n + m)
        self.w = np.full(D, 1.0 / D)
        # fill it from the learner itself: the same state, so the same work and the same answers
        gp = filled(capacity, m, refresh_every=10**9)
        p = gp.posterior
        self.free = int(p.slot)
        self.X[:], self.alpha[:] = p.basis.numpy(), p.alpha.numpy()
        self.C[:], self.Q[:] = p.covariance.numpy(), p.moments[1].numpy()
        self.gp = gp
        self.mean, self.jac, self.slope = np.zeros(m), np.zeros((m, D)), np.zeros(D)

    @staticmethod
    def _p(a: np.ndarray):
        return a.ctypes.data_as(ctypes.c_void_p)

    def update(self, x: np.ndarray, y: np.ndarray) -> None:
        p = self._p
        self.free = self.lib.update(
            self.n, D, self.m, p(self.X), p(self.C), p(self.Q), p(self.alpha), self.free,
            p(x), p(y), p(self.w), ctypes.c_double(0.01), p(self.work),
        )  # fmt: skip

    def predict(self, x: np.ndarray) -> float:
        p = self._p
        return self.lib.predict(
            self.n, D, self.m, p(self.X), p(self.C), p(self.alpha), self.free, p(x), p(self.w),
            p(self.mean), p(self.jac), p(self.slope), p(self.work),
        )  # fmt: skip

    def microseconds(self, which: str, repeats: int = 300) -> float:
        """Time inside C: the pointers are made once, since ctypes costs more than the work."""
        x, y = (np.ascontiguousarray(a.numpy()) for a in stream(1, self.m))
        p, best = self._p, float("inf")
        state = [p(a) for a in (self.X, self.C, self.Q, self.alpha)]
        px, py, pw, work = p(x[0]), p(y[0]), p(self.w), p(self.work)
        out = [p(self.mean), p(self.jac), p(self.slope)]
        s2 = ctypes.c_double(0.01)
        for _ in range(5):
            begin = time.perf_counter()
            if which == "update":
                for _ in range(repeats):
                    self.free = self.lib.update(self.n, D, self.m, *state, self.free, px, py, pw, s2, work)
            else:
                for _ in range(repeats):
                    self.lib.predict(
                        self.n, D, self.m, state[0], state[1], state[3], self.free, px, pw, *out, work
                    )
            best = min(best, (time.perf_counter() - begin) / repeats * 1e6)
        return best


def gpytorch_fantasy(capacity: int, m: int) -> Callable:
    """One sample as a fantasy of an exact GP, then a prediction: GPyTorch's constant-kernel update."""
    gpytorch = pytest.importorskip("gpytorch")
    x, y = stream(capacity, m)
    shape = torch.Size([m])

    class Model(gpytorch.models.ExactGP):
        def __init__(self, likelihood):
            super().__init__(x.expand(m, -1, -1), y.mT.contiguous(), likelihood)
            self.mean = gpytorch.means.ZeroMean(batch_shape=shape)
            self.kernel = gpytorch.kernels.ScaleKernel(
                gpytorch.kernels.RBFKernel(ard_num_dims=D, batch_shape=shape), batch_shape=shape
            )

        def forward(self, z):
            return gpytorch.distributions.MultivariateNormal(self.mean(z), self.kernel(z))

    likelihood = gpytorch.likelihoods.GaussianLikelihood(batch_shape=shape).double()
    model = Model(likelihood).double().eval()
    likelihood.eval()
    new_x, new_y = stream(64, m, seed=2)
    with torch.no_grad():
        model(new_x[:1].expand(m, 1, D))

    def call(a, b):
        with torch.no_grad(), gpytorch.settings.fast_pred_var():
            fantasy = model.get_fantasy_model(a.expand(m, 1, D), b.reshape(m, 1))
            law = fantasy(a.expand(m, 1, D) + 0.1)
            return law.mean, law.variance

    return Timed(call, new_x, new_y)


def gpytorch_svgp(capacity: int, m: int) -> Callable:
    """One variational step on one sample."""
    pytest.importorskip("gpytorch")
    from gpytorch_svgp import GPyTorchSVGP

    return Timed(GPyTorchSVGP(D, m, inducing=capacity).update, *stream(64, m))


def sklearn_refit(capacity: int, m: int) -> Callable:
    """scikit-learn has no update: a fit on the window, hyperparameters fixed."""
    gp = pytest.importorskip("sklearn.gaussian_process")
    kernel = gp.kernels.RBF(D**0.5) + gp.kernels.WhiteKernel(0.01)
    x, y = (a.numpy() for a in stream(capacity, m))
    model = gp.GaussianProcessRegressor(kernel, optimizer=None)
    return lambda: model.fit(x, y).predict(x[:1], return_std=True)


def river_forest(capacity: int, m: int) -> Callable:
    """river's adaptive random forest, one per output."""
    pytest.importorskip("river")
    from torch_ekm.interop import RiverResidual

    learner = RiverResidual(D, m)
    learner.update(*stream(capacity, m))
    return Timed(learner.update, *stream(64, m))


PEERS = {
    "gpytorch fantasy + predict": gpytorch_fantasy,
    "gpytorch SVGP step": gpytorch_svgp,
    "scikit-learn refit + predict": sklearn_refit,
    "river ARF update": river_forest,
}


@pytest.fixture(autouse=True)
def _one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.parametrize("m", [6, 26])
@pytest.mark.parametrize("capacity", [30, 100, 300])
@pytest.mark.parametrize("what", ["update", "predict"])
def test_one_model(benchmark, what, capacity, m):
    gp = filled(capacity, m)
    benchmark(updates(gp, m) if what == "update" else predictions(gp, m))


@pytest.mark.parametrize("capacity", [30, 100])
@pytest.mark.parametrize("what", ["update", "predict"])
def test_fleet_of_256(benchmark, what, capacity):
    gp = filled(capacity, 6, (256,))
    call = updates(gp, 6, (256,)) if what == "update" else predictions(gp, 6, (256,))
    benchmark.pedantic(call, rounds=5, warmup_rounds=1)


@pytest.mark.parametrize("peer", PEERS)
def test_peers(benchmark, peer):
    call = PEERS[peer](100, 6)
    benchmark.pedantic(call, rounds=10, warmup_rounds=2)


def test_plain_c_gives_the_same_numbers(monkeypatch):
    reference = PlainC(30, 6)
    xs, ys = stream(40, 6, seed=5)
    gp = reference.gp
    # the C code prunes by the loss in the mean, the first term of ours

    def loss_in_the_mean(posterior, c, q, w):
        return posterior.alpha.square().sum(-1) / (c + q)

    monkeypatch.setattr(recursion, "pruning_loss", loss_in_the_mean)
    monkeypatch.setattr(gp, "_loops", None)
    for x, y in zip(xs, ys, strict=True):
        reference.update(np.ascontiguousarray(x.numpy()), np.ascontiguousarray(y.numpy()))
        gp.update(x, y)
    x = xs[0] + 0.1
    v = reference.predict(np.ascontiguousarray(x.numpy()))
    ours = gp.predict_with_jacobians(x)
    np.testing.assert_allclose(reference.mean, ours.mean.numpy(), atol=1e-5)
    np.testing.assert_allclose(reference.jac, ours.mean_jacobian.numpy(), atol=1e-5)
    assert v == pytest.approx(float(ours.variance[0]), abs=1e-5)


# -- the table ------------------------------------------------------------------------------------


def microseconds(call: Callable, budget: float = 0.6) -> float:
    """Median of single calls: robust against other work on the machine."""
    for _ in range(3):
        call()
    times, end = [], time.perf_counter() + budget
    while time.perf_counter() < end or len(times) < 3:
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return float(np.median(times) * 1e6)


def alternately(calls: dict[str, Callable], rounds: int = 5, budget: float = 0.3) -> dict[str, float]:
    """Medians of calls that take turns, so that what else the machine does falls on all of them."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            times[name].append(microseconds(call, budget))
    return {name: float(np.median(each)) for name, each in times.items()}


def all_of(gp: SparseOnlineGP, m: int, shape: tuple[int, ...], n: int) -> Callable:
    """n updates in a row, with the rebuilds and looks at the drift that fall among them."""
    x, y = stream(64, m, shape)
    pairs = itertools.cycle(list(zip(x, y, strict=True)))

    def call() -> None:
        for _ in range(n):
            gp.update(*next(pairs))

    return call


FIRST_CALL = """import time, torch
from torch_ekm.residual import SparseOnlineGP
from torch_ekm.residual.sparse_gp.engine import recursion
from torch_ekm.residual.sparse_gp.engine.reference import ReferenceEngine
gp, begin = SparseOnlineGP(20, 6), time.perf_counter()
gp.update(torch.zeros(20).double(), torch.zeros(6).double())
print(time.perf_counter() - begin)"""


def first_call(cache: Path) -> float:
    """Seconds of the first update in a new process."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    command = [sys.executable, "-c", FIRST_CALL]
    return float(subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout)


#: Compiled loops where they can, or torch alone.
ENGINES = ("auto", "torch")


def against_c(b: int, m: int) -> list[tuple[str, float, float]]:
    """(what, microseconds, times plain C), C and each engine in turns."""
    reference = PlainC(b, m)
    rows = []
    for what, make in (("update", updates), ("predict", predictions)):
        calls = {name: make(filled(b, m, engine=name), m) for name in ENGINES}
        rounds = []
        for _ in range(5):
            limit = reference.microseconds(what)
            rounds.append([limit, *(microseconds(call, 0.3) for call in calls.values())])
        limit, *found = np.median(rounds, axis=0)
        ratios = np.median(np.array(rounds) / np.array(rounds)[:, :1], axis=0)[1:]
        name = "predict + jacobians" if what == "predict" else what
        rows.append((f"{name} b={b} m={m}: plain C", limit, 1.0))
        for label, us, ratio in zip(calls, found, ratios, strict=True):
            rows.append((f"{name} b={b} m={m}: {label}", us, ratio))
    return rows


def table() -> list[tuple[str, float, float]]:
    """(what, microseconds, ratio to the row named in it or nan)."""
    rows: list[tuple[str, float, float]] = []
    for b, m in ((30, 6), (100, 6), (300, 6), (100, 26)):
        rows += against_c(b, m)
    for b in (30, 100):
        shape = (256,)
        fleets = {name: filled(b, 6, shape, name) for name in ENGINES}
        calls: dict[str, Callable] = {}
        for name, gp in fleets.items():
            calls[f"update b={b}, 256 models, per model: {name}"] = updates(gp, 6, shape)
            calls[f"predict b={b}, 256 models, per model: {name}"] = predictions(gp, 6, shape)
        found = alternately(calls, rounds=3)
        rows += [(name, us / 256, math.nan) for name, us in found.items()]
        begin = all_of(fleets["auto"], 6, shape, 256)
        whole = f"update b={b}, 256 models, per model: auto, mean with rebuilds"
        rows.append((whole, microseconds(begin, 0.0) / 256**2, math.nan))
    for learned, parts in (
        ("units", [Standardize()]),
        ("robust, forgets", [RobustWeight(3.0), ForgettingFactor(0.99)]),
        ("calibrated, detects changes", [CalibrateNoise(), DetectChanges()]),
        ("learns its kernel", [LearnHyperparameters()]),
    ):
        gps = {name: filled(100, 6, engine=name, parts=parts) for name in ENGINES}
        calls = {engine: all_of(gp, 6, (), 64) for engine, gp in gps.items()}
        for _ in range(17):  # units stand still after a thousand samples
            [call() for call in calls.values()]
        found = alternately(calls, rounds=3)
        for engine, us in found.items():
            rows.append((f"update b=100 m=6, {learned}, mean: {engine}", us / 64, math.nan))
    for name, make in (("SparseOnlineGP(d, m)", SparseOnlineGP), ("default_learner(d, m)", default_learner)):
        learner, times = make(D, 6), []
        for x, y in zip(*stream(1500, 6, seed=1), strict=True):
            begin = time.perf_counter()
            learner.update(x, y)
            times.append(1e6 * (time.perf_counter() - begin))
        for which, us in (("median", np.median(times[500:])), ("slowest of 1000", max(times[500:]))):
            rows.append((f"update of {name}, m=6, {which}", float(us), math.nan))
    deep = SparseOnlineGP(D, 6, kernel=DeepKernel(SquaredExponential(D))), DeepKernelSOGP(D, 6)
    for gp in deep:
        gp.update(*stream(2110, 6, seed=1))  # a memory is full then
    cost = [microseconds(functools.partial(gp.update, *stream(64, 6)), 2.0) / 64 for gp in deep]
    rows.append(("adaptation of the deep kernel, per sample", cost[1] - cost[0], math.nan))
    for name, make in PEERS.items():
        module = name.split()[0].replace("scikit-learn", "sklearn")
        if importlib.util.find_spec(module) is not None:
            gp = filled(100, 6)
            ours = Timed(lambda x, y, gp=gp: (gp.update(x, y), gp.predict(x + 0.1)), *stream(64, 6))
            found = alternately({"peer": make(100, 6), "ours": ours}, rounds=3)
            rows.append(
                (f"{name} b=100 m=6, over our update + predict", found["peer"], found["peer"] / found["ours"])
            )
    if importlib.util.find_spec("numba") is not None:
        with tempfile.TemporaryDirectory() as cache:
            for which in ("without", "with"):
                name = f"first update of a process, {which} cache [s]"
                rows.append((name, first_call(Path(cache)), math.nan))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, help="write the table as Markdown here")
    options, _ = parser.parse_args(), torch.set_num_threads(1)
    lines = ["| what | us | ratio |", "|---|---|---|"]
    for name, value, ratio in table():
        lines.append(f"| {name} | {value:.1f} | {'' if math.isnan(ratio) else f'{ratio:.1f}'} |")
    text = "\n".join(lines)
    print(text)
    if options.output:
        options.output.write_text(text + "\n")


if __name__ == "__main__":
    main()
