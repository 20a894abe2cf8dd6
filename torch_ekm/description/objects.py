"""What an object is, as data: shapes, mass, friction, the place of its marker board."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .._extras import require
from ..exceptions import DescriptionError
from ..typing import Array
from ._reading import TomlTable, read_toml
from .shape import Shape
from .urdf import UrdfModel, inertia_problem


@dataclass(frozen=True)
class ObjectDescription:
    """A rigid object. Lengths [m], masses [kg]; everything in the object's own frame.

    Raises:
        DescriptionError: mass and inertia of no solid body, a centre of mass that is no point, or a negative
            coefficient of friction.
    """

    name: str
    urdf_path: Path
    mass: float
    com: Array
    """Centre of mass, ``(3,)`` [m]."""
    inertia: Array
    """About ``com``, ``(3, 3)`` [kg m^2]."""
    friction: float
    """Coulomb coefficient against a finger pad."""
    torsional_friction: float
    """Soft-contact coefficient gamma [m]; 0: a hard surface."""
    shapes: tuple[Shape, ...]
    marker_transform: Array
    """Pose of the marker board's frame (z out of the board), ``(4, 4)``."""
    grasp_axis: Array
    """Unit direction along which the fingers press, ``(3,)``."""
    grasp_width: float
    """Thickness between the fingers at the origin, along ``grasp_axis`` [m]."""

    def __post_init__(self) -> None:
        problem = inertia_problem(self.mass, self.inertia)
        if np.shape(self.com) != (3,) or not np.isfinite(self.com).all():
            problem = f"the centre of mass must be three finite numbers [m], got {self.com}"
        for name in ("friction", "torsional_friction"):
            if not 0 <= getattr(self, name) < np.inf:
                problem = f"'{name}' must be finite and not negative, got {getattr(self, name)}"
        if problem:
            raise DescriptionError(self.urdf_path, problem)


def read_object(path: Path, urdf: UrdfModel) -> ObjectDescription:
    """The object described by a URDF of one link and the TOML file at ``path``.

    Raises:
        DescriptionError: no such file, not one link, no inertia, no primitive shape, a wrong figure.
    """
    if len(urdf.links) != 1:
        names = ", ".join(link.name for link in urdf.links)
        raise DescriptionError(urdf.path, f"an object must be a single link, found {names}")
    body = urdf.links[0]
    if body.mass <= 0:
        raise DescriptionError(urdf.path, f"link '{body.name}' needs an <inertial> with a positive mass")
    if urdf.notes:  # a hand's inertias hardly matter, an object's do
        raise DescriptionError(urdf.path, f"link '{body.name}': its <inertial> is of no solid body")
    if body.has_mesh or not body.collisions:
        problem = "contacts need <collision> shapes made of box, cylinder, sphere or capsule only"
        found = "a mesh" if body.has_mesh else "no shape"
        raise DescriptionError(urdf.path, f"link '{body.name}': {problem}, found {found}")
    top = TomlTable(path, "top level", read_toml(path, "object file"), ("object", "marker", "notes"))
    keys = ("name", "friction", "torsional_friction", "grasp_axis", "grasp_width")
    table = TomlTable(path, "[object]", top.data.get("object"), keys)
    marker = TomlTable(path, "[marker]", top.data.get("marker", {}), ("xyz", "rpy", "rpy_deg"))
    axis = np.array(table.vector("grasp_axis", 3, (0.0, 1.0, 0.0)))
    if np.linalg.norm(axis) < 1e-9:
        raise table.error("'grasp_axis' must not be zero")
    xyz, rpy = marker.vector("xyz", 3, (0.0, 0.0, 0.0)), marker.angles("rpy", 3, (0.0, 0.0, 0.0))
    pose = require("trimesh.transformations").compose_matrix  # as for the origins of a URDF
    return ObjectDescription(
        name=table.text("name"),
        urdf_path=urdf.path,
        mass=body.mass,
        com=body.com,
        inertia=body.inertia,
        friction=table.number("friction", minimum=0.0),
        torsional_friction=table.number("torsional_friction", 0.0, minimum=0.0),
        shapes=body.collisions,
        marker_transform=pose(translate=xyz, angles=rpy),
        grasp_axis=axis / np.linalg.norm(axis),
        grasp_width=table.number("grasp_width", positive=True),
    )
