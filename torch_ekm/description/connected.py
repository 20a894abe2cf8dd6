"""Points of two links that are pinned to each other, which closes a loop."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..typing import Array
from .urdf import UrdfModel

_LEAST = 1e-9  # [m/rad] of an arm: a smaller one is rounding


class PinnedPoints:
    """``c(q) = U^T (p_1(q) - p_2(q))`` [m], U the directions in which the points can part at all.

    Args:
        urdf: the tree.
        links: the two.
        points: of each in its own frame [m].
        names: of all joints, in the order of q.
        postures: at which directions are looked for ``(n, n_q)`` [rad].
    """

    def __init__(
        self,
        urdf: UrdfModel,
        links: Sequence[str],
        points: Sequence[Sequence[float]],
        names: Sequence[str],
        postures: Array,
    ) -> None:
        self._chains = []
        for link, point in zip(links, points, strict=True):
            parts = [
                (joint.transform, None if joint.name not in names else names.index(joint.name), joint.axis)
                for joint in urdf.joints_to(link)
            ]
            self._chains.append((parts, np.array(point, dtype=np.float64)))
        self._n_q = len(names)
        self._directions = np.eye(3)
        rows = np.concatenate([self(q)[1].T for q in postures])
        _, size, directions = np.linalg.svd(rows, full_matrices=False)
        self._directions = directions[size > _LEAST * np.sqrt(len(postures))]

    @property
    def count(self) -> int:
        """How many conditions there are."""
        return len(self._directions)

    def __call__(self, q: Array) -> tuple[Array, Array]:
        (first, J), (second, K) = (self._point(parts, point, q) for parts, point in self._chains)
        return self._directions @ (first - second), self._directions @ (J - K)

    def _point(
        self, chain: list[tuple[Array, int | None, Array]], point: Array, q: Array
    ) -> tuple[Array, Array]:
        """Where a point is [m], and its Jacobian ``(3, n_q)``, in the root's frame."""
        R, o, joints = np.eye(3), np.zeros(3), []
        for transform, joint, axis in chain:
            o, R = o + R @ transform[:3, 3], R @ transform[:3, :3]
            if joint is not None:
                joints.append((joint, R @ axis, o))
                R = R @ _turned(axis, float(q[joint]))
        at, J = o + R @ point, np.zeros((3, self._n_q))
        for joint, axis, origin in joints:
            J[:, joint] += np.cross(axis, at - origin)
        return at, J


def _turned(axis: Array, angle: float) -> Array:
    """Rodrigues' rotation about a unit vector."""
    x, y, z = axis / np.linalg.norm(axis)
    hat = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * hat + (1 - np.cos(angle)) * hat @ hat
