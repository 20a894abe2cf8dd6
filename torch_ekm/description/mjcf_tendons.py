"""Tendons of an MJCF on their own ways: MuJoCo says how long they are, and what arms they have."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .._extras import require
from ..typing import Array


def element_name(model: Any, kind: str, k: int) -> str:
    """The name of MuJoCo's k-th body, joint, tendon ...; of one without: a name that no other has."""
    name = getattr(model, kind)(k).name
    if not name:
        name, mj = f"{kind}_{k}", require("mujoco")
        while mj.mj_name2id(model, getattr(mj.mjtObj, f"mjOBJ_{kind.upper()}"), name) >= 0:
            name += "_"
    return name


class RoutedTendons:
    """``l(q) = W L(q)``, L the lengths of tendons as MuJoCo measures them.

    Args:
        model: MuJoCo's.
        weights: of the tendons in each length, by their indices.
        hinges: MuJoCo's joints in the order of q; all others stay where the file has them.
    """

    def __init__(self, model: Any, weights: Sequence[Mapping[int, float]], hinges: Sequence[int]) -> None:
        self._model, self._tendons = model, sorted({t for row in weights for t in row})
        self._weights = np.array([[row.get(t, 0.0) for t in self._tendons] for row in weights])
        self._q = [int(model.jnt_qposadr[j]) for j in hinges]
        self._place = {int(model.jnt_dofadr[j]): k for k, j in enumerate(hinges)}
        self._begin()

    def _begin(self) -> None:
        self._mj = require("mujoco")
        self._data = self._mj.MjData(self._model)

    def __call__(self, q: Array) -> tuple[Array, Array]:
        mj, model, data = self._mj, self._model, self._data
        data.qpos[self._q] = q
        mj.mj_kinematics(model, data)
        mj.mj_comPos(model, data)
        mj.mj_tendon(model, data)
        J = np.zeros((len(self._tendons), len(self._q)))
        for row, t in zip(J, self._tendons, strict=True):
            first = int(model.ten_J_rowadr[t])
            for i in range(first, first + int(model.ten_J_rownnz[t])):
                if (place := self._place.get(int(model.ten_J_colind[i]))) is not None:
                    row[place] += data.ten_J[i]
        return self._weights @ data.ten_length[self._tendons], self._weights @ J

    def __deepcopy__(self, memo: dict[int, Any]) -> RoutedTendons:
        return self  # only what it measures with changes

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in ("_mj", "_data")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._begin()
