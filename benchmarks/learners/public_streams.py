"""Public records of streaming regression: ours compared with what was published, and the peers run again.

    TORCH_EKM_DATA=../shared/data python benchmarks/learners/public_streams.py

Protocols are those of the libraries. river's regression track: river's own ``progressive_val_score``; a
prediction of None, before the first sample, is not scored (river's forest does the same). CapyMOA's
prequential evaluation on Fried: predict, score, learn; the first prediction is 0 and is scored, as that of
MOA's learners. ``--quick`` runs the first samples only.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))
from dots import dot_chart

from torch_ekm import default_learner
from torch_ekm.experiments.reporting.plots import save_figure
from torch_ekm.experiments.reporting.report import Cell, Column, Report, Table
from torch_ekm.interop import OnlineRegressor, as_river
from torch_ekm.residual import LearnHyperparameters, RobustWeight, SparseOnlineGP, Standardize
from torch_ekm.typing import Array

SEED = 1000


def plain(d: int, m: int) -> SparseOnlineGP:
    """A sparse online GP with parts of docs/how_to/choose_a_learner.md."""
    return SparseOnlineGP(d, m, parts=[RobustWeight(3.0), Standardize(), LearnHyperparameters()])


# targets are nobody's residual: their mean is learned
OURS = {"default": partial(default_learner, output_offset="learned"), "SOGP, adaptation": plain}


@dataclass(frozen=True)
class Row:
    """What was measured here, or published; ``width``: mean of the 95 % intervals' over the range of y."""

    stream: str
    method: str
    rmse: float | None
    source: str = "here"
    coverage: float | None = None
    width: float | None = None
    samples: int = 0
    mae: float | None = None
    milliseconds: float | None = None


_TRACK = "river, docs/benchmarks/Regression/index.md"
_REGRESSION, _INTERVALS = "CapyMOA, tutorial on regression", "CapyMOA, tutorial on prediction intervals"
PUBLISHED = (
    Row("TrumpApproval", "Aggregated Mondrian forest (best)", 0.349421, _TRACK),
    Row("TrumpApproval", "k nearest neighbours", 1.59417, _TRACK),
    Row("ChickWeights", "Bagging of adaptive Hoeffding trees (best)", 36.6311, _TRACK),
    Row("ChickWeights", "Aggregated Mondrian forest", 41.7123, _TRACK),
    Row("Fried, first 1000", "kNN (best)", 3.03, _REGRESSION),
    Row("Fried, first 1000", "SGBR", 3.09, _REGRESSION),
    Row("Fried, first 1000", "SOKNL", 3.35, _REGRESSION),
    Row("Fried", "kNN (best)", 2.72, _REGRESSION),
    Row("Fried", "ARF", 3.31, _REGRESSION),
    Row("Fried", "AdaPI", None, _INTERVALS, 0.963, 0.274),
    Row("Fried", "MVE", None, _INTERVALS, 0.974, 0.296),
)
_COLUMNS = (
    "method", Column("MAE", ".4g"), Column("RMSE", ".4g"), Column("95 %: share [%]", ".1f", percent=True),
    Column("width [%]", ".1f", percent=True), Column("time [ms]"), "source",
)  # fmt: skip
STREAMS = ("TrumpApproval", "ChickWeights", "Fried, first 1000", "Fried")


def track(name: str, method: str, model: Any, limit: int | None) -> Row:
    """A river model on a data set of river's regression track, by river's own evaluation."""
    from river import datasets, evaluate, metrics

    data = getattr(datasets, name)()
    data = list(data)[:limit]
    begin = time.perf_counter()
    scores: Any = evaluate.progressive_val_score(data, model, metrics.MAE() + metrics.RMSE())
    milliseconds = 1e3 * (time.perf_counter() - begin) / len(data)
    mae, rmse = (score.get() for score in scores)
    return Row(name, method, rmse, samples=len(data), mae=mae, milliseconds=milliseconds)


def river_peers() -> dict[str, Callable[[], Any]]:
    """Those of the published table that lead on one of the two sets."""
    from river import ensemble, forest, preprocessing, tree

    def bagging() -> Any:
        model = tree.HoeffdingAdaptiveTreeRegressor(bootstrap_sampling=False)
        return preprocessing.StandardScaler() | ensemble.BaggingRegressor(model=model, seed=42)

    return {
        "Aggregated Mondrian forest, again": lambda: forest.AMFRegressor(seed=42),
        "Bagging, again": bagging,
    }


def fried(method: str, factory: Callable, x: Array, y: Array) -> Iterator[Row]:
    """The first 1000 samples and all of them, in one pass."""
    model = OnlineRegressor(factory(x.shape[1], 1))
    ends, begin = np.zeros((len(y), 2)), time.perf_counter()
    for t in range(len(y)):
        if t:
            ends[t] = np.ravel(model.interval(x[t : t + 1], 0.95))
        model.learn(x[t], y[t : t + 1])
        if t + 1 in (1000, len(y)):
            low, high = ends[: t + 1].T
            error, milliseconds = y[: t + 1] - (low + high) / 2, 1e3 * (time.perf_counter() - begin) / (t + 1)
            held, width = (low <= y[: t + 1]) & (y[: t + 1] <= high), (high - low).mean() / np.ptp(y[: t + 1])
            name = "Fried, first 1000" if t + 1 == 1000 else "Fried"
            rms, mae = math.sqrt(np.square(error).mean()), np.abs(error).mean()
            yield Row(name, method, rms, "here", held.mean(), width, t + 1, mae, milliseconds)


def measure(data: Path | None, limit: int | None) -> Iterator[Row]:
    """All rows, as they are ready."""
    for name in ("TrumpApproval", "ChickWeights"):
        for method, factory in OURS.items():
            torch.manual_seed(SEED)
            yield track(name, method, as_river(factory), limit)
        for method, peer in river_peers().items():
            yield track(name, method, peer(), limit)
    if data is None:
        return
    values = np.loadtxt(data / "capymoa" / "fried.csv.gz", delimiter=",", skiprows=1, max_rows=limit)
    x, y = values[:, :-1], values[:, -1]
    for method, factory in OURS.items():
        torch.manual_seed(SEED)
        yield from fried(method, factory, x, y)


def tables(rows: list[Row]) -> list[Table]:
    """A table for each stream, ours next to what was published."""
    found = []
    for stream in STREAMS:
        mine = [row for row in rows if row.stream == stream]
        cells: list[list[Cell]] = []
        for row in (*mine, *(one for one in PUBLISHED if one.stream == stream)):
            name = f"**{row.method}**" if row.method in OURS else row.method
            name += "" if row.source == "here" else ", published"
            cells.append([name, row.mae, row.rmse, row.coverage, row.width, row.milliseconds, row.source])
        if mine:
            name, caption = stream.replace(",", "").replace(" ", "_"), f"{stream} ({mine[0].samples} samples)"
            found.append(Table(name, caption, _COLUMNS, cells))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("public_streams_output"))
    parser.add_argument("--quick", action="store_true", help="the first 150 samples of each stream")
    options = parser.parse_args()
    torch.set_num_threads(1)
    data = os.environ.get("TORCH_EKM_DATA")
    rows = []
    for row in measure(Path(data) if data else None, 150 if options.quick else None):
        print(row, file=sys.stderr, flush=True)
        rows.append(row)
    summary = (
        f"Errors are those of each sample before it is learned; seed {SEED}. Share of samples in the 95 % "
        'interval, and its mean width over the range of y. "again": the peer, run on the same machine. Time '
        "of a sample, one thread."
    )
    caption = "RMSE of each sample before it is learned. Blue: this package; grey: other libraries."
    found = tables(rows)
    figure = dot_chart(found, ["RMSE"], "RMSE", shared=False)
    shown = save_figure(figure, options.out, "public_streams", caption)
    report = Report("Public streams", summary, found, [shown])
    report.write(options.out)
    print(report.markdown())


if __name__ == "__main__":
    main()
