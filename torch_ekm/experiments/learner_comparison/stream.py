"""Streams, on which learners are compared: samples in the order of time, from tables and recordings."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...exceptions import DescriptionError, ParameterError, ShapeError
from ...typing import Array, Float, Tensor
from .table_file import Reader, find_columns, open_table

_REST = 0.01  # of the deviation in all: less is rest
LEAST = 40  #: samples; fewer do not distinguish learners

#: How names of columns say that they hold what a model predicts, and what was measured.
_UNIT = r"(?=$| *[\[(])"
_PREDICTS = re.compile(
    rf"^(model|pred|predicted|nominal|sim)[_ ]|[_ ](model|pred|predicted|nominal|sim|hat){_UNIT}",
    re.IGNORECASE,
)
_MEASURED = re.compile(rf"^(meas|measured|real|true)[_ ]|[_ ](meas|measured|real|true){_UNIT}", re.IGNORECASE)


@dataclass(frozen=True)
class Stream:
    """Samples ``y_t = g(x_t) + noise`` in the order of time.

    Attributes:
        name: a word.
        x: inputs ``(n, d)``, of the order of 1.
        y: what the model at hand leaves over ``(n, m)``, of the order of 1; 0 is the model itself.
        warm_up: first samples that are learned but not scored: they gave the units.
        segments: lengths of parts that stand for themselves (objects, grasps, runs).
        about: what it is, and what "the model alone" predicts.
        available: samples of the file or recording, of which these are the first; 0: nobody counted.
        notes: what the user should look at, such as a clock among the inputs.
        outputs: names of the columns of y, and
        unit: what 1 is in each, in the units of the file; empty: unknown, or they are those of the file.

    Raises:
        ShapeError: lengths do not fit.
    """

    name: str
    x: Float[Tensor, "n d"]
    y: Float[Tensor, "n m"]
    warm_up: int = 0
    segments: tuple[int, ...] = ()
    about: str = ""
    available: int = 0
    notes: str = ""
    outputs: tuple[str, ...] = ()
    unit: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        n = len(self.y)
        if len(self.x) != n:
            raise ShapeError("x", f"({n}, d)", self.x.shape, "one input for each output")
        if self.segments and sum(self.segments) != n:
            raise ShapeError("segments", f"lengths that add up to {n}", self.segments)
        m, known = self.y.shape[1], (len(self.outputs), len(self.unit))
        if known not in ((0, 0), (m, 0), (m, m)):
            raise ShapeError("outputs, unit", f"{m} of each", known)

    def __len__(self) -> int:
        return len(self.y)

    @property
    def used(self) -> str:
        """How many samples of how many, in words."""
        n, rows = len(self), max(self.available, len(self))
        return f"all {n} rows" if rows == n else f"the first {n} of {rows} rows"

    def stream(self, limit: int | None = None, *, centre: bool = False) -> Stream:
        """The same in units of its first tenth (20 to 200 samples), which is then not scored.

        Nothing of what is scored is seen beforehand, but the unit of what rests in that tenth, which is that
        of the whole stream. A constant input stays 0.

        Args:
            limit: only the first so many samples; None: all.
            centre: y is centred, too; else it is only scaled, so that 0 is still what the model says.
        """
        x, y = (part[:limit].double().numpy() for part in (self.x, self.y))
        warm_up = min(max(len(x) // 10, 20), 200)

        def units(values: Array, centred: bool) -> tuple[Tensor, Array]:
            start = values[:warm_up]
            deviation, whole = start.std(0), values.std(0)
            moves = deviation > np.maximum(_REST * whole, 1e-9 * np.abs(values).max(0))
            deviation = np.where(moves, deviation, whole)
            unit = np.where(deviation > 0, deviation, 1.0)
            return torch.from_numpy((values - start.mean(0) if centred else values) / unit), unit

        (inputs, _), (targets, unit) = units(x, True), units(y, centre)
        unit = tuple(unit.tolist()) if self.outputs else ()
        return replace(self, x=inputs, y=targets, warm_up=warm_up, available=len(self), unit=unit)


def load_table(
    path: str | Path,
    targets: Sequence[str] = (),
    limit: int | None = None,
    inputs: Sequence[str] = (),
    *,
    predicted: Sequence[str] = (),
    run: str = "",
    clock: str | None = None,
) -> Stream:
    """A stream from a CSV or Parquet file, see ``table_file.open_table``.

    Args:
        path: the file; rows in the order of time.
        targets: columns to predict; those called ``y``, ``y1``, ``y2``, ... if none is named. These are
            residuals: 0 is the model alone; for others without ``predicted``, their mean at first.
        limit: only the first so many rows.
        inputs: columns to predict from; all others if none is named.
        predicted: what the model says of each target: y is target - predicted, and 0 is the model alone.
        run: a column with one number or text in each run.
        clock: the topic whose messages set the rows, in a recording of ROS.

    Raises:
        DescriptionError: the file cannot be used; the message names line and column. No target is named,
            and no column is called ``y``. A column is both input and target.
        UnknownNameError: there is no such column; the message lists the columns.
        ParameterError: not one prediction for each target, hardly two rows of a run, or a recording of ROS
            without ``clock``.
    """
    names, read = open_table(Path(path), clock, run)
    wanted = inputs, targets, predicted, [run] if run else []
    chosen, outputs, model, runs = (find_columns(columns, names) for columns in wanted)
    if model and len(model) != len(outputs):
        raise ParameterError("predicted", model, f"one for each measured column; {len(outputs)} are named")
    outputs = outputs or [name for name in names if _is_residual(name)]
    if not outputs:
        problem = "no column is called 'y' (or y1, y2, ...); name the targets: targets=, or --targets"
        raise DescriptionError(path, f"{problem}{_proposed(names)}. The columns are {', '.join(names)}")
    chosen = chosen or [name for name in names if name not in {*outputs, *model, *runs}]
    if not chosen:
        raise DescriptionError(path, "all columns are targets; at least one must be an input")
    if both := [name for name in chosen if name in outputs]:
        raise DescriptionError(path, f"column '{both[0]}' cannot be both input and target")
    (x, measured, said, number), _, notes = _together(read, [chosen, outputs, model, runs])
    y = measured - (said if model else 0.0)
    if len(x) < LEAST:
        raise DescriptionError(
            path, f"it has {len(x)} samples; at least {LEAST} are needed to compare.{notes}"
        )
    zero_is_model = bool(model) or all(map(_is_residual, outputs))
    alone = ", ".join(model) if model else "0" if zero_is_model else "the mean of the first tenth"
    about = f"{', '.join(outputs)} from {len(chosen)} columns of {Path(path).name}; alone: {alone}"
    borders = np.diff(np.pad(number[:limit].sum(1), 1, constant_values=np.nan))  # zeros without runs
    parts = np.diff(np.flatnonzero(borders)).tolist()
    if runs and 3 * len(parts) > len(x[:limit]):
        raise ParameterError("run", runs[0], "a column that is the same in all rows of a run")
    if clocks := [name for name, column in zip(chosen, x.T, strict=True) if _is_clock(column, len(parts))]:
        notes += f" Like a clock or the number of a row, to be left out: {', '.join(clocks)}."
    if numbers := [name for name, column in zip(chosen, x.T, strict=True) if _is_number_of_run(column)]:
        notes += f" Like the number of a run: {', '.join(numbers)}; name it by --run (run=), or leave it out."
    names = [f"{one} - {other}" for one, other in zip(outputs, model, strict=True)] if model else outputs
    x, y = torch.from_numpy(x), torch.from_numpy(y)
    stream = Stream(Path(path).stem, x, y, about=about, notes=notes, outputs=tuple(names))
    return replace(stream.stream(limit, centre=not zero_is_model), segments=tuple(parts) if runs else ())


def _together(read: Reader, groups: Sequence[Sequence[str]]) -> tuple[list[Array], NDArray[Any], str]:
    """The columns of each group, read at once, so that holes are counted in all of them; parts, and notes."""
    rows = read([name for one in groups for name in one])
    ends = np.cumsum([len(one) for one in groups[:-1]])
    return np.split(rows.values, ends, axis=1), rows.part, rows.about


def _is_clock(column: Array, n_runs: int) -> bool:
    """It grows, but for the starts of the runs, or for starts at one and the same value."""
    starts = np.flatnonzero(np.diff(column) <= 0) + 1
    again = 10 * len(starts) <= len(column) and bool((column[starts] == column[0]).all())
    return again or len(starts) < n_runs


def _is_number_of_run(column: Array) -> bool:
    """Whole numbers that never fall, and rise twice or more (a switch does once), but rarely."""
    step = np.diff(column)
    rises = np.count_nonzero(step)
    return bool((step >= 0).all() and (column == np.rint(column)).all() and 10 < 10 * rises < len(column))


def _is_residual(name: str) -> bool:
    return name == "y" or (name[:1] == "y" and name[1:].isdigit())


def _proposed(names: Sequence[str]) -> str:
    """Options for columns whose names say that one is measured and another predicts it."""
    plain = {_PREDICTS.sub("", name): name for name in names if _PREDICTS.search(name)}
    pairs = [
        (one, plain[what])
        for one in names
        if (what := _MEASURED.sub("", one)) in plain and one != plain[what]
    ]
    if not pairs:
        return ""
    measured, predicted = (shlex.quote(",".join(side)) for side in zip(*pairs, strict=True))
    return f"; these look like pairs: --measured {measured} --predicted {predicted}"


#: ``f(state, command) -> increment of the observation`` of all motions at once, ``(n, .)`` each.
Model = Callable[[Array, Array], Array]


@dataclass(frozen=True)
class Columns:
    """Names of columns, or their beginnings with ``*`` at the end, such as ``/joint_states.position*``.

    Attributes:
        state: what is known before a motion.
        command: what is asked of the motors, as a rate or an increment.
        observation: what is to be predicted: its increment over the motion.
    """

    state: Sequence[str]
    command: Sequence[str]
    observation: Sequence[str]


def load_own(
    path: str | Path,
    columns: Columns,
    model: Model | None = None,
    *,
    clock: str | None = None,
) -> Stream:
    """Motions from CSV, Parquet, or a recording of ROS (MCAP, sqlite3, .bag), in the units of the file.

    From each row to the next, ``y = o(t + 1) - o(t) - f(s(t), u(t))``; x holds state and command. Its
    :meth:`Stream.stream` is what learners are compared on.

    Args:
        path: the file, or the folder of rosbag2; rows in the order of time. No motion goes over a row that
            is left out, or from one run into another.
        columns: which column is what.
        model: f; None: nothing moves.
        clock: in a recording of ROS, the topic whose messages set the rows, such as that of the commands.

    Raises:
        DescriptionError: the file cannot be used or is too short.
        UnknownNameError: a column or topic is not there; the message lists them.
        ParameterError: ``clock`` does not fit.
        ShapeError: the model's increments have another shape than the observation.
    """
    path = Path(path)
    names, read = open_table(path, clock)
    groups = [find_columns(wanted, names) for wanted in vars(columns).values()]
    (known, commanded, seen), part, notes = _together(read, groups)
    starts = np.flatnonzero(part[1:] == part[:-1])  # no motion from one part into another
    if len(starts) < LEAST:
        raise DescriptionError(path, f"it has {len(starts)} motions; at least {LEAST} are needed.{notes}")
    s, u, moved = known[starts], commanded[starts], seen[starts + 1] - seen[starts]
    nominal = np.zeros_like(moved) if model is None else np.asarray(model(s, u), dtype=np.float64)
    if nominal.shape != moved.shape:
        hint = f"f gets all rows: state {s.shape}, command {u.shape}"
        raise ShapeError("increments of the model", str(moved.shape), nominal.shape, hint)
    alone = "nothing moves" if model is None else getattr(model, "__name__", type(model).__name__)
    outputs = tuple(groups[-1])
    about = f"increments of {len(outputs)} columns of {path.name}; alone: {alone}"
    x, y = torch.from_numpy(np.hstack([s, u])), torch.from_numpy(moved - nominal)
    return Stream(path.stem, x, y, about=about, notes=notes, outputs=outputs)
