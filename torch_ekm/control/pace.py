"""How far a motion goes: what one step asks for, how much of it is made, and how both grow with trust."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import nn

from ..exceptions import ParameterError
from ..kinematics.se3 import hat
from ..typing import Float, Tensor
from .situation import Situation

if TYPE_CHECKING:
    from ..model import Linearization

_DEG = math.pi / 180
# of the trust region
_AGREE = 1.0  # rho up to which the pace grows
_DISAGREE = 1.6  # rho from which it shrinks
_GROW, _SHRINK = 1.2, 0.7
# error that is no surprise, as a share of the motion; of a translation the contacts' way counts
RELATIVE = 0.12
TRANSLATION_NOISE = 0.3e-3  # [m] standard deviation of a measured motion
ROTATION_NOISE = 0.3 * _DEG  # [rad]
_FORCE_NOISE = 0.5  # [N]
_FORCE_SHARE = 0.25  # of the force that a finger bears: an error that leaves it its grip
SLIDES = 2.0  # rho of the twist alone from which the object is thought to slide
_WEAK, FIRM = 0.55, 0.75  # of the wanted grip: with which nothing is turned, and with which steps are whole
_ON, _OFF = 1 * _DEG, 3 * _DEG  # of the axis: up to which, and from which, the object counts as off it
_UNFELT = 1.0  # largest p where no pad measures: forces that nobody sees drift with the way that is made
LARGEST = 8.0  # p of any trust region: the steps of 20 deg that guards let pass at most
_FOR_NEW = 1.4  # largest p with an object that is new to a hand whose figures are known
_USED = 0.7  # a motion below this share of what was allowed says nothing for a larger one


@dataclass(frozen=True)
class LimitingFunction:
    """``dx_d = e min(gain, p step/|e|, p contact_travel/|v(e)|)``: keeps the direction, linear near the goal.

    v(e) is the way that the whole error would carry the contact that moves most. The limiting function of the
    E-KM paper (section III.B) is that of ``step``; the other two hold off noise and wide objects.
    p is the factor of the :class:`Pace`.
    """

    gain: float = 0.8
    """Share of a small focused error that one step asks for. A model that is right meets all of it,
    camera noise included; below 1 the loop averages the noise over some steps."""
    step: float = 2.5 * _DEG
    """At most this much of the focused error is asked for [rad]; at 2.5 deg each direction's own step."""
    contact_travel: float | None = 1.2e-3
    """And no contact is asked to move farther than this [m]: a wide object turns in smaller steps.
    None: no such limit."""

    def __call__(
        self, error: Float[Tensor, " n_x"], travel: float = 0.0, pace: float = 1.0
    ) -> Float[Tensor, " n_x"]:
        """dx_d.

        Args:
            error: e, focused error.
            travel: ``|v(e)|``, see :func:`contact_travel` [m].
            pace: p.
        """
        size = self.steps(error, travel)
        return error * min(self.gain, pace / size) if size > 0 else error

    def steps(self, error: Float[Tensor, " n_x"], travel: float = 0.0) -> float:
        """How many of the largest steps, at pace 1, make up an error."""
        size = float(torch.linalg.vector_norm(error)) / self.step
        return size if self.contact_travel is None else max(size, travel / self.contact_travel)


def contact_travel(twist: Float[Tensor, " 6"], lever: Float[Tensor, "n_c 3"]) -> float:
    """``max_i |v + w x l_i|`` of contacts at l from the object's point o [m]."""
    v, w = twist.numpy().reshape(2, 3)
    carried = v + lever.numpy() @ hat(w).T
    return math.sqrt((carried * carried).sum(-1).max())


@dataclass(frozen=True)
class StepBound:
    """``phi = min(1, off_rotation/|w_off|, off_travel/|v_off|, (m + c)/(m - m_after),
    max(1/p, (f_i/(even f_mean))^2)), c = creep mu f/W (1 + (p - 1)^+ r)``: the share of a step that is made.

    w_off and v_off are the predicted rotation and translation off the focus; m_after the predicted friction
    margins. A contact that slides holds no weight W across its way: the heavier the object is for its grip,
    the less may be missing. Where motions were predicted well (p) more may be, as long as the object keeps
    to the axis: r is 1 up to 1 deg off it and 0 from 3 deg on.

    The fingers that oppose the strongest one may bear enough together while one of them lets go: steps p
    above those of pace 1, which change the forces faster than they are corrected, ask for a force f_i of
    each that is near the mean f_mean of them.

    A step is not cut below ``least`` of the largest one at pace 1: standing still turns nothing. But a grip f
    is tightened first: below 0.75 of the wanted one steps become smaller, and at 0.55 of it, where pads
    measure it, there are none.
    """

    off_rotation: float = 1.5 * _DEG
    """[rad]"""
    off_travel: float = 2.5e-3
    """[m]"""
    creep: float = 1.0
    """Margin that may be missing where friction and weight are equal [N]."""
    even: float = 0.85
    """Of the mean of the fingers that oppose the strongest one, what each of them should bear."""
    least: float = 0.35
    """Infinite: steps are cut by a measured grip alone."""

    def __post_init__(self) -> None:
        for name in ("off_rotation", "off_travel", "creep", "even", "least"):
            if not getattr(self, name) > 0:
                raise ParameterError(name, getattr(self, name), "greater than 0")

    def share(
        self,
        lin: Linearization,
        delta_a: Float[Tensor, " n_a"],
        predicted: Float[Tensor, " n_s"],
        seen: Situation,
        asked: float = 1.0,
    ) -> float:
        """phi of a step.

        Args:
            predicted: increment that the corrected model predicts for ``delta_a``.
            asked: p, size of the step in units of the largest at pace 1.
        """
        off = (seen.focus.off_matrix @ predicted[-6:]).numpy()
        translation = seen.focus.off_translation.numpy()
        rotation, travel = (math.sqrt(part @ part) for part in (off[~translation], off[translation]))
        phi = min(1.0, self.off_rotation / max(rotation, 1e-12), self.off_travel / max(travel, 1e-12))
        f_n = seen.normal_force(lin)
        if f_n is None or not lin.forces.solved:
            return phi
        force = float(f_n.max())
        if seen.grip:
            others = np.delete(f_n, f_n.argmax())
            if len(others):
                even = max(float(others.min()), 0.0) / max(self.even * float(others.mean()), 1e-9)
                phi = min(phi, max(1 / max(asked, 1.0), even**2))
        friction = float(lin.contacts.friction.mean()) * force
        room = min(max((_OFF - seen.focus.off_rotation(seen.error)) / (_OFF - _ON), 0.0), 1.0)
        spare = self.creep * (1 + max(asked - 1.0, 0.0) * room) * friction / max(seen.weight, 1e-3)
        before, after = lin.margins.numpy(), lin.margins_after(delta_a).numpy()
        missing = after < -spare
        if missing.any():
            allowed = (before[missing] + spare) / (before[missing] - after[missing])
            phi = min(phi, float(np.clip(allowed, 0.0, 1.0).min()))
        return phi

    def grip_share(self, lin: Linearization, seen: Situation) -> float:
        """``clip((f/f_wanted - 0.55) / 0.2, 0, 1)``: the share of a step that a grip bears."""
        f_n = seen.normal_force(lin)
        if f_n is None or not seen.grip:
            return 1.0
        held = float(f_n.max()) / seen.grip
        return min(max((held - _WEAK) / (FIRM - _WEAK), 0.0), 1.0)


class ForceSurprise(NamedTuple):
    """What the pads in contact measured in a motion, against the prediction ``f_n + (df_n/da) w``."""

    pads: tuple[int, ...]
    before: Float[Tensor, " n_c"]
    """f_n before the motion [N]."""
    after: Float[Tensor, " n_c"]
    """[N]"""
    surprise: Float[Tensor, " n_c"]
    """Measured less predicted [N]; NaN where a pad does not measure, or has let go."""
    gone: Tensor
    """Which pads measured before the motion, and do not now ``(n_c,)``."""

    @property
    def z(self) -> Tensor:
        """Surprises in units of their noise and of a share of what the finger bears ``(n_c,)``."""
        return self.surprise / (_FORCE_NOISE**2 + (_FORCE_SHARE * self.before).square()).sqrt()

    @property
    def wrong(self) -> bool:
        """Some pad measured what was not predicted, or has let go."""
        return bool((self.z.abs() > _DISAGREE).any() or self.gone.any())


@dataclass(frozen=True)
class TrustRegion:
    """``p <- 1.2 p`` where ``rho < 1``, ``0.7 p`` where ``rho > 1.6``, with::

        rho = max(rms_i z_i over twist and normal forces, |z_i| of each finger)
        z_i = (dx_i - predicted_i) / sqrt(noise_i^2 + (0.12 |predicted|)^2)

    with a quarter of a finger's force in place of 12 % of the motion. 1 is an error that the sensors'
    noise (0.3 mm, 0.3 deg, 0.5 N) and these shares explain. Each finger counts alone, too: the mean would let
    one fade while the rest is predicted well.

    Source: trust regions of nonlinear optimisation, Conn, Gould and Toint, Trust-Region Methods (2000), with
    the measured motion in the place of the cost.

    Raises:
        ParameterError: a figure outside its range.
    """

    start: float = 0.7
    """Pace with an object that is new to a hand of which nothing is known."""
    smallest: float = 0.5
    largest: float = 2.0

    def __post_init__(self) -> None:
        if not self.largest <= LARGEST:
            raise ParameterError("largest", self.largest, f"at most {LARGEST:g}")
        if not 0 < self.smallest <= self.largest:
            valid = f"above 0 and at most largest = {self.largest:g}"
            raise ParameterError("smallest", self.smallest, valid)
        if not self.smallest <= self.start <= self.largest:
            raise ParameterError("start", self.start, f"between {self.smallest:g} and {self.largest:g}")

    def disagreement(
        self,
        predicted: Float[Tensor, " 6"],
        came: Float[Tensor, " 6"],
        lever: float,
        forces: ForceSurprise | None = None,
    ) -> float:
        """rho of one motion.

        Args:
            predicted: twist of the object that the model predicts for what the encoders did [m, rad].
            came: as measured.
            lever: of the contacts about the object's point, root mean square [m].
            forces: of the contacts; None: unknown.
        """
        unit = np.array([lever] * 3 + [1.0] * 3)
        noise = np.array([TRANSLATION_NOISE] * 3 + [ROTATION_NOISE] * 3)
        said, off = predicted.numpy(), (came - predicted).numpy()
        size = np.linalg.norm(said / unit)
        z = off**2 / (noise**2 + (RELATIVE * size * unit) ** 2)
        fingers = np.zeros(0) if forces is None else forces.z.numpy() ** 2
        fingers = fingers[~np.isnan(fingers)]
        return math.sqrt(max(np.concatenate([z, fingers]).mean(), fingers.max(initial=0.0)))


@dataclass(frozen=True)
class PaceOptions:
    """Figures of a :class:`Pace`."""

    limiting: LimitingFunction = LimitingFunction()
    """What a step asks for."""
    bound: StepBound = StepBound()
    """How much of it is made where the model predicts that it goes wrong."""
    trust: TrustRegion = TrustRegion()
    """How p follows from what was predicted of the last motions."""


class Pace(nn.Module):
    """p, the factor of the largest step: it grows while f + g predicts motions, and shrinks where it errs.

    Keep it with the enhanced model of an object: a new grasp of it goes on at the pace of the last one.

    Args:
        options: figures; None: those that suit the iCub hand.
        adapts: False keeps p at 1, as for a model that does not learn.
    """

    def __init__(self, options: PaceOptions | None = None, *, adapts: bool = True) -> None:
        super().__init__()
        self.options = PaceOptions() if options is None else options
        self.adapts = adapts
        self.value = nn.Buffer(torch.tensor(self.options.trust.start if adapts else 1.0, dtype=torch.float64))
        self.count = nn.Buffer(torch.tensor(0))  # motions that were judged

    @property
    def factor(self) -> float:
        """p."""
        return float(self.value)

    def begin(self, last: float) -> None:
        """Where nothing was judged yet, p is the last one of the hand (0: unknown), start to 1.4."""
        if self.adapts and not int(self.count) and last > self.factor:
            self.value.clamp_(min=min(last, _FOR_NEW, self.options.trust.largest))

    def ask(
        self, error: Float[Tensor, " n_x"], travel: float = 0.0, measures: bool = True
    ) -> tuple[Float[Tensor, " n_x"], float]:
        """dx_d, and which share of the largest step at this pace it is.

        Args:
            error: e, focused error as turns that ask for as many steps [rad].
            travel: ``|v(e)|``, see :func:`contact_travel` [m].
            measures: some pad does; else p falls to 1.
        """
        if not measures:
            self.value.clamp_(max=_UNFELT)
        limiting = self.options.limiting
        share = min(limiting.gain * limiting.steps(error, travel) / self.factor, 1.0)
        return limiting(error, travel, self.factor), share

    def cut(
        self,
        lin: Linearization,
        delta_a: Float[Tensor, " n_a"],
        predicted: Float[Tensor, " n_s"],
        seen: Situation,
        share: float,
    ) -> float:
        """phi, see :class:`StepBound`: which part of the step that was asked for is made.

        Args:
            predicted: increment that the corrected model predicts for ``delta_a``.
            share: of the largest step that was asked for.
        """
        bound, asked = self.options.bound, share * self.factor
        grip = bound.grip_share(lin, seen)
        phi = min(bound.share(lin, delta_a, predicted, seen, asked), grip)
        phi = max(phi, min(1.0, bound.least / max(asked, 1e-9)))
        return phi if seen.fingertip_force is None else min(phi, grip)  # an estimate is no reason to wait

    def judge(self, disagreement: float, share: float = 1.0) -> None:
        """Learn from one motion.

        Args:
            disagreement: rho, see :meth:`TrustRegion.disagreement`.
            share: of the largest step that was asked for.
        """
        trust = self.options.trust
        if not self.adapts:
            return
        self.count += 1
        if disagreement > _DISAGREE:
            least = min(self.factor, trust.smallest)
            self.value.mul_(_SHRINK).clamp_(min=least)
        elif disagreement < _AGREE and share >= _USED:
            self.value.mul_(_GROW).clamp_(max=trust.largest)

    def restart(self) -> None:
        """Begin again with half the smallest steps: something went wrong, and is near."""
        if self.adapts:
            self.value.fill_(self.options.trust.smallest / 2)
            self.count += 1

    def extra_repr(self) -> str:
        return f"p={self.factor:.3g}"
