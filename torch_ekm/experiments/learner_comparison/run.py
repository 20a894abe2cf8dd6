"""Which learner for which stream: predict, score, update."""

from __future__ import annotations

import hashlib
import pickle
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from ..._recorded import describe
from ...exceptions import MissingExtraError, NoStateError, ParameterError, ShapeError
from ...residual import ResidualLearner
from ...typing import Array
from ..jobs import run_jobs
from ..learners import COMPARED, Factory, learner_factory
from .prequential import run_prequential
from .recordings import LIMIT, load_recording
from .report import ComparisonReport
from .scores import Score, block_bootstrap, blocks_of
from .stream import LEAST, Stream


def compare(
    data: str | Path | Stream | Sequence[str | Path | Stream],
    learners: Mapping[str, Factory] | Sequence[str] | None = None,
    *,
    targets: Sequence[str] = (),
    inputs: Sequence[str] = (),
    predicted: Sequence[str] = (),
    observation: Sequence[str] = (),
    run: str = "",
    clock: str | None = None,
    limit: int | None = LIMIT,
    folder: str | Path | None = None,
    processes: int = 1,
    on_done: Callable[[str], None] | None = None,
) -> ComparisonReport:
    """Every learner goes once through every stream: it predicts each sample, is scored, then learns it.

    ``print(report)`` shows the scores, ``report.scores`` and ``report.errors`` hold them as numbers, and
    ``report.write(folder)`` leaves tables, figures and a page.

    Args:
        data: CSV or Parquet files, recordings of ROS, names of public ones (see ``torch-ekm compare
            --help``), streams; of different names.
        learners: name -> ``factory(in_features, out_features)``, lambdas and classes of a notebook included;
            or names of the package's own. By default all of these but those of other libraries.
        targets: columns of the files to predict; ``y``, ``y1``, ``y2``, ..., if none is named. For these 0 is
            the model alone; for others, without ``predicted``, the mean of their first tenth.
        inputs: columns of the files to predict from; all others if none is named.
        predicted: columns with what the model says of the targets, which are then what was measured.
        observation: in place of targets: columns whose increments are predicted, as :func:`load_own` does;
            from ``inputs``, or from themselves if none is named.
        run: a column with one number or text in each run; learners get ``new_sequence()`` between them.
        clock: the topic whose messages set the rows, in a recording of ROS.
        limit: only the first so many samples of a file or recording; None: all.
        folder: keeps what is finished, so that an interrupted comparison continues where it stopped. A result
            is read again if the samples are the same, and a learner of that name is made with the same
            arguments and says the same of the first 40 samples. A change of code that shows later only is
            not noticed: use another folder.
        processes: how many at once (timings are then those of a busy machine).
        on_done: called with each finished job's name.

    Raises:
        UnknownNameError: no such learner or recording; the message lists them.
        ParameterError: nothing to compare, two streams of one name, or a factory that does not make a
            learner of the stream's sizes; the message names it. Nothing has run.
        ShapeError: a stream is too short to distinguish learners.
        DescriptionError: a file cannot be used; the message names line and column.
    """
    factories = _factories(learners)
    data = [data] if isinstance(data, str | Path | Stream) else list(data)
    columns = {"targets": targets, "inputs": inputs, "predicted": predicted, "run": run, "clock": clock}
    streams = [
        one if isinstance(one, Stream) else load_recording(one, limit, observation, **columns) for one in data
    ]
    names = [stream.name for stream in streams]
    if not names or not factories:
        raise ParameterError("data, learners", (names, list(factories)), "at least one of each")
    if len(set(names)) < len(names):
        raise ParameterError("data", names, "of different names")
    jobs, keys = {}, {}
    for stream in streams:
        if len(stream) < LEAST:
            raise ShapeError(f"stream '{stream.name}'", f"(n >= {LEAST}, ...)", stream.y.shape, "too short")
        for name, factory in factories.items():
            job = _job_name(stream, name, _made(name, factory, stream))
            jobs[job], keys[job] = (stream, factory), (stream, name)
    with TemporaryDirectory() as temporary:
        results = run_jobs(run_one, jobs, Path(folder or temporary), processes, on_done)
    scores, errors = {}, {}
    for job, result in results.items():
        stream, name = keys[job]
        squared, alone = np.array(result.pop("squared")), _squared(stream.y[stream.warm_up :])
        errors[stream.name, name] = squared
        blocks = blocks_of(stream)
        rms = block_bootstrap(squared, alone, blocks)
        median = block_bootstrap(squared, alone, blocks, measure="median")
        scores[stream.name, name] = Score(stream.name, name, rms, median, **result)
    return ComparisonReport(tuple(streams), tuple(factories), scores, errors)


def run_one(stream: Stream, factory: Factory) -> dict[str, Any]:
    """One job: plain figures that JSON can hold."""
    with repeatable():
        model = factory(stream.x.shape[1], stream.y.shape[1])
        run = run_prequential(model, stream.x, stream.y, stream.segments)
    start = stream.warm_up
    error = run.error[start:]
    medians = error.abs().quantile(0.5, dim=0)
    return {
        "squared": [float(f"{value:.6g}") for value in _squared(error)],
        "of_outputs": {"rms": error.square().mean(0).sqrt().tolist(), "median": medians.tolist()},
        "nll": run.nll(start),
        "coverage": float(run.coverage(start).mean()),
        "microseconds": 1e6 * run.seconds / len(stream),
        "kilobytes": _kilobytes(model),
    }


@contextmanager
def repeatable() -> Iterator[None]:
    """One thread, and random numbers from the seed 0; afterwards both are as they were."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # small matrices: more threads only wait for each other
    try:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            yield
    finally:
        torch.set_num_threads(threads)


def _factories(learners: Mapping[str, Factory] | Sequence[str] | None) -> dict[str, Factory]:
    if isinstance(learners, Mapping):
        return dict(learners)
    names = (learners,) if isinstance(learners, str) else COMPARED if learners is None else learners
    if not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
        raise ParameterError("learners", learners, "names, or {name: factory(in_features, out_features)}")
    return {name: learner_factory(name) for name in names}


def _made(name: str, factory: Factory, stream: Stream) -> ResidualLearner:
    """A learner as it begins, of the sizes of the stream; whatever else comes is refused by name."""
    d, m = stream.x.shape[1], stream.y.shape[1]
    if isinstance(factory, ResidualLearner):
        raise ParameterError(f"learners[{name!r}]", factory, f"a factory, such as {type(factory).__name__}")
    valid = f"a factory (in_features, out_features) -> ResidualLearner; called with ({d}, {m}) it "
    try:
        with repeatable():
            learner = factory(d, m)
    except MissingExtraError:
        raise
    except Exception as error:
        problem = f"raised {type(error).__name__}: {error}"
        raise ParameterError(f"learners[{name!r}]", factory, valid + problem) from error
    if not isinstance(learner, ResidualLearner):
        raise ParameterError(f"learners[{name!r}]", factory, f"{valid}returned a {type(learner).__name__}")
    sizes = learner.in_features, learner.out_features, tuple(learner.batch_shape)
    if sizes != (d, m, ()):
        problem = f"returned one of {sizes[0]} inputs, {sizes[1]} outputs and batch_shape {sizes[2]}"
        raise ParameterError(f"learners[{name!r}]", factory, valid + problem)
    return learner


def _job_name(stream: Stream, name: str, learner: ResidualLearner) -> str:
    """Named after what decides the result: samples, arguments, and what the learner does at first."""
    made_with = describe(learner)
    with repeatable():
        first = run_prequential(learner, stream.x[:LEAST], stream.y[:LEAST], stream.segments)
    said = [f"{value:.6g}" for value in torch.cat([first.mean, first.deviation]).flatten().tolist()]
    decides = hashlib.sha256(
        repr((name, stream.warm_up, stream.segments, made_with, said, "of_outputs")).encode()
    )
    for values in (stream.x, stream.y):
        decides.update(values.detach().cpu().numpy().tobytes())
    return re.sub(r"[^\w.+-]", "-", f"{stream.name}_{decides.hexdigest()[:8]}_{name}")


def _squared(error: torch.Tensor) -> Array:
    return error.square().mean(-1).double().numpy()


def _kilobytes(model: torch.nn.Module) -> float:
    try:
        tensors = [value for value in model.state_dict().values() if isinstance(value, torch.Tensor)]
    except NoStateError:  # what it keeps are objects
        return len(pickle.dumps(model)) / 1024
    return sum(value.numel() * value.element_size() for value in tensors) / 1024
