"""What a user waits for: update and prediction of the default learner, a motion of the E-KM, the start; and
what a sample costs as the basis grows.

``speed.py`` prints the table, ``--out DIR`` writes a report with the picture; ``--quick`` shows that it runs.
One thread. A motion is all that the loop does between two readings: linearize, decide, guard, learn (the box
turned by the simulated iCub hand, the simulator's time taken out); most of it is decision and learning.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).with_name("learners")))

from bench_learners import PlainC, all_of, alternately, filled, gpytorch_fantasy, river_forest, samples, timed

from torch_ekm import EnhancedModel, default_learner, warm_up
from torch_ekm.control import ClosedLoop, LookAndMoveController, PoseTarget
from torch_ekm.experiments.reporting.plots import new_figure, save_figure
from torch_ekm.experiments.reporting.report import Column, Report, Table
from torch_ekm.model import KinematicModel
from torch_ekm.plant import Observation
from torch_ekm.plant.plant import PlantWrapper
from torch_ekm.simulation import SimulatedHand
from torch_ekm.typing import Tensor

IN, OUT = 20, 6  # of the learner
FLEET = "update of a fleet, a model"
FIRST = """import time
begin = time.perf_counter()
import torch
torch_there = time.perf_counter()
import torch_ekm
there = time.perf_counter()
learner = torch_ekm.default_learner(20, 6)
made = time.perf_counter()
learner.update(torch.zeros(20), torch.zeros(6))
print(there - torch_there, time.perf_counter() - made)"""


@dataclass
class Speed:
    """Seconds of single calls by what was called, and microseconds of a sample by basis size."""

    times: dict[str, list[float]] = field(default_factory=dict)
    sizes: Sequence[int] = ()
    costs: dict[str, list[float]] = field(default_factory=dict)
    plain: dict[str, float] = field(default_factory=dict)
    """Microseconds of plain C, 100 points."""

    @property
    def verdict(self) -> str:
        motion, update = (np.array(self.times[name]) for name in ("motion", "update"))
        late, slow = 1e3 * np.quantile(motion, 0.99), 1e6 * np.quantile(update, 0.99)
        slopes, fleet = (1e6 * np.median(self.times[name]) for name in ("prediction with Jacobians", FLEET))
        c, c_slopes = self.plain["update"], self.plain["predict"]
        return (
            f"motion {1e3 * np.median(motion):.2f} ms (99 % {late:.2f}), "
            f"cold start {np.median(self.times['first update, fresh installation']):.2f} s, "
            f"linearize {1e3 * np.median(self.times['linearize']):.2f} ms, "
            f"default update {1e6 * np.median(update):.0f} us median, 99 % {slow:.0f} us; "
            f"Jacobians {slopes:.0f} us; fleet {fleet:.0f} us "
            f"({1e6 * np.median(update) / c:.0f}, {slow / c:.0f} and {slopes / c_slopes:.0f} times plain C)"
        )

    def table(self) -> Table:
        """Median, mean and 99 % quantile of each."""
        columns = ["what", *(Column(name, ".3f") for name in ("median [ms]", "mean [ms]", "99 % [ms]"))]
        rows = [
            [name, *(1e3 * float(v) for v in (np.median(t), np.mean(t), np.quantile(t, 0.99)))]
            for name, t in self.times.items()
        ]
        note = (
            f"Default learner of {IN} inputs and {OUT} outputs, each sample predicted before it is learned."
        )
        return Table("speed", "Times that a user notices", columns, rows, note)

    def picture(self):
        """Cost of a sample against the size of the basis."""
        figure, (axes,) = new_figure(5.0, 3.2)
        for name, microseconds in self.costs.items():
            axes.plot(self.sizes, microseconds, marker="o", label=name)
        axes.set(
            xscale="log",
            yscale="log",
            xlabel="basis vectors (river: samples seen)",
            ylabel="update and prediction [us]",
        )
        axes.legend(ncols=2, loc="center", bbox_to_anchor=(0.5, 0.58))  # off the lines
        return figure

    def report(self, folder: Path) -> None:
        caption = (
            f"Update with one sample, then a prediction; {IN} inputs, {OUT} outputs. Medians of one run, in"
            " turns; plain C, which predicts with Jacobians: the fastest of five series."
        )
        shown = save_figure(self.picture(), folder, "speed", caption)
        Report("Speed", f"{self.verdict}.", [self.table()], [shown]).write(folder)


def of_learner(n: int) -> dict[str, list[float]]:
    """The default learner on a stream, units and kernels settled for a third of it."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(n, IN, generator=generator, dtype=torch.float64)
    y = torch.sin(x @ torch.randn(IN, OUT, generator=generator, dtype=torch.float64) / 3)
    y = y + 0.1 * torch.randn(n, OUT, generator=generator, dtype=torch.float64)
    g = default_learner(IN, OUT)
    times: dict[str, list[float]] = {"update": [], "prediction": [], "prediction with Jacobians": []}
    for i in range(n):
        each = [
            timed(lambda i=i: g.predict(x[i])),
            timed(lambda i=i: g.predict_with_jacobians(x[i] + 0.01)),
            timed(lambda i=i: g(x[i])),  # an update finds what was predicted last
            timed(lambda i=i: g.update(x[i], y[i])),
        ]
        if i >= n // 3:
            for name, seconds in zip(times, (each[3], each[0], each[1]), strict=True):
                times[name].append(seconds)
    return times


def of_fleet(models: int) -> dict[str, list[float]]:
    """A fleet of default learners of 30 points, time of one model, all that falls due included."""
    shape = (models,)
    learn = all_of(default_learner(IN, OUT, batch_shape=shape, capacity=30), OUT, shape, 32)
    for _ in range(2):  # the bases are full then
        learn()
    return {FLEET: [timed(learn) / (32 * models) for _ in range(3)]}


class Clocked(PlantWrapper):
    """Adds up the seconds of its plant."""

    seconds = 0.0

    def observe(self) -> Observation:
        begin = time.perf_counter()
        seen = self.plant.observe()
        self.seconds += time.perf_counter() - begin
        return seen

    def command(self, delta_a: Tensor) -> Observation:
        begin = time.perf_counter()
        seen = self.plant.command(delta_a)
        self.seconds += time.perf_counter() - begin
        return seen


def of_motions(turns: Sequence[float]) -> dict[str, list[float]]:
    """An E-KM turns the box to and fro."""
    plant = Clocked(SimulatedHand("icub_right", "box", preset="nominal"))
    seen = plant.reset(seed=0)
    model = KinematicModel(plant.hand, plant.object)
    ekm = EnhancedModel.for_grasp(model, seen.state)
    loop = ClosedLoop(plant, LookAndMoveController(ekm, focus=plant.rotation_axis))
    times: dict[str, list[float]] = {"motion": [], "decision and learning": [], "linearize": []}
    for degrees in turns:
        target = PoseTarget.turned(seen.state, plant.rotation_axis, degrees=degrees)
        begin, before = time.perf_counter(), plant.seconds
        for step in loop.steps(target):
            times["motion"].append(time.perf_counter() - begin - (plant.seconds - before))
            times["decision and learning"].append(step.seconds)
            times["linearize"].append(timed(lambda: model.linearize(seen.state)))
            begin, before = time.perf_counter(), plant.seconds
    plant.close()
    return times


def of_start(environment: dict[str, str], name: str) -> dict[str, list[float]]:
    """Import and first update of a new process."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", FIRST],
        env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    imported, first = map(float, done.stdout.split())
    return {"import, torch apart": [imported], f"first update, {name}": [first]}


def by_size(sizes: Sequence[int], rounds: int, budget: float) -> dict[str, list[float]]:
    """Microseconds of an update and a prediction, by size of the basis."""
    costs: dict[str, list[float]] = {name: [] for name in ("torch_ekm", "plain C", "GPyTorch", "river")}
    for capacity in sizes:
        makes = {"GPyTorch": gpytorch_fantasy, "river": river_forest}
        calls = {name: make(capacity, OUT) for name, make in makes.items()}
        calls["torch_ekm"] = samples(filled(capacity, OUT), OUT)
        limit = PlainC(capacity, OUT)
        costs["plain C"].append(limit.microseconds("update") + limit.microseconds("predict"))
        for name, microseconds in alternately(calls, rounds, budget).items():
            costs[name].append(microseconds)
    return costs


def measure(quick: bool) -> Speed:
    """All of it, in one run."""
    warm_up()
    times = of_learner(90 if quick else 1500)
    times |= of_fleet(4 if quick else 256)
    limit = PlainC(100, OUT)
    plain = {name: limit.microseconds(name) for name in ("update", "predict")}
    times |= of_motions([3.0] if quick else [15.0, -15.0, 10.0, -20.0, 20.0])
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as cache:
        # a quick run takes the loops that are there: to compile them is long
        environment = dict(os.environ) if quick else {**os.environ, "NUMBA_CACHE_DIR": cache}
        times |= of_start(environment, "fresh installation")
        if not quick:
            warm = "import torch_ekm; torch_ekm.warm_up()"
            subprocess.run([sys.executable, "-c", warm], env=environment, check=True)
        times |= of_start(environment, "fresh process")
    sizes = (10, 20) if quick else (10, 30, 100, 300)
    return Speed(times, sizes, by_size(sizes, 1 if quick else 3, 0.01 if quick else 0.3), plain)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, help="folder of a report")
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    speed = measure(options.quick)
    if options.out is not None:
        speed.report(options.out)
    print(Report("", "", [speed.table()]).markdown(level=0))
    print(speed.verdict)


if __name__ == "__main__":
    main()
