"""What a calibration found."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from ...description.hand import HandDescription
from ...description.transmission_file import write_transmission
from ...typing import Array
from ..kinematic_model import KinematicModel
from .parameters import Unknowns


class Calibrated(NamedTuple):
    """One parameter: described and found value with standard error, SI units."""

    label: str
    described: float
    value: float
    standard_error: float
    """SI, as the value."""
    identifiable: bool
    """The data say more of it than the prior did: the error is below half of the prior's."""


@dataclass(frozen=True)
class Calibration:
    """A calibrated hand, what was found, and how sure it is; ``print`` gives the table."""

    model: KinematicModel = field(repr=False)
    """As it was before."""
    unknowns: Unknowns = field(repr=False)
    x: Array
    """The parameters, in units of their priors ``(n,)``."""
    covariance: Array
    """Of x, priors included ``(n, n)``."""
    errors_before: Array
    """Measured less predicted increments with the figures of the description, ``[dq; do; dphi]`` [rad, m,
    rad], ``(n_motions, n_s)``; predicted by the mean of ``J_m`` at both ends."""
    errors_after: Array
    """The same with those that were found."""
    noise: dict[str, float]
    """Estimated standard deviations of motions ("joints" [rad], "position" [m], "rotation" [rad]), of joint
    torques that the equilibrium leaves [N m] and of fingertip forces [N]."""

    @property
    def hand(self) -> HandDescription:
        """The description with the figures that were found."""
        return self.unknowns.described(self.x)

    @property
    def parameters(self) -> tuple[Calibrated, ...]:
        """Each parameter with its found value and standard error, in the order of ``x``."""
        figures, rows = self.unknowns.figures(torch.from_numpy(self.x)), []
        for k, p in enumerate(self.unknowns.parameters):
            value, error = float(getattr(figures, p.kind)[p.index]), float(np.sqrt(self.covariance[k, k]))
            rows.append(Calibrated(p.label, p.nominal, value, error * p.slope(value), error < 0.5))
        return tuple(rows)

    def save(self, path: str | Path) -> Path:
        """Write the hand: ``<stem>.transmission.toml`` at ``path``, the URDF next to it if there is none.

        Raises:
            DescriptionError: ``path`` does not end in ".transmission.toml".
        """
        return write_transmission(self.hand, path)

    def __str__(self) -> str:
        width = max(len(row.label) for row in self.parameters)
        lines = [f"{'':{width}}  described      found  standard error"]
        for row in self.parameters:
            mark = "" if row.identifiable else "  (not identified)"
            figures = f"{row.described:10.4g} {row.value:10.4g} {row.standard_error:15.2g}"
            lines.append(f"{row.label:{width}} {figures}{mark}")
        for name, scale, unit in (("rotation", 180 / np.pi, "deg"), ("position", 1e3, "mm")):
            rows = slice(-3, None) if name == "rotation" else slice(-6, -3)
            sizes = [
                scale * float(np.sqrt(np.mean(np.sum(errors[:, rows] ** 2, axis=1))))
                for errors in (self.errors_before, self.errors_after)
            ]
            lines.append(
                f"error of a motion's {name}: {sizes[0]:.3g} {unit} before, {sizes[1]:.3g} after (rms)"
            )
        return "\n".join(lines)
