"""A plan as a picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from .._extras import require
from .._noise import DEGREE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..typing import Float, Tensor
    from .decision import Waypoint

_STYLE = "torch_ekm.style"
_PANELS = "to go [deg]", "off the axis [deg]", "share of the friction left", "normal forces [N]"


def draw(
    errors: Sequence[float], row: Float[Tensor, " 6"], waypoints: Sequence[Waypoint], safe: int
) -> Figure:
    """See :meth:`~torch_ekm.control.Plan.draw`; focused errors [rad] at the waypoints, the row of M_c."""
    bands = [one.band for one in waypoints]
    stds = [float((row * band.twist_std).norm()) for band in bands]
    with require("matplotlib.style").context(_STYLE):
        # a Figure of its own: pyplot would keep it alive and touch the caller's backend
        figure = require("matplotlib.figure").Figure(figsize=(8.0, 5.0), layout="constrained")
        panels = figure.subplots(2, 2, sharex=True).ravel().tolist()
    _line(panels[0], [error / DEGREE for error in errors], [std / DEGREE for std in stds])
    _line(panels[1], [band.off / DEGREE for band in bands], [band.off_std / DEGREE for band in bands])
    grasps = [one.piece.linearization for one in waypoints]
    left = [dict(zip(a.contacts.finger, a.forces.relative_margin.tolist(), strict=True)) for a in grasps]
    for name in dict.fromkeys(name for one in left for name in one):
        _line(panels[2], [one.get(name, math.nan) for one in left], label=name)
    forces = [band.force for band in bands if band.force is not None]
    spread = [band.force_std for band in bands if band.force_std is not None]
    for pad in range(len(forces[0]) if forces else 0):
        force, std = ([float(one[pad]) for one in known] for known in (forces, spread))
        if not any(map(math.isnan, force)):
            _line(panels[3], force, std)
    for axes, label in zip(panels, _PANELS, strict=True):
        axes.set_ylabel(label)
        axes.axvspan(safe + 0.5, max(len(bands), safe) + 0.5, color="0.93", zorder=0)
    panels[2].set_xlabel("waypoint")
    panels[3].set_xlabel("waypoint")
    if left:
        panels[2].legend()
    return figure


def _line(axes: Any, middle: Sequence[float], std: Sequence[float] | None = None, label: str = "") -> None:
    """A prediction at each waypoint, within two standard deviations."""
    at = range(1, len(middle) + 1)
    (line,) = axes.plot(at, middle, label=label)
    if std is not None:
        pairs = list(zip(middle, std, strict=True))
        low, high = [m - 2 * s for m, s in pairs], [m + 2 * s for m, s in pairs]
        axes.fill_between(at, low, high, color=line.get_color(), alpha=0.2, linewidth=0)
