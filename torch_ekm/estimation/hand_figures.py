"""The figures of one hand, corrected by how objects moved."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn

from .._checks import check_finite, check_kind, check_shape
from .._noise import NOISE
from .._recorded import Recorded
from ..description import HandDescription
from ..exceptions import GraspError, ParameterError, StateError
from ..kinematics.servo_model import Play, PlayState
from ..model import Linearization
from ..model.linearization import Motion, MotionEquations
from ..model.reduction import Drives
from ..typing import Array, Float, Tensor
from .filters import ParameterFilter

# how far off each kind may well be: of the logarithm, and of play [rad]
_PRIORS = {"springs": 0.5, "moment_arms": NOISE.arm, "stiffness": 0.7, "backlash": math.radians(1)}
KINDS = tuple(_PRIORS)
_WORDS = {"springs": "spring", "moment_arms": "moment arm"}  # else the kind itself
# of the prior, in its units: one lathe turns all pulleys, one cable strings them
_COMMON, _OWN = 1.0, 0.4
_PLAY = 0.5  # of the prior of a backlash: its width where none is described, and how sure it is
_IDENTIFIED = 0.7  # of the variance of a figure of its kind without observations


class Figure(NamedTuple):
    """One figure of the hand against its description."""

    name: str
    factor: float
    """Of the described figure; of a backlash its width [rad]."""
    std: float
    """Standard deviation of the factor."""
    identified: bool
    """Motions determine it; otherwise it stays where the prior and the other figures put it."""
    described: float
    """1; of a backlash its width [rad]."""
    is_width: bool
    """It is a backlash."""


class _Entry(NamedTuple):
    """A figure as the description has it."""

    kind: str
    name: str
    index: tuple[int, ...]
    """Where it stands in the hand's array of its kind."""
    nominal: float

    @property
    def label(self) -> str:
        """What it is called in tables and messages."""
        return f"{_WORDS.get(self.kind, self.kind)} of {self.name}"


def _entries(hand: HandDescription) -> list[_Entry]:
    """What may be learned of a hand. Motors that only shape it (``posture``) rest while an object moves."""
    motors = [k for k, motor in enumerate(hand.actuators) if not motor.posture]
    arms, joints, names = hand.actuation_jacobian, hand.joint_names, hand.actuator_names
    of_arms = [(k, j) for k, j in np.argwhere(arms != 0).tolist() if k in motors]
    found = [_Entry("springs", one, (j,), float(hand.spring_stiffness[j])) for j, one in enumerate(joints)]
    found += [
        _Entry("moment_arms", f"{names[k]} at {joints[j]}", (k, j), float(arms[k, j])) for k, j in of_arms
    ]
    found += [_Entry("stiffness", names[k], (k,), float(hand.actuators[k].stiffness)) for k in motors]
    # a spring that is not there and a motor that is rigid have no logarithm
    found = [one for one in found if one.nominal != 0 and math.isfinite(one.nominal)]
    return found + [_Entry("backlash", names[k], (k,), float(hand.actuators[k].backlash)) for k in motors]


class DescribedFigures(Recorded, nn.Module):
    """The hand is as described; nothing is learned of it."""

    learns = False
    count = 0
    """Motions from which they were learned."""

    def check(self, hand: HandDescription) -> None:
        """They are of any hand."""

    def solve(self, equations: MotionEquations) -> None:
        """J_m is the description's."""

    def present(self, described: Drives) -> tuple[Float[Tensor, " n_q"], Drives]:
        """The description's."""
        return described.actuation.new_zeros(described.actuation.shape[-1]), described

    def learn(self, lin: Linearization, moved: Tensor, increment: Tensor) -> None:
        """Does nothing."""

    def learn_path(
        self, path: Sequence[tuple[Linearization, Tensor]], moved: Tensor, off: Tensor, nominal: Tensor
    ) -> None:
        """Does nothing."""

    def begin(self, a: Tensor) -> None:
        """There is no play."""

    def commit(self, moved: Float[Tensor, " n_a"], a: Float[Tensor, " n_a"]) -> Float[Tensor, " n_a"]:
        """Tendons have done what the motors did [rad]."""
        return moved

    def pulled(self, moved: Float[Tensor, " n_a"]) -> Float[Tensor, " n_a"]:
        """Tendons do what the motors do [rad]."""
        return moved

    def motors(self, pull: Float[Tensor, " n_a"]) -> Float[Tensor, " n_a"]:
        """Motors are to do what the tendons shall do [rad]."""
        return pull


class HandFigures(ParameterFilter):
    """``ds = J_m(s; theta) dx, dx = play(w)``: springs, moment arms, stiffnesses and play of the drives of a
    hand, from its motions.

    The filter of :class:`~torch_ekm.enhanced.ParameterFilter`, about the present theta, on the object's
    twist and the joints of the fingers that touch. ``theta`` are logarithms of factors of the description,
    in units of their priors (.5 of springs, .3 of moment arms, .7 of stiffnesses), which are common to all
    of a kind for the most part. Contact forces are those that were found with the description: motions do
    not determine the scale that forces need.

    :class:`~torch_ekm.kinematics.Play` of each drive takes up what its motor does first after a grasp and a
    reversal, which encoders do not show. Where none is described it is thought to be 0.5 deg wide.

    The figures belong to the hand, not to the object. :class:`~torch_ekm.model.KinematicModel.with_figures`
    gives a model that follows them.

    Args:
        hand: its name.
        entries: ``(kind, name, index, described value)`` of each figure.
    """

    learns = True

    def __init__(self, hand: str, entries: Sequence[Sequence[Any]]) -> None:
        found = [_Entry(kind, name, tuple(index), value) for kind, name, index, value in entries]
        kind = torch.tensor([KINDS.index(one.kind) for one in found])
        prior = _COMMON**2 * (kind[:, None] == kind).double() + _OWN**2 * torch.eye(len(found)).double()
        play, std = kind == KINDS.index("backlash"), np.array([_PRIORS[one.kind] for one in found])
        described = np.array([one.nominal for one in found])
        scale = torch.where(play, _PLAY, 1.0).double()
        start = _PLAY * (play & torch.from_numpy(described == 0))
        # play is not negative
        lower = (-np.where(play, np.minimum(NOISE.furthest, described / std), NOISE.furthest)).tolist()
        upper = [NOISE.furthest] * len(found)
        super().__init__([one.label for one in found], start, scale[:, None] * prior * scale, lower, upper)
        self._is_play, self._unit = play.numpy(), Play(torch.full((int(play.sum()),), 2.0).double())
        self._play: PlayState | None = None  # in units of half the widths
        self._a = torch.empty(0)  # encoders at the last commit
        self._solved: tuple[MotionEquations | None, Array, Motion | None] = None, np.empty(0), None
        self.hand, self._entries, self._kind = hand, tuple(found), kind.numpy()
        self._described, self._prior_std = described, std
        self._at = [  # where the figures of each kind stand in its array
            tuple(map(np.array, zip(*(one.index for one in found if one.kind == name), strict=True)))
            for name in KINDS
        ]
        self._index = [tuple(map(torch.from_numpy, at)) for at in self._at]  # the same for torch

    @classmethod
    def of(cls, hand: HandDescription) -> HandFigures:
        """Nothing is known yet: the figures of the description.

        Raises:
            ParameterError: the hand has no springs, moment arms or stiffnesses.
        """
        found = _entries(hand)
        if not found:
            raise ParameterError("hand", hand.name, "one with springs, moment arms or stiffnesses")
        return cls(hand.name, [tuple(one) for one in found])

    def check(self, hand: HandDescription) -> None:
        """That they are of this hand.

        Raises:
            StateError: another hand's, or its description has other figures.
        """
        ours = {one.label: one.nominal for one in self._entries}
        theirs = {one.label: one.nominal for one in _entries(hand)}
        other = [name for name in {**ours, **theirs} if ours.get(name) != theirs.get(name)]
        if other:
            had, has = (figures.get(other[0], "no such figure") for figures in (ours, theirs))
            where = f"{other[0]} {had} there, {has} in the description"
            those = f"those of '{self.hand}' ({_digest(ours)}), not of '{hand.name}' ({_digest(theirs)})"
            raise StateError(f"the figures are {those}: {where}")

    @property
    def factors(self) -> Float[Tensor, " n"]:
        """Of the described figures; of a backlash its width [rad]."""
        return torch.from_numpy(self._factors)

    @property
    def _factors(self) -> Array:
        step = self._prior_std * self.mean.numpy()
        return np.where(self._is_play, self._described + step, np.exp(step))

    @property
    def width(self) -> Float[Tensor, " n"]:
        """Of the play of each actuator, from one end to the other [rad]."""
        return self.factors[self._is_play]

    def begin(self, a: Float[Tensor, " n_a"]) -> None:
        """The next motion begins at these encoders [rad]. Unless the last one ended there the play may stand
        anywhere."""
        if self._a.shape != a.shape or float((a - self._a).abs().max()) > NOISE.still:
            anywhere = PlayState(*(end.numpy() for end in self._unit.unknown()))
            self._play = anywhere if len(self.width) else None

    def commit(self, moved: Float[Tensor, " n_a"], a: Float[Tensor, " n_a"]) -> Float[Tensor, " n_a"]:
        """The motors have moved so, and stand at a [rad]; what the tendons did."""
        pull, _, self._play = self._pull(moved)
        self._a = a.clone()
        return pull

    def pulled(self, moved: Float[Tensor, " n_a"]) -> Float[Tensor, " n_a"]:
        """What the tendons do when the motors do this [rad]: less, where these take up the play."""
        return self._pull(moved)[0]

    def motors(self, pull: Float[Tensor, " n_a"]) -> Float[Tensor, " n_a"]:
        """What the motors are to do, so that the tendons do this [rad]."""
        if self._play is None:
            return pull
        motors = pull.double().numpy().copy()
        wanted = motors[self._at[-1]]
        lost = 0.5 * self._factors[self._is_play] * (self._play.position + np.sign(wanted))
        motors[self._at[-1]] += lost * (abs(wanted) > NOISE.still)
        return torch.from_numpy(motors)

    def _pull(self, moved: Tensor) -> tuple[Tensor, Array, PlayState | None]:
        """What the tendons do, its derivative by the width of each play, and where the plays stand after it,
        in units of half their widths."""
        at, half = self._at[-1], np.maximum(0.5 * self._factors[self._is_play], 1e-9)
        if self._play is None:
            return moved, np.zeros_like(half), None
        pull = moved.double().numpy().copy()
        w = pull[at] / half
        pulled, after = self._unit.advance(self._play, w)
        at_end = 0.5 * ((abs(after.low) == 1) + 1.0 * (abs(after.high) == 1))
        pull[at] = half * pulled
        return torch.from_numpy(pull), 0.5 * (pulled - at_end * w), after

    def solve(self, equations: MotionEquations) -> Motion | None:
        """J_m with the present figures, kept until these change; None where the grasp would buckle so."""
        of, mean, motion = self._solved
        if of is equations and np.array_equal(mean, self.mean.numpy()):
            return motion
        try:
            motion = equations.solve(*self.present(equations.reduction.drives))
        except GraspError:
            return None
        self._solved = equations, self.mean.numpy().copy(), motion
        return motion

    def present(self, described: Drives) -> tuple[Float[Tensor, " n_q"], Drives]:
        """Change of the springs against the description [N m/rad] and the drives, both as known now."""
        J_a, K_a = described
        now = self._described * self._factors
        change, arms, stiffness = (
            torch.from_numpy(values[self._kind == k]).to(J_a)
            for k, values in enumerate((now - self._described, now, now))
        )
        springs = J_a.new_zeros(J_a.shape[-1])
        if len(change):
            springs = springs.index_put(self._index[0], change)
        if len(arms):
            J_a = J_a.index_put(self._index[1], arms)
        if len(stiffness):  # a model without compliance keeps its actuators rigid
            K_a = K_a.where(K_a.isinf(), K_a.index_put(self._index[2], stiffness))
        return springs, Drives(J_a, K_a)

    @torch.no_grad()
    def learn(
        self, lin: Linearization, moved: Float[Tensor, " n_a"], increment: Float[Tensor, " n_s"]
    ) -> float | None:
        """Learn from one motion: :meth:`learn_path` of a single piece.

        Args:
            lin: of the state before it.
            moved: w, what the encoders did [rad]; before :meth:`commit`.
            increment: ds, as measured.

        Raises:
            ShapeError, NonFiniteError: nothing is changed.
        """
        check_kind("lin", lin, Linearization, "a Linearization, e.g. model.linearize(state)")
        check_shape("moved", moved, lin.manipulation_jacobian[0].shape, "of the motors")
        check_finite("moved", moved)
        check_shape("increment", increment, lin.manipulation_jacobian[:, 0].shape)
        check_finite("increment", increment)
        motion = None if lin.equations is None else self.solve(lin.equations)
        if motion is None:
            return None
        pull = self._pull(moved.to(self.mean))[0].to(motion.jacobian)
        nominal = motion.jacobian @ pull
        return self.learn_path([(lin, pull)], moved, increment - nominal, nominal)

    @torch.no_grad()
    def learn_path(
        self,
        path: Sequence[tuple[Linearization, Float[Tensor, " n_a"]]],
        moved: Float[Tensor, " n_a"],
        off: Float[Tensor, " n_s"],
        nominal: Float[Tensor, " n_s"],
    ) -> float | None:
        """Learn from one movement.

        Args:
            path: linearizations along it, and what the tendons did from each to the next [rad].
            moved: what the encoders did from the first to the end [rad]; before :meth:`commit`.
            off: ds as measured, less what f predicts.
            nominal: what f predicts.

        Returns:
            z of the filter; None: the movement cannot be modelled, went against its prediction, or nothing
                moved.
        """
        first = path[0][0]
        if first.equations is None or not bool(moved.any()):
            return None
        joints = first.equations.moving.nonzero()[:, 0].tolist()
        rows = [*joints, *range(first.n_q, first.n_q + 6)]
        by_width, slope = self._pull(moved.to(self.mean))[1] / len(path), 0.0
        for lin, pull in path:
            slopes = self._slopes(lin, pull, rows, by_width)
            if slopes is None:
                return None
            slope = slope + slopes
        wrong, predicted = off.double().numpy()[rows], nominal.double().numpy()[rows]
        noise = _noise(predicted, len(joints), float(first.lever))
        if ((predicted + wrong) * predicted / noise).sum() < -0.5 * (predicted**2 / noise).sum():
            return None  # figures do not turn a motion round: a sign is wrong, or a contact slid
        return self.update(*map(torch.from_numpy, (wrong, slope, noise)))

    def twist_slopes(self, lin: Linearization, pull: Float[Tensor, " n_a"]) -> Array | None:
        """``d(J_m w)/d theta`` of the object's rows ``(6, n)``; None: the model has no motion there."""
        return self._slopes(lin, pull, list(range(lin.n_q, lin.n_q + 6)), 0.0)

    def _slopes(
        self, lin: Linearization, pull: Tensor, rows: list[int], by_width: Array | float
    ) -> Array | None:
        motion = None if lin.equations is None else self.solve(lin.equations)
        if motion is None:
            return None
        derivatives = (*motion.derivative(pull.to(motion.jacobian), rows), motion.jacobian[rows])
        parts = zip((x.double().numpy() for x in derivatives), self._at, strict=True)
        phi = np.concatenate([part[:, *at] for part, at in parts if len(at)], axis=-1)
        phi[:, self._is_play] *= by_width
        slopes: Array = phi * self._prior_std * np.where(self._is_play, 1.0, self._described * self._factors)
        return slopes

    @property
    def figures(self) -> tuple[Figure, ...]:
        """Each figure against its description."""
        std = self._prior_std * self.stddev.numpy() * np.where(self._is_play, 1.0, self._factors)
        described = np.where(self._is_play, self._described, 1.0).tolist()
        known = self.factors.tolist(), std.tolist(), self._told.tolist()
        columns = self.names, *known, described, self._is_play.tolist()
        return tuple(Figure(*row) for row in zip(*columns, strict=True))

    @property
    def _told(self) -> Tensor:
        """Of which figures motions say more than they say of all of the kind."""
        variance = self.covariance.diagonal()
        identified = torch.zeros(len(self), dtype=torch.bool)
        for k in range(len(KINDS)):
            own = torch.from_numpy(self._kind == k)
            n = int(own.sum())
            if n:
                common = (self.covariance[own][:, own].sum() - variance[own].sum()) / max(n * (n - 1), 1)
                alone = self.prior.diagonal()[own] * _OWN**2 / (_COMMON**2 + _OWN**2)
                identified[own] = variance[own] < _IDENTIFIED * (common.clamp(min=0.0) + alone)
        return identified

    def __str__(self) -> str:
        figures = self.figures
        lines = [
            f"{one.name}: {math.degrees(one.factor):.2f} deg, +-{math.degrees(one.std):.2f}"
            if one.is_width
            else f"{one.name}: {one.factor:.2f} times the description, +-{one.std:.2f}"
            for one in figures
            if one.identified
        ]
        rest = [one.name for one in figures if not one.identified]
        if rest:
            lines.append(f"not identified: {', '.join(rest)}")
        return "\n".join(lines)


def _digest(figures: Mapping[str, float]) -> str:
    return hashlib.sha256(repr(sorted(figures.items())).encode()).hexdigest()[:8]


def _noise(predicted: Array, n_joints: int, lever: float) -> Any:
    """R: sensors, and a share of the motion."""
    dq, twist = predicted[:n_joints], predicted[n_joints:]
    unit = np.array([lever] * 3 + [1.0] * 3)
    std = np.array(NOISE.pose)
    size = NOISE.share * np.linalg.norm(twist / unit)
    of_joints = NOISE.joint**2 + (NOISE.share * np.linalg.norm(dq)) ** 2
    return np.concatenate([np.full(n_joints, of_joints), std**2 + (size * unit) ** 2])
