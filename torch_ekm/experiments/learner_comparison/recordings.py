"""Public recordings by name, read in place from a folder that the user names (``TORCH_EKM_DATA``)."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch

from ..._extras import require
from ...exceptions import DescriptionError, EKMError, ParameterError, UnknownNameError
from ...typing import Array
from .stream import Columns, Stream, load_own, load_table

LIMIT = 1500  #: samples of a recording that are used if nobody says otherwise

_T42 = "t42_hand/t42_testpaths.npz"
_T42_NOMINAL, _T42_SKIPPED = "cyl45_d_v0", "str40_d_v1"
_T42_EXCHANGED = "_red_"  # in the names of recordings whose columns of actions are exchanged
_T42_HORIZON = 10  # [steps] of the log in one sample


def load_recording(
    name: str | Path, limit: int | None = LIMIT, observation: Sequence[str] = (), **columns: Any
) -> Stream:
    """A public recording by name, or a file of one's own by path.

    Args:
        name: ``simulated_hand``, a recording in the folder ``TORCH_EKM_DATA`` (the error lists them), or a
            path.
        limit: only the first so many samples (of each object alike, where there are many); None: all.
        observation: columns of a file of one's own whose increments are predicted, from ``inputs``.
        columns: of such a file, as :func:`load_table` takes them.

    Raises:
        UnknownNameError: neither a known name nor a file.
        DescriptionError: the folder or the file is missing, or cannot be used.
        ParameterError: observation together with targets, predicted or run.
    """
    if name == "simulated_hand":
        from .simulated_stream import record_simulated_hand  # needs the simulator

        return record_simulated_hand(min(limit or 400, 400))
    if name in _READERS:
        try:
            return _READERS[str(name)](limit)
        except EKMError:
            raise
        except (ValueError, LookupError, EOFError, BadZipFile) as error:  # of whatever reads the file
            problem = f"the recording '{name}' there is damaged: {error}"
            raise DescriptionError(os.environ["TORCH_EKM_DATA"], problem) from None
    if observation:
        if other := [key for key in ("targets", "predicted", "run") if columns.get(key)]:
            valid = f"given without {' and '.join(other)}: or write the increments into a column, as targets"
            raise ParameterError("observation", observation, valid)
        which = Columns(columns.get("inputs") or observation, (), observation)
        return load_own(name, which, clock=columns.get("clock")).stream(limit)
    if Path(name).suffix or Path(name).exists() or columns.get("clock"):
        return load_table(name, limit=limit, **columns)
    known = ("simulated_hand", *_READERS, "a path to a file")
    raise UnknownNameError("recording", str(name), known)


def load_t42() -> list[Stream]:
    """The Yale T42 hand (Sintov et al.), a stream for each object; a constant Jacobian is the nominal model.

    ``t42_hand/t42_testpaths.npz`` holds, for each object and path, states ``(n, 13)`` and actions
    ``(n, 2)``. A sample every ten steps: input the state and the mean action over these, output the change
    of (x, y, angle). The red hand's servos are numbered the other way round: its two columns are exchanged,
    so that a column is a finger in all recordings. The Jacobian is the least-squares map from actions to
    outputs on one object, which also gives the units; the other objects follow in alphabetical order.

    Raises:
        DescriptionError: there is no such file.
    """
    file = np.load(_need(_T42))
    samples: dict[str, list[tuple[Array, Array, Array]]] = {}
    for key in sorted(k[:-2] for k in file.files if k.endswith("/S")):
        states, actions = file[key + "/S"], file[key + "/A"]
        if _T42_EXCHANGED in key:
            actions = actions[:, ::-1]
        pose = np.column_stack([states[:, :2], np.unwrap(states[:, 2])])
        starts = np.arange(0, len(states) - _T42_HORIZON, _T42_HORIZON)
        action = np.array([actions[t : t + _T42_HORIZON].mean(0) for t in starts])
        action, change = action.reshape(-1, actions.shape[1]), pose[starts + _T42_HORIZON] - pose[starts]
        samples.setdefault(key.split("/")[0], []).append((states[starts], action, change))
    joined = {name: list(map(np.concatenate, zip(*paths, strict=True))) for name, paths in samples.items()}
    _, action, change = joined[_T42_NOMINAL]
    jacobian = np.linalg.lstsq(action, change, rcond=None)[0]
    pairs = {name: (np.hstack([s, a]), change - a @ jacobian) for name, (s, a, change) in joined.items()}
    inputs, residual = pairs[_T42_NOMINAL]
    mean, deviation, unit = inputs.mean(0), inputs.std(0), residual.std(0)
    return [
        Stream(name, torch.from_numpy((x - mean) / deviation), torch.from_numpy(y / unit))
        for name, (x, y) in sorted(pairs.items())
        if name not in (_T42_NOMINAL, _T42_SKIPPED)
    ]


def _t42(limit: int | None) -> Stream:
    objects = load_t42()
    share = None if limit is None else max(limit // len(objects), 1)  # of each object, its first samples
    x, y = (torch.cat([getattr(one, part)[:share] for one in objects]).double() for part in "xy")
    about = f"Yale T42 hand moving {len(objects)} objects (Sintov et al.); alone: one constant Jacobian"
    parts = tuple(len(one.x[:share]) for one in objects)
    return Stream("t42", x, y, 0, parts, about, sum(map(len, objects)))


def _icub_grasp(limit: int | None) -> Stream:
    """Next increment of the 9 encoders from encoders, last increment and the 5 fingers' touch."""
    folder = _need("icub_grasp/iCubGraspDataset")
    x, y, segments, available = [], [], [], 0
    for path in sorted(folder.glob("*.txt"), key=_trial):
        if path.name.startswith("full_coke"):  # its authors say not to trust it
            continue
        lines = [line.split() for line in path.read_text(encoding="latin-1").splitlines()[1:] if line.strip()]
        pairs = zip(lines[0::7], lines[1::7], strict=False)
        slices = [(a, b) for a, b in pairs if (len(a), len(b)) == (9, 5)]
        if len(slices) < 4:
            continue
        encoders = np.array([a for a, _ in slices], dtype=float)
        touch, step = np.array([b for _, b in slices], dtype=float), np.diff(encoders, axis=0)
        available += len(step) - 1
        if limit is None or sum(segments) < limit:  # the last grasp is whole
            x.append(np.hstack([encoders[1:-1], step[:-1], touch[1:-1]]))
            y.append(step[1:])
            segments.append(len(step) - 1)
    about = "iCub hand closing on 10 objects (Soh et al.), 10 deg as unit; alone: nothing moves"
    units = np.repeat([30.0, 10.0, 50.0], [9, 9, 5])  # [deg], [deg], [of 255]
    inputs, outputs = torch.from_numpy(np.vstack(x) / units), torch.from_numpy(np.vstack(y) / 10.0)
    return Stream("icub_grasp", inputs, outputs, 0, tuple(segments), about, available)


def _trial(path: Path) -> tuple[int, str]:
    """``book_7.txt`` as (7, "book"): all objects once, then all again."""
    name, _, number = path.stem.rpartition("_")
    return int(number), name


def _windows(values: Array, n: int) -> Array:
    """The last n values at each time from the n-th on."""
    return np.lib.stride_tricks.sliding_window_view(values, n)


def _table(name: str, limit: int | None) -> Stream:
    path, about, split = _TABLES[name]
    file = _need(path)
    if file.suffix == ".mat":
        values = next(v for k, v in require("scipy.io").loadmat(str(file)).items() if not k.startswith("__"))
    else:
        comma = "," if "csv" in file.name or name == "mimo" else None
        values = np.loadtxt(file, delimiter=comma, skiprows=1 if file.suffix == ".csv" else 0)
    x, y = map(torch.from_numpy, map(np.array, split(values)))
    return Stream(name, x, y, about=about).stream(limit, centre=True)


def _need(path: str) -> Path:
    root = os.environ.get("TORCH_EKM_DATA")
    if not root or not Path(root).is_dir():
        raise DescriptionError(root or "TORCH_EKM_DATA", "name a folder with the recordings here")
    full = Path(root) / path
    if not full.exists():
        raise DescriptionError(full, "the recording is not there; see 'torch-ekm compare --help' for sources")
    return full


def _last(n: int) -> Callable[[Array], tuple[Array, Array]]:
    """The last n columns from the others."""
    return lambda values: (values[:, :-n], values[:, -n:])


def _next(n: int) -> Callable[[Array], tuple[Array, Array]]:
    """The next value from the last n."""
    return lambda values: (_windows(values, n)[:-1], values[n:, None])


# name -> file, what it is, and how its values become inputs and outputs; series follow the Kernel Adaptive
# Filtering Toolbox
_TABLES: dict[str, tuple[str, str, Callable[[Array], tuple[Array, Array]]]] = {
    "sarcos": (
        "sarcos/sarcos_inv_test.mat", "seven torques of the SARCOS arm; alone: their mean", _last(7)
    ),
    "kin40k": ("uci/kin40k/data.csv.gz", "kinematics of an 8-link arm; alone: the mean", _last(1)),
    "powerplant": ("uci/power-plant.csv", "a power plant's output; alone: the mean", _last(1)),
    "lorenz": ("streams/lorenz.dat", "Lorenz attractor, next value; alone: the mean", _next(6)),
    "mackey_glass": ("streams/mg30.dat", "Mackey-Glass, next value; alone: the mean", _next(10)),
    "santafe": ("streams/santafe.dat", "Santa Fe laser, next value; alone: the mean", _next(10)),
    "mimo": (
        "streams/mimotestbed8K.dat",
        "a real 2x2 radio channel that changes (kafbox); alone: the mean",
        lambda values: (_windows(values[:, 0], 4), values[3:, 1:]),
    ),
}  # fmt: skip
_READERS: dict[str, Callable[[int | None], Stream]] = {
    "t42": _t42,
    "icub_grasp": _icub_grasp,
    **{name: partial(_table, name) for name in _TABLES},
}
