"""What a movement teaches."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from typing import NamedTuple

import torch

from .._noise import NOISE
from ..contact import ContactDetector
from ..description import HandDescription
from ..estimation.hand_figures import DescribedFigures, HandFigures
from ..estimation.knowledge import HandKnowledge
from ..plant import Observation, PlantStatus
from ..residual import UpdateReport
from ..typing import Float, Tensor
from .controller import LookAndMoveController
from .decision import Decision, Expectation, shares

_SLIPS, _OF_WAY = 3.0, 0.15  # noises, and share of the way of f + g, from which an object is thought to slide
_OF_IT, _WRONG = 0.25, 3.0  # share of what a finger bears that is no surprise; deviations that are one
_SENSED = 1e-3  # [m] of the surface, below which sensors are thought to be off: three deviations of a median


class ForceChange(NamedTuple):
    """What the pads in contact measured after a movement."""

    change: Float[Tensor, " n_pads"]
    """Of what they read [N]; NaN of a pad that did not measure before and after."""
    wrong: bool
    """Some pad measured what was not predicted, or has let go."""


def felt(
    hand: HandDescription, expected: Expectation, before: Observation, after: Observation
) -> ForceChange | None:
    """Of a movement; None: no pad measures."""
    was, now = before.fingertip_force, after.fingertip_force
    if was is None or now is None or expected.normal is None:
        return None
    held = torch.zeros_like(was, dtype=torch.bool)
    held[hand.pad_rows(expected.pieces[0].linearization.contacts.finger)[1]] = True
    # one that reads less may be dead
    touched, touches = held & (was >= NOISE.pressing), now >= NOISE.pressing
    both, noise = touched & touches, (NOISE.force**2 + (_OF_IT * was).square()).sqrt()
    surprise = ((now - expected.normal).abs() > _WRONG * noise) & both
    return ForceChange((now - was).where(both, torch.nan), bool((surprise | (touched & ~touches)).any()))


class Lessons:
    """Of one loop: the enhanced model of the controller learns, if it has one, the knowledge of the hand, and
    the figures, which are those of the knowledge or of a hand as described."""

    def __init__(
        self,
        controller: LookAndMoveController,
        knowledge: HandKnowledge,
        figures: HandFigures | DescribedFigures,
    ) -> None:
        self._controller, self._knowledge, self._figures = controller, knowledge, figures
        self._gaps: list[float] = []  # [m]

    def begin(self, seen: Observation) -> None:
        """A manipulation begins; the object may be another one."""
        error = self._knowledge.error
        error.begin()
        self._controller.reset(float(error.tighter))
        self._figures.begin(seen.a)
        self._gaps, self._controller.kinematic.surface = [], 0.0

    def touch(self, seen: Observation, otherwise: Callable[[Observation], float]) -> None:
        """Learn how far the surface is from its description: the mean over readings of the median gap of the
        pads that press (one pad may be off alone). A reading whose gaps one offset of all joints explains
        better is left out: ``otherwise`` is what that leaves of them [m]."""
        model = self._controller.kinematic
        names = model.pressing(seen.fingertip_force)
        if not (self._figures.learns and names and isinstance(model.detector, ContactDetector)):
            return
        found = model.detector(seen.q, seen.position, seen.rotation, names)
        gaps = [g for name, g in zip(found.finger, found.gap.tolist(), strict=True) if name in names]
        if len(gaps) > 1:
            median = statistics.median(gaps)
            if abs(median) > _SENSED and statistics.pstdev(gaps) > otherwise(seen):
                return
            self._gaps.append(median)
            mean = statistics.fmean(self._gaps)
            model.surface = mean if abs(mean) > _SENSED else 0.0

    def learn(
        self,
        seen: Observation,
        decision: Decision,
        after: Observation,
        moved: Float[Tensor, " n_a"],
        expected: Expectation,
        teaches: bool,
    ) -> UpdateReport | None:
        """The share of :class:`ModelError`, and a tighter grip of an object that slides; then, where nothing
        speaks against the readings, forces, figures and g; None: g learns nothing. The encoders ``moved``
        [rad], ``expected`` is what was to come of it."""
        controller, error, increment = self._controller, self._knowledge.error, after.state.minus(seen.state)
        if decision.turns and seen.status is PlantStatus.HELD:  # both ends were measured
            off, way = (increment - expected.increment)[-3:], expected.increment[-3:]
            error.see(off, way)
            of_way = NOISE.described if controller.enhanced is None else _OF_WAY
            if float(off.norm()) > _SLIPS * NOISE.rotation + of_way * float(way.norm()):
                error.slid()
                controller.tighter = float(error.tighter)
        if controller.enhanced is None or not teaches:
            return None
        if not self._knowledge.servo.learns:  # then the dead zones are g's to learn
            moved = decision.delta_a
            expected = controller.expect(decision.pieces, self._figures.pulled(moved))
        forces, came = self._knowledge.forces, felt(controller.kinematic.hand, expected, seen, after)
        if came is not None and not came.wrong:  # else a finger slid, or a link took its load
            turned = sum(float(one.increment[-3:].norm()) for one in expected.pieces)
            said = torch.stack([one.said for one in expected.pieces]).sum(0)
            forces.update(expected.moved, came.change, said, turned)
        return self.learn_increment(expected, moved, increment)

    def learn_increment(
        self, expected: Expectation, moved: Float[Tensor, " n_a"], increment: Float[Tensor, " n_s"]
    ) -> UpdateReport | None:
        """Figures and g learn of ds: g piece by piece, each with its share of what was not predicted, what
        the figures leave of it."""
        enhanced, model, report, done = self._controller.enhanced, self._controller.kinematic, None, 0.0
        assert enhanced is not None
        path = [(one.linearization, one.action) for one in expected.pieces]
        self._figures.learn_path(path, moved, increment - expected.nominal, expected.nominal)
        rest = increment - expected.increment
        for one, share in zip(expected.pieces, shares(expected.pieces), strict=True):
            lin = one.linearization
            nominal = one.nominal + model.followed(lin).step(one.action) - lin.step(one.action)
            state = one.state.plus(done * rest) if done else one.state
            report = enhanced.update(state, one.action, one.increment + share * rest, nominal)
            done += share
        return report
