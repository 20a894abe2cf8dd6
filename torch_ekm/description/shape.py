"""A primitive solid, placed in the frame of a link or an object."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

_SAME = 1e-7  # [m]
Kind = Literal["box", "cylinder", "sphere", "capsule"]


@dataclass(frozen=True)
class Shape:
    """One convex primitive; lengths [m].

    ========== =========================== ==========================================
    kind       size                        axis (of the shape's own frame)
    ========== =========================== ==========================================
    box        (x, y, z), full extents     centre at the origin
    cylinder   (radius, length)            z, centre at the origin
    sphere     (radius,)
    capsule    (radius, length)            z; ``length`` is that of the cylindrical part
    ========== =========================== ==========================================
    """

    kind: Kind
    size: tuple[float, ...]
    transform: NDArray[np.float64]
    """Pose of the shape in the frame of its link or object, ``(4, 4)``."""

    def scaled(self, factor: float) -> Shape:
        """The shape with all lengths, its distance from the origin included, times ``factor``."""
        transform = self.transform.copy()
        transform[:3, 3] *= factor
        return Shape(self.kind, tuple(factor * size for size in self.size), transform)

    def grown(self, distance: float) -> Shape:
        """The shape with its surface farther out by ``distance`` [m], edges kept."""
        both = {"box": (2, 2, 2), "cylinder": (1, 2), "sphere": (1,), "capsule": (1, 0)}[self.kind]
        size = tuple(max(one + k * distance, _SAME) for one, k in zip(self.size, both, strict=True))
        return Shape(self.kind, size, self.transform)


def merge_capsules(shapes: tuple[Shape, ...]) -> tuple[Shape, ...]:
    """Read a cylinder with a ball of the same radius on either end as one capsule.

    The URDF standard has no capsule and some readers reject the widespread extension, so a capsule
    is written as cylinder + two spheres; here it becomes one smooth convex body again. Two capsules
    in line may share a ball.
    """
    spheres = [shape for shape in shapes if shape.kind == "sphere"]
    used: set[int] = set()
    merged: list[Shape] = []
    for shape in shapes:
        if shape.kind != "cylinder":
            merged.append(shape)
            continue
        radius, length = shape.size
        half = shape.transform[:3, 2] * length / 2
        centre = shape.transform[:3, 3]
        caps = [
            next((s for s in spheres if _is_ball(s, centre + sign * half, radius)), None)
            for sign in (-1.0, 1.0)
        ]
        if caps[0] is None or caps[1] is None:
            merged.append(shape)
        else:
            used.update(id(cap) for cap in caps)
            merged.append(Shape("capsule", shape.size, shape.transform))
    return tuple(shape for shape in merged if id(shape) not in used)


def _is_ball(shape: Shape, centre: NDArray[np.float64], radius: float) -> bool:
    offset = float(np.abs(shape.transform[:3, 3] - centre).max())
    return offset < _SAME and abs(shape.size[0] - radius) < _SAME
