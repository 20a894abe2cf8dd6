"""Speed of the learners: tables of everything measured in one run, with its ratios.

Twenty inputs, one thread, float64, a full basis with a point added and one pruned at every sample. Plain C,
compiled on the spot, is the limit. What is compared takes turns.
"""

from __future__ import annotations

import argparse
import ctypes
import itertools
import math
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torch_ekm.experiments.reporting.report import Column, Report, Table
from torch_ekm.residual import SparseOnlineGP, SquaredExponential, default_learner

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
        gp.engine = None
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


def samples(learner: Any, m: int) -> Timed:
    """An update with a sample, then a prediction."""
    return Timed(lambda x, y: (learner.update(x, y), learner.predict(x + 0.1)), *stream(64, m))


def pointer(a: np.ndarray) -> ctypes.c_void_p:
    return a.ctypes.data_as(ctypes.c_void_p)  # keeps the array


class PlainC:
    """The textbook recursion in C, whose samples are pointers to rows."""

    def __init__(self, capacity: int, m: int) -> None:
        compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
        if compiler is None:
            raise SystemExit("no C compiler: cc, gcc or clang")
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
        p, self.noise = gp.posterior, ctypes.c_double(float(gp.noise_variance[0]))
        self.free = int(p.slot)
        self.X[:], self.alpha[:] = p.basis.numpy(), p.alpha.numpy()
        self.C[:], self.Q[:] = p.covariance.numpy(), p.moments[1].numpy()
        self.gp = gp
        self.mean, self.jac, self.slope = np.zeros(m), np.zeros((m, D)), np.zeros(D)
        # made once, since ctypes costs more than the work
        self._state = [pointer(a) for a in (self.X, self.C, self.Q, self.alpha)]
        self._w, self._work = pointer(self.w), pointer(self.work)
        self._out = [pointer(a) for a in (self.mean, self.jac, self.slope)]

    def update(self, x: ctypes.c_void_p, y: ctypes.c_void_p) -> None:
        self.free = self.lib.update(
            self.n, D, self.m, *self._state, self.free, x, y, self._w, self.noise, self._work
        )

    def predict(self, x: ctypes.c_void_p) -> float:
        X, C, _, alpha = self._state
        return self.lib.predict(self.n, D, self.m, X, C, alpha, self.free, x, self._w, *self._out, self._work)

    def microseconds(self, which: str, repeats: int = 300) -> float:
        """Of a call, the fastest of five series."""
        x, y = (pointer(a.numpy()[0]) for a in stream(1, self.m))
        call, given = (self.update, (x, y)) if which == "update" else (self.predict, (x,))
        series = (timed(lambda: [call(*given) for _ in range(repeats)]) for _ in range(5))
        return min(series) / repeats * 1e6


def gpytorch_fantasy(capacity: int, m: int) -> Callable:
    """One sample as a fantasy of an exact GP, then a prediction: GPyTorch's constant-kernel update."""
    import gpytorch

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


def river_forest(capacity: int, m: int) -> Callable:
    """An update and a prediction of river's adaptive random forest, one per output."""
    from torch_ekm.interop import RiverResidual

    learner = RiverResidual(D, m)
    learner.update(*stream(capacity, m))
    return samples(learner, m)


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


def timed(call: Callable) -> float:
    """Seconds of one call."""
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


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


#: Compiled loops where they can, or torch alone.
ENGINES = ("auto", "torch")


def table(title: str, columns: str, rows: list[Any]) -> Table:
    """Names and numbers."""
    name, *others = columns.split(" | ")
    return Table(title, title, [name, *(Column(other, ".1f") for other in others)], rows)


def against_c() -> Table:
    """An update, and a prediction with Jacobians, in C and by each engine in turns."""
    rows = []
    for b, m in ((30, 6), (100, 6), (300, 6), (100, 26)):
        reference = PlainC(b, m)
        for what, make in (("update", updates), ("predict", predictions)):
            calls = [make(filled(b, m, engine=name), m) for name in ENGINES]
            rounds = np.array(
                [
                    [reference.microseconds(what), *(microseconds(call, 0.3) for call in calls)]
                    for _ in range(5)
                ]
            )
            ratios = np.median(rounds[:, 1:] / rounds[:, :1], axis=0)
            rows.append((f"{what}, {b} points, {m} outputs", *np.median(rounds, axis=0), *ratios))
    columns = "what | plain C [us] | compiled [us] | torch [us] | compiled : C | torch : C"
    return table("A sparse online GP beside plain C", columns, rows)


def of_fleets() -> Table:
    """256 models at once, time of one."""
    rows, shape, m = [], (256,), 6
    for b in (30, 100):
        fleets = [filled(b, m, shape, name) for name in ENGINES]
        for what, make in (("update", updates), ("predict", predictions)):
            calls = dict(zip(ENGINES, (make(gp, m, shape) for gp in fleets), strict=True))
            found = alternately(calls, rounds=3)
            rows.append((f"{what}, {b} points", *(us / 256 for us in found.values())))
        means = [1e6 * timed(all_of(gp, m, shape, 64)) / (64 * 256) for gp in fleets]
        rows.append((f"update, {b} points, mean with rebuilds", *means))
    default = all_of(default_learner(D, m, batch_shape=shape), m, shape, 64)
    for _ in range(2):  # the bases are full then
        default()
    mean = 1e6 * timed(default) / (64 * 256)
    rows.append(("default learner, update, mean", mean, math.nan))
    return table("Fleets of 256, per model", "what | compiled [us] | torch [us]", rows)


def main() -> None:
    argparse.ArgumentParser(description=__doc__).parse_args()
    torch.set_num_threads(1)
    for measure in (against_c, of_fleets):
        print(Report("", "", [measure()]).markdown(level=2), flush=True)


if __name__ == "__main__":
    main()
