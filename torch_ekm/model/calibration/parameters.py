"""Figures that a calibration finds, and its result."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from ..._noise import NOISE
from ...description.hand import HandDescription
from ...description.transmission_file import write_transmission
from ...exceptions import ParameterError, UnknownNameError
from ...typing import Array, Float, Tensor
from ..kinematic_model import KinematicModel

PRIORS = {
    "springs": 0.5,
    "rest": math.radians(10),
    "moment_arms": NOISE.arm,
    "stiffness": 0.7,
    "offset": math.radians(5),
    "backlash": math.radians(1),
}
"""Kinds of parameters, and how far off each may well be (one standard deviation): of the logarithm for
springs, moment arms and stiffness, else [rad]."""
_LOGARITHMIC = ("springs", "moment_arms", "stiffness")
_WORDS = {"springs": "spring", "rest": "rest angle", "moment_arms": "moment arm"}  # else the kind itself


@dataclass(frozen=True)
class Parameter:
    """One unknown: ``value = nominal exp(prior x)`` of a positive figure, else ``nominal + prior x``."""

    kind: str
    name: str
    """Joint, actuator, "actuator at joint" for a moment arm."""
    index: tuple[int, ...]
    """Where it stands in the hand's array of its kind."""
    nominal: float
    prior: float

    @property
    def label(self) -> str:
        """What the parameter is called in tables and messages."""
        return f"{_WORDS.get(self.kind, self.kind)} of {self.name}"

    @property
    def logarithmic(self) -> bool:
        return self.kind in _LOGARITHMIC

    @property
    def lowest(self) -> float:
        """Bound of x: play is not negative."""
        return -min(NOISE.furthest, self.nominal / self.prior if self.kind == "backlash" else math.inf)

    def slope(self, value: float) -> float:
        """d value/dx: SI units of the figure per prior."""
        return self.prior * (abs(value) if self.logarithmic else 1.0)


class Figures(NamedTuple):
    """What a model and its play are made of."""

    springs: Float[Tensor, " n_q"]
    rest: Float[Tensor, " n_q"]
    moment_arms: Float[Tensor, "n_a n_q"]
    stiffness: Float[Tensor, " n_a"]
    offset: Float[Tensor, " n_a"]
    backlash: Float[Tensor, " n_a"]

    @classmethod
    def of(cls, hand: HandDescription) -> Figures:
        """The figures of a hand as its description has them."""
        stiffness = [actuator.stiffness for actuator in hand.actuators]
        arrays = (hand.spring_stiffness, hand.spring_rest, hand.actuation_jacobian, stiffness)
        parts = (*arrays, hand.actuator_offset, hand.actuator_backlash)
        return cls(*(torch.as_tensor(np.array(part), dtype=torch.float64) for part in parts))


class Unknowns:
    """The chosen parameters as one vector x, in units of their priors: 0 is the description.

    Args:
        hand: its figures are the start.
        chosen: kinds, or "kind:name" for one of them (all pulleys of an actuator: "moment_arms:actuator").
            Kinds leave out actuators that only shape the hand (``posture``): they rest while an object moves.

    Raises:
        UnknownNameError: no such kind or name.
        ParameterError: nothing is chosen.
    """

    def __init__(self, hand: HandDescription, chosen: Iterable[str]) -> None:
        self.hand, self.nominal = hand, Figures.of(hand)
        found: dict[tuple[str, tuple[int, ...]], Parameter] = {}
        for choice in chosen:
            kind, _, one = choice.partition(":")
            if kind not in PRIORS:
                raise UnknownNameError("kind of parameter", kind, PRIORS)
            candidates = self._all(kind, with_posture=bool(one))
            names = list(dict.fromkeys(part for p in candidates for part in p.name.split(" at ")[:1]))
            if one and one not in names:
                raise UnknownNameError(f"one of the {kind}", one, names)
            for p in candidates:
                if not one or p.name.split(" at ")[0] == one:
                    found[p.kind, p.index] = p
        self.parameters = tuple(found.values())
        if not self.parameters:
            raise ParameterError("parameters", list(chosen), f"some of {', '.join(PRIORS)}")

    def _all(self, kind: str, with_posture: bool) -> list[Parameter]:
        hand, values = self.hand, getattr(self.nominal, kind)
        motors = [k for k, a in enumerate(hand.actuators) if with_posture or not a.posture]
        if kind == "moment_arms":
            at = np.argwhere(hand.actuation_jacobian != 0).tolist()
            names = {(a, j): f"{hand.actuator_names[a]} at {hand.joint_names[j]}" for a, j in at}
            names = {index: name for index, name in names.items() if index[0] in motors}
        else:
            by_joint = kind in ("springs", "rest")
            of = hand.joint_names if by_joint else hand.actuator_names
            names = {(k,): name for k, name in enumerate(of) if by_joint or k in motors}
        entries = [Parameter(kind, name, at, float(values[at]), PRIORS[kind]) for at, name in names.items()]
        # a spring that is not there and an actuator that is rigid have no logarithm to search
        return [p for p in entries if not p.logarithmic or (p.nominal != 0 and math.isfinite(p.nominal))]

    def __len__(self) -> int:
        return len(self.parameters)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Of x; a play that starts at 0 stands on its bound."""
        return np.array([p.lowest for p in self.parameters]), np.full(len(self), NOISE.furthest)

    def figures(self, x: Float[Tensor, " n"]) -> Figures:
        """All figures at x, with its graph."""
        result = {}
        for kind in Figures._fields:
            own = [k for k, p in enumerate(self.parameters) if p.kind == kind]
            base = getattr(self.nominal, kind)
            if own:
                index = tuple(torch.tensor([self.parameters[k].index for k in own]).T)
                prior = torch.tensor([self.parameters[k].prior for k in own], dtype=base.dtype)
                step = prior * x[own]
                value = base[index] * torch.exp(step) if kind in _LOGARITHMIC else base[index] + step
                base = base.index_put(index, value)
            result[kind] = base
        return Figures(**result)

    def described(self, x: Array) -> HandDescription:
        """The description of the hand with the figures at x in place of its own."""
        figures = self.figures(torch.from_numpy(x))
        springs, rest, J_a, stiffness, offset, backlash = (part.numpy() for part in figures)
        actuators = tuple(
            dataclasses.replace(actuator, stiffness=float(k), offset=float(a), backlash=float(w))
            for actuator, k, a, w in zip(self.hand.actuators, stiffness, offset, backlash, strict=True)
        )
        return dataclasses.replace(
            self.hand, actuators=actuators, actuation_jacobian=J_a, spring_stiffness=springs, spring_rest=rest
        )


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
