"""Plain-text writing of URDF elements: primitives, inertias, joints."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Rod:
    """A cylinder from ``start`` to ``end`` [m]; with ``round`` ends it is a capsule."""

    start: Vector
    end: Vector
    radius: float
    round: bool = True


@dataclass(frozen=True)
class Box:
    """``size`` are full extents [m], axes parallel to the link's."""

    centre: Vector
    size: Vector


@dataclass(frozen=True)
class Ball:
    centre: Vector
    radius: float


Solid = Rod | Box | Ball


@dataclass(frozen=True)
class Inertia:
    """Mass [kg], centre of mass [m], inertia about it [kg m^2] in the link's axes."""

    mass: float
    com: Vector
    tensor: np.ndarray  # (3, 3)


def number(value: float) -> str:
    """Twelve significant digits, no minus zero; rounding noise below 1e-12 is zero."""
    return f"{0.0 if abs(value) < 1e-12 else value:.12g}"


def numbers(values: Iterable[float]) -> str:
    return " ".join(number(float(value)) for value in values)


def mirrored(solid: Solid, signs: Vector) -> Solid:
    def flip(v: Vector) -> Vector:
        return (v[0] * signs[0], v[1] * signs[1], v[2] * signs[2])

    if isinstance(solid, Rod):
        return replace(solid, start=flip(solid.start), end=flip(solid.end))
    return replace(solid, centre=flip(solid.centre))


def mirrored_inertia(inertia: Inertia, signs: Vector) -> Inertia:
    com = np.array(signs) * inertia.com
    return Inertia(inertia.mass, (com[0], com[1], com[2]), np.outer(signs, signs) * inertia.tensor)


def solid_inertia(solid: Solid, mass: float) -> Inertia:
    """Uniform density; the round ends of a rod count as a cylinder of its full length."""
    if isinstance(solid, Box):
        square = np.square(solid.size)
        return Inertia(mass, solid.centre, np.diag(mass / 12 * (square.sum() - square)))
    if isinstance(solid, Ball):
        return Inertia(mass, solid.centre, 2 / 5 * mass * solid.radius**2 * np.eye(3))
    start, end = np.array(solid.start), np.array(solid.end)
    axis = (end - start) / np.linalg.norm(end - start)
    length = np.linalg.norm(end - start) + (2 * solid.radius if solid.round else 0.0)
    along = mass * solid.radius**2 / 2
    across = mass * (3 * solid.radius**2 + length**2) / 12
    centre = (start + end) / 2
    tensor = across * np.eye(3) + (along - across) * np.outer(axis, axis)
    return Inertia(mass, (centre[0], centre[1], centre[2]), tensor)


def combined_inertia(parts: Iterable[Inertia]) -> Inertia:
    """Steiner: ``I = sum I_i + m_i (|d_i|^2 1 - d_i d_i^T)``, ``d_i = c_i - c``."""
    parts = list(parts)
    mass = sum(part.mass for part in parts)
    com = sum((part.mass * np.array(part.com) for part in parts), np.zeros(3)) / mass
    tensor = np.zeros((3, 3))
    for part in parts:
        d = np.array(part.com) - com
        tensor += part.tensor + part.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return Inertia(mass, (com[0], com[1], com[2]), tensor)


def link_xml(name: str, inertia: Inertia | None, solids: Iterable[Solid], colour: str = "bone") -> str:
    lines = []
    if inertia is not None:
        t = inertia.tensor
        tensor = {
            "ixx": t[0, 0],
            "ixy": t[0, 1],
            "ixz": t[0, 2],
            "iyy": t[1, 1],
            "iyz": t[1, 2],
            "izz": t[2, 2],
        }
        entries = " ".join(
            f'{key}="{number(value) if abs(value) > 1e-11 else 0}"' for key, value in tensor.items()
        )
        lines += [
            "    <inertial>",
            f'      <origin xyz="{numbers(inertia.com)}" rpy="0 0 0"/>',
            f'      <mass value="{number(inertia.mass)}"/>',
            f"      <inertia {entries}/>",
            "    </inertial>",
        ]
    primitives = [primitive for solid in solids for primitive in _primitives(solid)]
    for tag in ("visual", "collision"):
        for origin, geometry in primitives:
            material = f'<material name="{colour}"/>' if tag == "visual" else ""
            lines.append(f"    <{tag}>{origin}<geometry>{geometry}</geometry>{material}</{tag}>")
    return (
        "\n".join([f'  <link name="{name}">', *lines, "  </link>"]) if lines else f'  <link name="{name}"/>'
    )


def joint_xml(
    name: str,
    parent: str,
    child: str,
    xyz: Vector,
    rpy: Vector,
    axis: Vector | None = None,
    limits: tuple[float, float] = (0.0, 0.0),
    effort: float = 0.0,
    velocity: float = 0.0,
) -> str:
    lines = [
        f'  <joint name="{name}" type="{"fixed" if axis is None else "revolute"}">',
        f'    <parent link="{parent}"/><child link="{child}"/>',
        f'    <origin xyz="{numbers(xyz)}" rpy="{numbers(rpy)}"/>',
    ]
    if axis is not None:
        bounds = f'lower="{number(limits[0])}" upper="{number(limits[1])}"'
        lines += [
            f'    <axis xyz="{numbers(axis)}"/>',
            f'    <limit {bounds} effort="{number(effort)}" velocity="{number(velocity)}"/>',
        ]
    return "\n".join([*lines, "  </joint>"])


def _primitives(solid: Solid) -> list[tuple[str, str]]:
    """The standard has no capsule (and some readers reject one): a cylinder and two balls."""
    if isinstance(solid, Box):
        return [(_origin(solid.centre), f'<box size="{numbers(solid.size)}"/>')]
    if isinstance(solid, Ball):
        return [(_origin(solid.centre), f'<sphere radius="{number(solid.radius)}"/>')]
    start, end = np.array(solid.start), np.array(solid.end)
    x, y, z = (end - start) / np.linalg.norm(end - start)
    rpy = (0.0, math.acos(z), math.atan2(y, x))
    length = number(float(np.linalg.norm(end - start)))
    cylinder = f'<cylinder radius="{number(solid.radius)}" length="{length}"/>'
    parts = [(_origin((start + end) / 2, rpy), cylinder)]
    if solid.round:
        parts += [(_origin(p), f'<sphere radius="{number(solid.radius)}"/>') for p in (start, end)]
    return parts


def _origin(xyz: Iterable[float], rpy: Iterable[float] | None = None) -> str:
    turn = "" if rpy is None else f' rpy="{numbers(rpy)}"'
    return f'<origin xyz="{numbers(xyz)}"{turn}/>'
