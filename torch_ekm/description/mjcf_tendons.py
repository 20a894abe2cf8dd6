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
        self._given = model, weights, hinges
        self._model, self._tendons = model, sorted({t for row in weights for t in row})
        self._weights = np.array([[row.get(t, 0.0) for t in self._tendons] for row in weights])
        self._q, self._v = model.jnt_qposadr[list(hinges)], model.jnt_dofadr[list(hinges)]
        self._mj = require("mujoco")
        self._data = self._mj.MjData(model)

    def __call__(self, q: Array) -> tuple[Array, Array]:
        mj, model, data = self._mj, self._model, self._data
        data.qpos[self._q] = q
        mj.mj_kinematics(model, data)
        mj.mj_comPos(model, data)
        mj.mj_tendon(model, data)
        J = np.zeros((model.ntendon, model.nv))
        mj.mju_sparse2dense(J, data.ten_J, model.ten_J_rownnz, model.ten_J_rowadr, model.ten_J_colind)
        return self._weights @ data.ten_length[self._tendons], self._weights @ J[self._tendons][:, self._v]

    def __deepcopy__(self, memo: dict[int, Any]) -> RoutedTendons:
        return self  # only what it measures with changes

    def __reduce__(self) -> tuple[type[RoutedTendons], tuple[Any, ...]]:
        return RoutedTendons, self._given
