"""The motions of a controller on the model of its hand, how sure that is of them, and what ends them."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterator
from enum import Enum
from typing import NamedTuple

import numpy as np
import torch

from .._noise import DEGREE, NOISE
from ..description import HandDescription
from ..estimation.hand_figures import HandFigures
from ..estimation.knowledge import STEADY, HandKnowledge
from ..exceptions import NoContactError, UnstableGraspError
from ..kinematics import GraspState
from ..model import Linearization
from ..model.kinematic_model import softened
from ..plant import Observation
from ..typing import Array, Float, Tensor
from .controller import LookAndMoveController
from .decision import Band, Decision, Piece, StopReason, Waypoint
from .focus import PoseTarget
from .model_hand import ModelHand
from .tasks import LimitingFunction

DEVIATIONS = 2.0
"""At which a waypoint, and a piece from rest, is safe."""
_LEVER = 0.03  # [m]: a share of a rotation counts as much as that share of this translation
_SERVO = 0.05  # of its way, that a servo errs
_SHARE = 0.15  # of the way that a normal force has come: what the model does not know of it
_THERE = 0.1 * DEGREE  # [rad] of the error, as a turn: the path ends
_MOST = 60  # pieces
LONGEST = 60 * DEGREE  # [rad] of an actuator in one movement: what follows is planned when it is there
_BENDS = 0.25 * DEGREE  # of a piece beyond its linearization: it is chosen once more, about where it leads
_HALVES = 3  # times that a piece is tried
_GRIPPED = 0.95  # of the wanted grip
_STOP_BEARS = 0.01  # [N m] of a joint's stop that ends a turn
_SLIDES = 0.05  # of its friction, that a pad at its limit has to spare


def servo_std(lin: Linearization, w: Float[Tensor, " n_a"], rows: list[int]) -> Tensor:
    """``sqrt(sum_j (df_n/da_j sd_j)^2)``: what servos that err by ``sd_j`` change of normal forces [N].

    A finger of 20 N m/rad loses or gains several newtons in a degree of its motor, a soft one some tenths.
    """
    error = (NOISE.servo**2 + (_SERVO * w).square()).sqrt()
    return (lin.described_normal_sensitivity[rows] * error).square().sum(-1).sqrt()


def lets_go(hand: HandDescription, piece: Piece, deviations: float = DEVIATIONS) -> str:
    """Why servos that err may let a finger go in a piece that is made from rest; empty: they do not, or they
    change its force by less than pads err: springs hold it, and the next look finds it."""
    if piece.force is None:
        return ""
    lin = piece.linearization
    rows, pads = hand.pad_rows(lin.contacts.finger)
    errs = deviations * servo_std(lin, piece.action, rows)
    loose = (piece.force[pads] < errs) & (errs > NOISE.force)
    return "servos as stiff as these may let a finger go" if bool(loose.any()) else ""


class Bands:
    """Standard deviations along a path, from its beginning::

        Sigma = G P G' + (sum sd_g)^2 + s^2 way^2 + n^2,   G = sum d(J_m w)/d figures
        sd_f^2 = s_f^2 + u' P_f u + (0.15 sum |df_n|)^2 + servo_std^2

    of the object's motion: covariance P of the hand's figures, deviation sd_g of g, share s of
    :class:`ModelError` and noise n of a motion; of the normal forces: noise and covariance of
    :class:`ForceSensitivity`. All of it errs alike along a path, so deviations add up, not variances.
    """

    def __init__(
        self,
        controller: LookAndMoveController,
        knowledge: HandKnowledge,
        seen: Observation,
        target: PoseTarget,
    ) -> None:
        self._controller, self._knowledge, self._target = controller, knowledge, target
        n_pads = len(controller.kinematic.hand.pads)
        self._force = seen.fingertip_force
        self._slopes: Array | None = None  # G
        self._g, self._way, self._turned = np.zeros(6), np.zeros(3), 0.0
        self._pull = torch.zeros_like(seen.a)
        self._said = torch.zeros(n_pads, dtype=torch.float64)  # S w
        self._swing = torch.zeros(n_pads, dtype=torch.float64)  # sum |df|
        self._pads: list[int] | None = None

    def add(self, piece: Piece, state: GraspState) -> Band:
        """One more piece, which leads to a state."""
        controller, focus = self._controller, self._controller.focus
        self._way = self._way + piece.increment[-3:].numpy()
        self._turned += float(piece.increment[-3:].norm())
        self._pull = self._pull + piece.action
        covariance, figures = self._of_model(), self._knowledge.figures
        if controller.enhanced is not None:
            _, variance = controller.enhanced.correction(piece.state, piece.action, state.n_s)
            self._g += variance[-6:].sqrt().numpy()
            covariance += np.diag(self._g**2)
            if isinstance(figures, HandFigures):
                slopes = figures.twist_slopes(piece.linearization, piece.action)
                if slopes is not None:
                    self._slopes = slopes if self._slopes is None else self._slopes + slopes
                    covariance += self._slopes @ figures.covariance.numpy() @ self._slopes.T
        rows = focus.off_matrix[~focus.off_translation].numpy()
        spread = np.linalg.eigvalsh(rows @ covariance @ rows.T).max(initial=0.0)
        off = focus.off_rotation(self._target.error(state))
        twist_std = torch.from_numpy(np.sqrt(covariance.diagonal()))
        return Band(off, math.sqrt(spread), twist_std, *self._of_forces(piece))

    def _of_forces(self, piece: Piece) -> tuple[Tensor | None, Tensor | None]:
        """Forces of the pads that touched at the start and their deviations; None: not measured."""
        if self._force is None or piece.force is None:
            return None, None
        rows, pads = self._controller.kinematic.hand.pad_rows(piece.linearization.contacts.finger)
        self._pads = pads if self._pads is None else self._pads
        self._said += piece.said
        self._swing += (piece.force - self._force).abs().nan_to_num()
        self._force = piece.force
        force = torch.full_like(piece.force, torch.nan)
        force[self._pads] = piece.force.nan_to_num()[self._pads]
        spread = torch.full_like(force, NOISE.force)
        if self._controller.forces is not None:  # else nothing is learned of them
            spread = self._knowledge.forces.spread(self._pull, self._said, self._turned)
        servo = torch.zeros_like(spread)
        servo[pads] = servo_std(piece.linearization, self._pull, rows)
        return force, (spread.square() + servo.square() + (_SHARE * self._swing).square()).sqrt()

    def _of_model(self) -> Array:
        """Covariance of what neither figures nor g know: shares of the way, and noise."""
        error, size = self._knowledge.error, float(np.linalg.norm(self._way))
        axis = self._way / max(size, 1e-12)
        turn = (error.across * size) ** 2 * np.eye(3) + STEADY**2 * np.eye(3)
        turn += (error.along**2 - error.across**2) * size**2 * np.outer(axis, axis)
        shift = (_LEVER * error.across * size) ** 2 * np.eye(3) + (_LEVER * STEADY) ** 2 * np.eye(3)
        return np.block([[shift, np.zeros((3, 3))], [np.zeros((3, 3)), turn]])


class PathEnd(Enum):
    """What ends a turn of the object, as the model predicts it."""

    NOTHING = "nothing"
    """The target is reached."""
    LINK = "link"
    """A link without a pad bears on the object."""
    FRICTION = "friction"
    """A finger's friction margin is used up: it slides, or no forces balance the object any more."""
    JOINT_STOP = "joint stop"
    ACTUATOR = "actuator"
    STABILITY = "stability"
    """The grasp buckles."""
    CONTACT = "contact lost"
    WAY = "way"
    """Nothing: it goes on after the longest movement that is made at once."""


class End(NamedTuple):
    """Of a path."""

    kind: PathEnd = PathEnd.NOTHING
    what: tuple[str, ...] = ()
    """Names of the links, pads, joints or actuators that end it; the likeliest first."""
    message: str = ""
    """The same in a sentence."""

    def __str__(self) -> str:
        return f"{self.kind.value}: {', '.join(self.what)}" if self.what else self.kind.value


class Rehearsal:
    """Motions of a controller on a :class:`ModelHand`, in steps of ``piece`` [rad], until an actuator has
    gone ``longest`` [rad]; nothing that they do changes the controller.

    Without a target the object stays where it is, and is gripped as it should be, unless ``firm`` of that
    grip is there; ``hand`` stands where the motions begin already.
    """

    def __init__(
        self,
        controller: LookAndMoveController,
        knowledge: HandKnowledge,
        seen: Observation,
        target: PoseTarget | None,
        piece: float,
        longest: float = LONGEST,
        *,
        firm: float = math.inf,
        hand: ModelHand | None = None,
    ) -> None:
        self._controller, self._target, self._longest, self._firm = controller, target, longest, firm
        self._limiting = LimitingFunction(gain=1.0, step=piece, contact_travel=None)
        model = controller.kinematic if controller.enhanced is None else controller.enhanced
        if hand is None:
            hand = ModelHand(model, seen.state, seen.a, seen.fingertip_force, controller.forces)
        self.hand, at = hand, PoseTarget(seen.position, seen.rotation) if target is None else target
        self._bands = Bands(controller, knowledge, seen, at)
        self._measures, self._idle = seen.fingertip_force is not None, set(self.hand.at_limits())
        self.first: Decision | None = None
        """The first one, with the grip before anything moves."""
        self.last: Decision | None = None
        self._too_long = False
        self._start: Linearization | None = None

    @torch.no_grad()
    def path(self) -> Iterator[Waypoint]:
        """Each piece, where it leads, and how sure the model is of that."""
        controller, hand, way = self._controller, self.hand, torch.zeros_like(self.hand.a)
        for _ in range(_MOST):
            here = hand.observe()
            if hand.failure is not None or self._there(here.state):
                return
            lin = hand.linearization
            if lin is None:
                return
            force = controller.believed(here.a, here.fingertip_force if self._measures else None)
            share = _GRIPPED
            if self.first is None:
                share, self._start = min(share, self._firm), lin
            lin = controller.corrected(lin)
            self.last = decision = self._decide(here, force, lin)
            self.first = self.first or decision
            firm = self._target is None and not is_loose(decision, share)
            if decision.status is not StopReason.RUNNING or firm:
                return
            way = way + decision.delta_a
            self._too_long = float(way.abs().max()) > self._longest
            if self._too_long:
                return
            hand.command(decision.delta_a)
            if hand.failure is None:
                f, after = hand.increment - hand.correction, hand.force if self._measures else None
                made = Piece(lin, decision.delta_a, f, hand.increment, after, hand.said)
                yield Waypoint(made, hand.state, self._bands.add(made, hand.state))

    def _decide(self, here: Observation, force: Tensor | None, lin: Linearization) -> Decision:
        controller, focus = self._controller, self._controller.focus
        target = PoseTarget(here.position, here.rotation) if self._target is None else self._target
        error = target.error(here.state)
        desired = self._limiting(focus.step_scale * (focus.matrix @ error)) / focus.step_scale
        for _ in range(_HALVES):
            seen = controller.situation(lin, here.a, force, error, desired)
            if seen.grip is not None and self._start and seen.grip > float(self._start.forces.normal.max()):
                seen = dataclasses.replace(seen, grip=min(seen.grip, self._most))
            decision = controller.choose(lin, seen)
            if not any(lets_go(self.hand.hand, piece) for piece in decision.pieces):
                break
            desired = desired / 2
        found = self.hand.tangent(decision.delta_a) if decision.status is StopReason.RUNNING else None
        if found is None:
            return decision
        J, rest = found
        bends = (J - lin.manipulation_jacobian) @ decision.delta_a + rest
        if float(bends[-3:].norm()) < _BENDS:
            return decision
        again = dataclasses.replace(lin, manipulation_jacobian=J)
        return controller.choose(again, dataclasses.replace(seen, bend=rest))

    @functools.cached_property
    def _most(self) -> float:
        """The hardest grip [N]: a grasp that its forces have made soft would buckle with more."""
        lin = self._start
        if lin is None or not softened(self.hand.kinematic, lin):
            return math.inf
        return float(lin.forces.normal.max())

    def _there(self, state: GraspState) -> bool:
        return self._target is not None and self._controller.focus.error(self._target, state) <= _THERE

    @property
    def end(self) -> End:
        """What ended the path, or keeps it from coming nearer."""
        hand, failure = self.hand, self.hand.failure
        if self._target is None or self._there(hand.state):
            return End()
        if isinstance(failure, NoContactError):
            return End(PathEnd.CONTACT, (), str(failure))
        if isinstance(failure, UnstableGraspError):
            return End(PathEnd.STABILITY, (), str(failure))
        sliding = _sliding(hand)
        limits = [name for name in hand.at_limits() if name not in self._idle]
        said = str(failure or "") or (self.last.message if self.last else "")
        if failure is None and self._too_long:
            return End(PathEnd.WAY, (), "an actuator goes as far as one movement goes")
        for kind, found, verb in (
            (PathEnd.FRICTION, sliding if failure is not None else [], "is at its friction limit"),
            (PathEnd.LINK, _bearing(hand), "has no pad, and bears on the object"),
            (PathEnd.ACTUATOR, limits, "stands at the end of its range"),
            (PathEnd.JOINT_STOP, hand.at_stops(_STOP_BEARS), "stands at its stop"),
            (PathEnd.FRICTION, sliding, "slides"),
        ):
            if found:
                return End(kind, tuple(found), "; ".join(filter(None, (f"{found[0]} {verb}", said))))
        return End(PathEnd.FRICTION, (), said or "the object comes no nearer")


def is_loose(decision: Decision, share: float) -> bool:
    """The grip before anything moves is less than that share of what is wanted, or a finger's is weak."""
    grip = decision.grip
    return grip is not None and (grip.weak or float(grip.force.max()) < share * grip.wanted)


def _bearing(hand: ModelHand) -> list[str]:
    """Links without a pad that bear."""
    lin, pads = hand.linearization, {pad.name for pad in hand.hand.pads}
    if lin is None:
        return []
    pairs = zip(lin.contacts.finger, lin.forces.normal.tolist(), strict=True)
    return [name for name, force in pairs if name not in pads and force > 0.1]


def _sliding(hand: ModelHand) -> list[str]:
    """Contacts in the order of their margins, those that have none to spare."""
    lin = hand.linearization
    if lin is None or not lin.forces.solved:
        return []
    left = sorted(zip(lin.forces.relative_margin.tolist(), lin.contacts.finger, strict=True))
    return [name for share, name in left if share < _SLIDES]
