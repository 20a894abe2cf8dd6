"""What learners are compared on: streams in the order of time, each in the units of its own beginning.

Public recordings are read in place from a folder that the user names (``TORCH_EKM_DATA``, see
``datasets.data_folder``); a file of the user's own is CSV or Parquet.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ..._extras import require
from ...exceptions import DescriptionError, ShapeError, UnknownNameError
from ...typing import Float, Tensor
from .datasets import data_folder, load_t42
from .table_file import read_table

Array = NDArray[np.float64]
LEAST = 40  #: samples; fewer cannot tell learners apart
LIMIT = 1500  #: samples of a recording that are used if nobody says otherwise


@dataclass(frozen=True)
class Recording:
    """A stream of samples ``y ~ g(x)``.

    Attributes:
        name: a word.
        x: inputs ``(n, d)``, of the order of 1.
        y: what the model at hand leaves over ``(n, m)``, of the order of 1; 0 is the model itself.
        warm_up: first samples that are learned but not scored: they gave the units.
        segments: lengths of parts that stand for themselves (objects, grasps), for the statistics.
        about: what it is, and what "the model alone" predicts.

    Raises:
        ShapeError: lengths do not fit, or there are fewer than 40 samples.
    """

    name: str
    x: Float[Tensor, "n d"]
    y: Float[Tensor, "n m"]
    warm_up: int = 0
    segments: tuple[int, ...] = ()
    about: str = ""

    def __post_init__(self) -> None:
        n = len(self.y)
        if n < LEAST:
            raise ShapeError(f"recording '{self.name}'", f"(n >= {LEAST}, ...)", self.y.shape, "too short")
        if len(self.x) != n:
            raise ShapeError("x", f"({n}, d)", self.x.shape, "one input for each output")
        if self.segments and sum(self.segments) != n:
            raise ShapeError("segments", f"lengths that add up to {n}", self.segments)

    def __len__(self) -> int:
        return len(self.y)

    def save(self, path: Path) -> Path:
        """Write the samples as CSV: columns ``x1..xd, y1..ym``."""
        names = [f"x{i + 1}" for i in range(self.x.shape[1])] + [f"y{i + 1}" for i in range(self.y.shape[1])]
        with Path(path).open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            writer.writerow(names)
            writer.writerows(torch.cat([self.x, self.y], dim=1).tolist())
        return Path(path)


def load_table(path: str | Path, targets: Sequence[str] = (), limit: int | None = None) -> Recording:
    """A stream from a CSV or Parquet file, see ``table_file.read_table``.

    Args:
        path: the file; rows in the order of time.
        targets: columns to predict. By default those called ``y``, ``y1``, ``y2``, ..., else the last one.
        limit: only the first so many rows.

    Raises:
        DescriptionError: the file cannot be used; the message names line and column.
        UnknownNameError: there is no such target column; the message lists the columns.
    """
    names, values = read_table(Path(path))
    if len(values) < LEAST:
        raise DescriptionError(path, f"it has {len(values)} samples; at least {LEAST} are needed to compare")
    for name in targets:
        if name not in names:
            raise UnknownNameError("column", name, names)
    chosen = list(targets) or [
        name for name in names if name == "y" or (name[:1] == "y" and name[1:].isdigit())
    ]
    columns = [names.index(name) for name in chosen or names[-1:]]
    inputs = [i for i in range(len(names)) if i not in columns]
    if not inputs:
        raise DescriptionError(path, "all columns are targets; at least one must be an input")
    values = values[:limit]
    about = f"{', '.join(names[i] for i in columns)} from {len(inputs)} columns of {Path(path).name}"
    return in_own_units(Path(path).stem, values[:, inputs], values[:, columns], about=about)


def in_own_units(
    name: str, x: Array, y: Array, *, segments: Sequence[int] = (), about: str = "", centre: bool = True
) -> Recording:
    """Standardise by the first tenth of the stream (20 to 200 samples), which is then not scored.

    Nothing of what is scored is seen beforehand. A constant input stays 0.

    Args:
        centre: take the mean of y away; False keeps 0 as the prediction of the model at hand.
    """
    warm_up = min(max(len(x) // 10, 20), 200)

    def units(values: Array, shift: bool) -> Tensor:
        start = values[:warm_up]
        deviation = start.std(0) if shift else np.sqrt(np.square(start).mean(0))
        deviation = np.where(deviation > 1e-9 * np.abs(values).max(0), deviation, values.std(0))
        middle = start.mean(0) if shift else 0.0
        return torch.from_numpy((values - middle) / np.where(deviation > 0, deviation, 1.0))

    return Recording(name, units(x, True), units(y, centre), warm_up, tuple(segments), about)


def list_recordings() -> tuple[str, ...]:
    """Names that :func:`load_recording` knows; all but ``simulated_hand`` need the data folder."""
    return tuple(_READERS)


def load_recording(name: str, root: str | Path | None = None, limit: int | None = LIMIT) -> Recording:
    """A public recording by name, or a file of one's own by path.

    Args:
        name: one of :func:`list_recordings`, or a path.
        root: the data folder; ``TORCH_EKM_DATA`` by default.
        limit: only the first so many samples (of each object alike, where there are many); None: all.

    Raises:
        UnknownNameError: neither a known name nor a file.
        DescriptionError: the folder or the file is missing, or cannot be used.
    """
    if name in _READERS:
        return _READERS[name](root, limit)
    if Path(name).suffix:
        return load_table(name, limit=limit)
    raise UnknownNameError("recording", name, (*_READERS, "a path to a .csv or .parquet file"))


def _simulated(root: str | Path | None, limit: int | None) -> Recording:
    from .simulated_stream import record_simulated_hand

    return record_simulated_hand(min(limit or 400, 400))


def _t42(root: str | Path | None, limit: int | None) -> Recording:
    _need(root, "t42_hand/t42_testpaths.npz")
    objects = load_t42(root)
    share = None if limit is None else max(limit // len(objects), 1)  # of each object, its first samples
    x, y = (torch.cat([getattr(one, part)[:share] for one in objects]).double() for part in "xy")
    about = f"Yale T42 hand moving {len(objects)} objects (Sintov et al.); alone: one constant Jacobian"
    return Recording("t42", x, y, 0, tuple(len(one.x[:share]) for one in objects), about)


def _icub_grasp(root: str | Path | None, limit: int | None) -> Recording:
    """Next increment of the 9 encoders from encoders, last increment and the 5 fingers' touch."""
    folder = _need(root, "icub_grasp/iCubGraspDataset")
    x, y, segments = [], [], []
    for path in sorted(folder.glob("*.txt"), key=_trial):
        if path.name.startswith("full_coke"):  # its authors say not to trust it
            continue
        lines = [line.split() for line in path.read_text(encoding="latin-1").splitlines()[1:] if line.strip()]
        slices = [
            (a, b) for a, b in zip(lines[0::7], lines[1::7], strict=False) if (len(a), len(b)) == (9, 5)
        ]
        if len(slices) < 4:
            continue
        encoders = np.array([a for a, _ in slices], dtype=float)
        touch, step = np.array([b for _, b in slices], dtype=float), np.diff(encoders, axis=0)
        x.append(np.hstack([encoders[1:-1], step[:-1], touch[1:-1]]))
        y.append(step[1:])
        segments.append(len(step) - 1)
        if limit is not None and sum(segments) >= limit:
            break
    about = "iCub hand closing on 10 objects (Soh et al.), 10 deg as unit; alone: nothing moves"
    units = np.repeat([30.0, 10.0, 50.0], [9, 9, 5])  # [deg], [deg], [of 255]
    inputs, outputs = torch.from_numpy(np.vstack(x) / units), torch.from_numpy(np.vstack(y) / 10.0)
    return Recording("icub_grasp", inputs, outputs, 0, tuple(segments), about)


def _trial(path: Path) -> tuple[int, str]:
    """``book_7.txt`` as (7, "book"): all objects once, then all again."""
    name, _, number = path.stem.rpartition("_")
    return int(number), name


def _rows(path: str, name: str, n_out: int, about: str, **options) -> Callable[..., Recording]:
    def read(root: str | Path | None, limit: int | None) -> Recording:
        values = np.loadtxt(_need(root, path), delimiter=",", **options)[:limit]
        return in_own_units(name, values[:, :-n_out], values[:, -n_out:], about=about)

    return read


def _sarcos(root: str | Path | None, limit: int | None) -> Recording:
    table = require("scipy.io").loadmat(str(_need(root, "sarcos/sarcos_inv_test.mat")))
    values = next(v for k, v in table.items() if not k.startswith("__"))[:limit]
    about = "seven torques of the SARCOS arm; alone: their mean"
    return in_own_units("sarcos", values[:, :21], values[:, 21:], about=about)


def _series(path: str, name: str, lags: int, about: str) -> Callable[..., Recording]:
    def read(root: str | Path | None, limit: int | None) -> Recording:
        series = np.loadtxt(_need(root, path))[: None if limit is None else limit + lags]
        x = np.lib.stride_tricks.sliding_window_view(series, lags)[:-1]
        return in_own_units(name, x, series[lags:, None], about=about)

    return read


def _mimo(root: str | Path | None, limit: int | None) -> Recording:
    """Received signal from the last four sent ones, as in the Kernel Adaptive Filtering Toolbox."""
    sent, received = np.loadtxt(_need(root, "streams/mimotestbed8K.dat"), delimiter=",").T
    x = np.lib.stride_tricks.sliding_window_view(sent, 4)[:limit]
    about = "a real 2x2 radio channel that changes (kafbox); alone: the mean"
    return in_own_units("mimo", x, received[3:, None][:limit], about=about)


def _need(root: str | Path | None, path: str) -> Path:
    full = data_folder(root) / path
    if not full.exists():
        raise DescriptionError(full, "the recording is not there; see 'torch-ekm compare --help' for sources")
    return full


_READERS: dict[str, Callable[[str | Path | None, int | None], Recording]] = {
    "simulated_hand": _simulated,
    "t42": _t42,
    "icub_grasp": _icub_grasp,
    "mimo": _mimo,
    "sarcos": _sarcos,
    "kin40k": _rows("uci/kin40k/data.csv.gz", "kin40k", 1, "kinematics of an 8-link arm; alone: the mean"),
    "powerplant": _rows(
        "uci/power-plant.csv", "powerplant", 1, "a power plant's output; alone: the mean", skiprows=1
    ),
    "lorenz": _series("streams/lorenz.dat", "lorenz", 6, "Lorenz attractor, next value; alone: the mean"),
    "mackey_glass": _series(
        "streams/mg30.dat", "mackey_glass", 10, "Mackey-Glass, next value; alone: the mean"
    ),
    "santafe": _series("streams/santafe.dat", "santafe", 10, "Santa Fe laser, next value; alone: the mean"),
}
