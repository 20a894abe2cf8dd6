"""Public streams and recordings of a real hand, read in place from a folder that the user names.

The folder is an argument or the environment variable ``TORCH_EKM_DATA``; nothing of it is part of
the package. What must lie where is said in each reader's docstring.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ..._extras import require
from ...exceptions import DescriptionError, UnknownNameError
from ...typing import Float, Tensor


@dataclass(frozen=True)
class Stream:
    """Training samples in the order of arrival, and a held-out test set; all of unit variance.

    ``x (n, d)``, ``y (n, m)``, ``x_test``, ``y_test``.
    """

    name: str
    x: Float[Tensor, "n d"]
    y: Float[Tensor, "n m"]
    x_test: Float[Tensor, "k d"]
    y_test: Float[Tensor, "k m"]


@dataclass(frozen=True)
class ResidualRecording:
    """One object in a real hand: inputs, and what the nominal model leaves over.

    Attributes:
        name: the object.
        x: standardised inputs ``(n, d)``.
        y: residual of the nominal model in units of its deviation on the nominal object ``(n, m)``.
    """

    name: str
    x: Float[Tensor, "n d"]
    y: Float[Tensor, "n m"]


def data_folder(root: str | Path | None = None) -> Path:
    """``root``, or the folder in ``TORCH_EKM_DATA``.

    Raises:
        DescriptionError: neither is given, or it is no folder.
    """
    root = root or os.environ.get("TORCH_EKM_DATA")
    if not root or not Path(root).is_dir():
        raise DescriptionError(root or "TORCH_EKM_DATA", "name a folder with the recordings here")
    return Path(root)


def _sarcos(root: Path) -> tuple[np.ndarray, np.ndarray]:
    table = require("scipy.io").loadmat(str(root / "sarcos" / "sarcos_inv_test.mat"))
    values = next(v for k, v in table.items() if not k.startswith("__"))
    return values[:, :21], values[:, 21:]


def _kin40k(root: Path) -> tuple[np.ndarray, np.ndarray]:
    values = np.loadtxt(root / "uci" / "kin40k" / "data.csv.gz", delimiter=",")
    return values[:, :-1], values[:, -1:]


def _powerplant(root: Path) -> tuple[np.ndarray, np.ndarray]:
    values = np.loadtxt(root / "uci" / "power-plant.csv", delimiter=",", skiprows=1)
    return values[:, :-1], values[:, -1:]


_READERS = {"sarcos": _sarcos, "kin40k": _kin40k, "powerplant": _powerplant}


def load_stream(name: str, seed: int, *, root: str | Path | None = None, limit: int | None = 8000) -> Stream:
    """A regression set as a stream: shuffled by ``seed``, cut to ``limit``, a tenth held out.

    ``"sarcos"`` (``sarcos/sarcos_inv_test.mat``, 21 inputs, 7 torques), ``"kin40k"``
    (``uci/kin40k/data.csv.gz``, 8 inputs), ``"powerplant"`` (``uci/power-plant.csv``, 4 inputs).

    Raises:
        UnknownNameError: there is no such stream.
        DescriptionError: no folder is named.
    """
    if name not in _READERS:
        raise UnknownNameError("stream", name, _READERS)
    x, y = _READERS[name](data_folder(root))
    order = np.random.default_rng(seed).permutation(len(x))[:limit]
    test, train = order[: len(order) // 10], order[len(order) // 10 :]

    def standard(values: np.ndarray, rows: np.ndarray) -> Tensor:
        return torch.from_numpy((values[rows] - values[train].mean(0)) / values[train].std(0))

    return Stream(name, standard(x, train), standard(y, train), standard(x, test), standard(y, test))


def load_t42(
    root: str | Path | None = None,
    *,
    nominal: str = "cyl45_d_v0",
    skip: Sequence[str] = ("str40_d_v1",),
    horizon: int = 10,
) -> list[ResidualRecording]:
    """Recordings of the Yale T42 hand (Sintov et al.) with a constant Jacobian as the nominal model.

    ``t42_hand/t42_testpaths.npz`` holds, per object and path, states ``(n, 13)`` and actions
    ``(n, 2)``. A sample every ``horizon`` steps: input the state and the mean action over the
    horizon, output the change of (x, y, angle). The Jacobian is the least-squares map from actions to
    outputs on the object ``nominal``, which also gives the units; the other objects follow in
    alphabetical order.
    """
    file = np.load(data_folder(root) / "t42_hand" / "t42_testpaths.npz")
    samples: dict[str, list[tuple[np.ndarray, np.ndarray, np.ndarray]]] = {}
    for key in sorted(k[:-2] for k in file.files if k.endswith("/S")):
        states, actions = file[key + "/S"], file[key + "/A"]
        pose = np.column_stack([states[:, :2], np.unwrap(states[:, 2])])
        starts = np.arange(0, len(states) - horizon, horizon)
        action = np.array([actions[t : t + horizon].mean(0) for t in starts]).reshape(-1, actions.shape[1])
        samples.setdefault(key.split("/")[0], []).append(
            (states[starts], action, pose[starts + horizon] - pose[starts])
        )
    joined = {
        name: [np.concatenate(part) for part in zip(*paths, strict=True)] for name, paths in samples.items()
    }

    state, action, change = joined[nominal]
    jacobian = np.linalg.lstsq(action, change, rcond=None)[0]
    inputs, residual = np.hstack([state, action]), change - action @ jacobian
    mean, deviation, unit = inputs.mean(0), inputs.std(0), residual.std(0)
    return [
        ResidualRecording(
            name,
            torch.from_numpy((np.hstack([state, action]) - mean) / deviation),
            torch.from_numpy((change - action @ jacobian) / unit),
        )
        for name, (state, action, change) in sorted(joined.items())
        if name != nominal and name not in skip
    ]
