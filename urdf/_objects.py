"""Everyday objects: dimensions, masses, friction, all chosen by us. The names of the first six are the
paper's; the other six reach from 15 to 66 mm and from 0.03 to 0.3 kg. docs/development/decisions.md says
which of them served a choice.

The cylinders have the diameters of those that a Yale T42 was recorded with, and its pads' friction.

Object frame: origin at the geometric centre, x along the longest side, y the direction in which the
fingers press, z = x cross y. A part is a solid with its mass, of uniform density.
"""

from __future__ import annotations

from dataclasses import dataclass

from _writer import Box, Rod, Solid, Vector, combined_inertia, link_xml, solid_inertia

# A 2x2 board of 20 mm markers on a thin plate, 5 mm off the +x end; z of the board looks along +x.
BOARD_GAP = 0.005
BOARD_RPY_DEG: Vector = (90.0, 0.0, 90.0)


@dataclass(frozen=True)
class Thing:
    name: str
    remark: str
    parts: tuple[tuple[Solid, float], ...]
    """Solid and mass [kg]."""
    width: float
    """Between the fingers [m]."""
    end: float
    """Largest x [m]: where the marker board sits."""
    friction: float
    ballast: tuple[Vector, float] | None = None
    """A small weight inside: where [m], mass [kg]."""
    colour: str = "0.80 0.55 0.30 1"


OBJECTS = (
    Thing(
        "toothpaste",
        "a tube of 75 ml, three quarters full: round at the cap, pressed flat at the other end",
        (
            (Rod((-0.030, 0, 0), (0.040, 0, 0), 0.016, round=False), 0.085),
            (Rod((0.040, 0, 0), (0.060, 0, 0), 0.009, round=False), 0.005),
            (Box((-0.045, 0, 0), (0.030, 0.008, 0.044)), 0.010),
        ),
        0.032,
        0.060,
        0.8,
        colour="0.85 0.88 0.95 1",
    ),
    Thing(
        "applier",
        "a toy tool: a broad handle with a narrow head, heavier at the head",
        (
            (Box((-0.012, 0, 0), (0.076, 0.026, 0.024)), 0.035),
            (Box((0.038, 0, 0), (0.024, 0.014, 0.034)), 0.020),
        ),
        0.026,
        0.050,
        0.9,
        colour="0.90 0.35 0.25 1",
    ),
    Thing(
        "box",
        "a cardboard box of 90 x 30 x 40 mm",
        ((Box((0, 0, 0), (0.090, 0.030, 0.040)), 0.080),),
        0.030,
        0.045,
        0.9,
    ),
    Thing(
        "weighted_box",
        "the same box with a counter-weight near one end",
        ((Box((0, 0, 0), (0.090, 0.030, 0.040)), 0.080),),
        0.030,
        0.045,
        0.9,
        ballast=((0.030, 0.0, 0.0), 0.040),
        colour="0.60 0.42 0.25 1",
    ),
    Thing(
        "bottle",
        "a small plastic bottle, a third full: body and neck",
        (
            (Rod((-0.050, 0, 0), (0.030, 0, 0), 0.018, round=False), 0.055),
            (Rod((0.030, 0, 0), (0.050, 0, 0), 0.010, round=False), 0.005),
        ),
        0.036,
        0.050,
        0.8,
        colour="0.45 0.70 0.85 1",
    ),
    Thing(
        "can",
        "a small can of 40 mm diameter",
        ((Rod((-0.040, 0, 0), (0.040, 0, 0), 0.020, round=False), 0.050),),
        0.040,
        0.040,
        0.7,
        colour="0.75 0.15 0.15 1",
    ),
    Thing(
        "pen_case",
        "a thin case of 120 x 15 x 30 mm with a few pens",
        ((Box((0, 0, 0), (0.120, 0.015, 0.030)), 0.030),),
        0.015,
        0.060,
        0.8,
        colour="0.20 0.35 0.60 1",
    ),
    Thing(
        "flashlight",
        "a flashlight: a grip of 22 mm with a broader head, heavier at the head",
        (
            (Rod((-0.060, 0, 0), (0.035, 0, 0), 0.011, round=False), 0.080),
            (Rod((0.035, 0, 0), (0.055, 0, 0), 0.016, round=False), 0.040),
        ),
        0.022,
        0.055,
        0.8,
        colour="0.25 0.25 0.28 1",
    ),
    Thing(
        "charger",
        "a heavy charger of 80 x 30 x 45 mm",
        ((Box((0, 0, 0), (0.080, 0.030, 0.045)), 0.300),),
        0.030,
        0.040,
        0.9,
        colour="0.15 0.15 0.15 1",
    ),
    Thing(
        "tea_tin",
        "a tin of 90 x 46 x 46 mm",
        ((Box((0, 0, 0), (0.090, 0.046, 0.046)), 0.150),),
        0.046,
        0.045,
        0.8,
        colour="0.30 0.50 0.35 1",
    ),
    Thing(
        "jar",
        "a jar of 52 mm diameter",
        ((Rod((-0.040, 0, 0), (0.040, 0, 0), 0.026, round=False), 0.180),),
        0.052,
        0.040,
        0.8,
        colour="0.80 0.70 0.30 1",
    ),
    Thing(
        "carton",
        "a light carton, 66 mm wide",
        ((Box((0, 0, 0), (0.090, 0.066, 0.050)), 0.100),),
        0.066,
        0.045,
        0.9,
        colour="0.85 0.75 0.60 1",
    ),
)
CYLINDERS = tuple(
    Thing(
        f"cylinder_{diameter}mm",
        f"a printed cylinder of {diameter} mm diameter, as the Yale T42 was recorded with",
        ((Rod((-0.030, 0, 0), (0.030, 0, 0), diameter / 2000, round=False), 0.030),),
        diameter / 1000,
        0.030,
        1.16,
        colour="0.85 0.82 0.70 1",
    )
    for diameter in (20, 30, 35, 45)
)


def urdf_text(thing: Thing) -> str:
    masses = [solid_inertia(solid, mass) for solid, mass in thing.parts]
    if thing.ballast is not None:
        centre, mass = thing.ballast
        masses.append(solid_inertia(Box(centre, (0.01, 0.02, 0.03)), mass))
    solids = [solid for solid, _ in thing.parts]
    link = link_xml(thing.name, combined_inertia(masses), solids, "surface")
    return f"""<?xml version="1.0"?>
<!-- {thing.remark}. Written by generate.py: change the figures there. -->
<robot name="{thing.name}">
  <material name="surface"><color rgba="{thing.colour}"/></material>
{link}
</robot>
"""


def object_text(thing: Thing) -> str:
    return f"""# {thing.remark}. Written by generate.py: change the figures there.

[object]
name = "{thing.name}"
friction = {thing.friction}  # Coulomb coefficient against a finger pad
torsional_friction = 0.0  # m; 0: a hard surface
grasp_axis = [0.0, 1.0, 0.0]  # the fingers press along y
grasp_width = {thing.width}  # m

[marker]  # frame of the board: x right, y up, z out of it
xyz = [{round(thing.end + BOARD_GAP, 6)}, 0.0, 0.0]  # m
rpy_deg = [{BOARD_RPY_DEG[0]}, {BOARD_RPY_DEG[1]}, {BOARD_RPY_DEG[2]}]
"""
