"""Recordings of one's own hand for a learner: which columns are state, command, observation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from ...exceptions import DescriptionError, ShapeError
from ...typing import Array, Float, Tensor
from .stream import LEAST, Stream, in_own_units
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


@dataclass(frozen=True)
class OwnRecording:
    """Motions of a recording: ``y = o(t + 1) - o(t) - f(s(t), u(t))``, from each row to the next.

    Attributes:
        name: of the file.
        x: state and command ``(n, d)``, in the recording's units.
        y: what the model left over ``(n, m)``, in the units of the observation.
        about: what it is, and what "the model alone" predicts.
        outputs: the observed columns.
        notes: which rows are left out and why, and what was found of clocks.
    """

    name: str
    x: Float[Tensor, "n d"]
    y: Float[Tensor, "n m"]
    about: str
    outputs: tuple[str, ...] = ()
    notes: str = ""

    def stream(self, limit: int | None = None) -> Stream:
        """For :func:`compare`: the first ``limit`` motions (None: all), in units of their first tenth.

        That (20 to 200 samples) is not scored. Only x is centred: 0 is what the model says.
        """
        x, y = self.x.numpy(), self.y.numpy()
        found = in_own_units(self.name, x, y, self.about, limit, outputs=self.outputs, centre_y=False, ddof=1)
        return replace(found, notes=self.notes)


def load_own(
    path: str | Path,
    columns: Columns,
    model: Model | None = None,
    *,
    clock: str | None = None,
) -> OwnRecording:
    """Motions from CSV, Parquet, or a recording of ROS (MCAP, sqlite3, .bag).

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
    return OwnRecording(path.stem, x, y, about, tuple(outputs), notes)
