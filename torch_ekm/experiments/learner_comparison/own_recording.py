"""Recordings of one's own hand for a learner: which columns are state, command, observation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ...exceptions import DescriptionError, ShapeError
from ...typing import Array
from .stream import LEAST, Stream
from .table_file import find_columns, open_table

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
    roles = columns.state, columns.command, columns.observation
    state, command, outputs = (find_columns(wanted, names) for wanted in roles)
    values, part, notes = read([*state, *command, *outputs])
    known, commanded, seen = np.split(values, np.cumsum([len(state), len(command)]), axis=1)
    starts = np.flatnonzero(part[1:] == part[:-1])  # no motion from one part into another
    if len(starts) < LEAST:
        raise DescriptionError(path, f"it has {len(starts)} motions; at least {LEAST} are needed.{notes}")
    s, u, moved = known[starts], commanded[starts], seen[starts + 1] - seen[starts]
    nominal = np.zeros_like(moved) if model is None else np.asarray(model(s, u), dtype=np.float64)
    if nominal.shape != moved.shape:
        hint = f"f gets all rows: state {s.shape}, command {u.shape}"
        raise ShapeError("increments of the model", str(moved.shape), nominal.shape, hint)
    alone = "nothing moves" if model is None else getattr(model, "__name__", type(model).__name__)
    about = f"increments of {len(outputs)} columns of {path.name}; alone: {alone}"
    x, y = torch.from_numpy(np.hstack([s, u])), torch.from_numpy(moved - nominal)
    return Stream(path.stem, x, y, about=about, notes=notes, outputs=tuple(outputs))
