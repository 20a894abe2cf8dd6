"""What a movement teaches, and what was learned of one hand, in one file."""

from __future__ import annotations

import contextlib
import math
import os
import statistics
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import nn

from .._files import write_whole
from .._noise import NOISE
from .._recorded import Recorded, bound_problems, check_state, describe, make
from ..contact import ContactDetector
from ..description import HandDescription
from ..estimation.filters import ForceSensitivity
from ..estimation.hand_figures import DescribedFigures, HandFigures
from ..exceptions import EKMError, FileFormatError, ParameterError, StateError
from ..kinematics import ServoModel
from ..kinematics.servo_model import IdealServos
from ..plant import Observation, PlantStatus
from ..residual import UpdateReport
from ..residual.files import known_classes, read, rebuild, write
from ..typing import Float, Tensor
from .controller import LookAndMoveController
from .decision import Decision, Expectation, shares

_START = 0.07, 0.2  # along and across, of a hand of which nothing is known
_RECENT = 0.25  # weight of the last motion,
_WHOLE = math.radians(2.5)  # if it is as long as this [rad]
_SLIP, _LOSS, _MOST = 0.5, 1.5, 3.0  # [N] by which is gripped tighter, and at most
_FORGETS = 0.7  # share of it that is left in the next turn
STEADY = math.radians(0.4)  # [rad] of a motion as measured: two poses, and a pad that creeps as it settles
_SLIPS, _OF_WAY = 3.0, 0.15  # noises, and share of the way of f + g, from which an object is thought to slide
_OF_IT, _WRONG = 0.25, 3.0  # share of what a finger bears that is no surprise; deviations that are one
_SENSED = 1e-3  # [m] of the surface, below which sensors are thought to be off: three deviations of a median


class ModelError(Recorded, nn.Module):
    """``s_i^2 <- s_i^2 + c (clip((e_i^2 - n^2) / way^2, 0, 1) - s_i^2), c = min(1, (way/2.5 deg)^2) / 4``.

    e is the rotation of the object that a model of ``f + g`` did not predict: along its way, and across.
    n = 0.4 deg is the part that has nothing to do with the way. Two figures for a hand and what it holds: for
    slides, figures that are not known, terms that the model leaves out. Variances of figures and of g are
    added where they are known.
    """

    def __init__(self) -> None:
        super().__init__()
        self.square = nn.Buffer(torch.tensor([along**2 for along in _START], dtype=torch.float64))
        """s^2, along and across."""
        self.tighter = nn.Buffer(torch.zeros((), dtype=torch.float64))
        """Grip on top of what suits the object, which has slid or was lost [N]."""

    @property
    def along(self) -> float:
        """s of the rotation about its own axis."""
        return math.sqrt(float(self.square[0]))

    @property
    def across(self) -> float:
        """s of the rotation off it."""
        return math.sqrt(float(self.square[1]))

    def begin(self) -> None:
        """A new turn: what slid in the last one is no part of it."""
        self.square.copy_(torch.minimum(self.square, self.square.new_tensor(_START).square()))
        self.tighter *= _FORGETS

    def slid(self, lost: bool = False) -> None:
        """The object has slid in the fingers, or is lost: it is gripped tighter."""
        self.tighter.copy_((self.tighter + (_LOSS if lost else _SLIP)).clamp(max=_MOST))

    def see(self, error: Float[Tensor, " 3"], way: Float[Tensor, " 3"]) -> None:
        """Learn from one movement: e, measured less predicted, and the predicted rotation [rad]."""
        size = float(torch.linalg.vector_norm(way))
        if size == 0:
            return
        along = float(error @ way) / size
        across = max(float(error @ error) - along**2, 0.0) / 2  # of each of two directions
        found = self.square.new_tensor([along**2, across])
        share = ((found - STEADY**2) / size**2).clamp(0, 1)
        self.square += _RECENT * min(1.0, (size / _WHOLE) ** 2) * (share - self.square)

    def state_problems(self, state: Mapping[str, Any]) -> list[str]:
        """What is wrong with the entries of a state that is to be loaded."""
        return bound_problems(state, square=(0, 1), tighter=(0, _MOST))

    def extra_repr(self) -> str:
        return f"along={self.along:.2g}, across={self.across:.2g}"


Part = Literal["servo", "forces", "figures", "error"]


class HandKnowledge(Recorded, nn.Module):
    """What a closed loop has learned of its hand, for any object: dead zones and biases of the servos, how
    the forces of the fingers answer to them, the figures by which it moves an object, and how far motions end
    from their prediction.

    Hand it to the next loop with the same hand, and keep it between sessions::

        loop = ClosedLoop(plant, controller)
        loop.run(target)
        loop.knowledge.save("left_hand.ekm")
        ClosedLoop(plant, another, knowledge=HandKnowledge.load("left_hand.ekm"))

    Args:
        servo: of the actuators.
        forces: how the pads' normal forces answer to the actuators.
        figures: springs, moment arms, stiffnesses, and play of the drives.
    """

    figures: HandFigures | DescribedFigures
    error: ModelError

    def __init__(
        self,
        servo: ServoModel | IdealServos,
        forces: ForceSensitivity,
        figures: HandFigures | DescribedFigures,
    ) -> None:
        super().__init__()
        self.servo, self.forces, self.figures = servo, forces, figures
        self.error = ModelError()
        """Share of a motion by which it ends elsewhere than predicted."""

    @classmethod
    def of(cls, hand: HandDescription, *, learns: bool = True, adapts: bool = True) -> HandKnowledge:
        """Nothing is known yet.

        Args:
            learns: False takes servos for ideal, and learns nothing of them.
            adapts: False leaves the figures of the hand as they are described.
        """
        servo = (ServoModel if learns else IdealServos)(hand.actuator_names)
        figures = HandFigures.of(hand) if adapts else DescribedFigures()
        return cls(servo, ForceSensitivity(len(hand.pads), hand.n_a), figures)

    def check(self, hand: HandDescription) -> None:
        """That it is of this hand.

        Raises:
            StateError: actuators, pads or figures of its description are others.
        """
        if tuple(self.servo.names) != tuple(hand.actuator_names):
            ours, theirs = (", ".join(names) for names in (self.servo.names, hand.actuator_names))
            raise StateError(f"the knowledge is of a hand with the actuators {ours}; this one has {theirs}")
        shape = tuple(self.forces.correction.shape)
        if shape != (len(hand.pads), hand.n_a):
            here = f"{len(hand.pads)} pads and {hand.n_a} actuators"
            raise StateError(
                f"the knowledge is of {shape[0]} pads and {shape[1]} actuators, the hand has {here}"
            )
        self.figures.check(hand)

    def load_state_dict(self, state_dict: Mapping[str, Any], *args: Any, **options: Any) -> Any:
        """See ``torch.nn.Module``; all or nothing.

        Raises:
            StateMismatchError: the state is of another hand, or holds NaN. Nothing was changed.
        """
        check_state(self, state_dict)
        return super().load_state_dict(state_dict, *args, **options)

    def reset(self, part: Part) -> None:
        """Nothing is known of this part any more.

        Raises:
            ParameterError: there is no such part.
        """
        if part not in get_args(Part):
            raise ParameterError("part", part, f"one of {', '.join(get_args(Part))}")
        held = getattr(self, part)
        held.load_state_dict(make(describe(held), known_classes()).state_dict())

    def save(self, path: str | os.PathLike) -> None:
        """Write all of it; the file appears whole or not at all. The one that it replaces is kept beside, if
        it can be loaded: ``hand.ekm.previous``.

        Raises:
            OutputError: the file cannot be written.
        """
        path = Path(path)
        with contextlib.suppress(FileFormatError):
            self.load(path)
            write_whole(previous(path), path.read_bytes())
        write(path, describe(self), self.state_dict())

    @classmethod
    def load(cls, path: str | os.PathLike) -> HandKnowledge:
        """What :meth:`save` wrote. Nothing in the file is ever run.

        Raises:
            FileFormatError: it is no such file, damaged, or states what no hand can have; the message names
                the last good file, if there is one.
        """
        try:
            described, state = read(path)
            made = rebuild(path, described, state, known_classes())
            if not isinstance(made, cls):
                raise FileFormatError(path, f"holds a {type(made).__name__}, no {cls.__name__}")
            return made
        except EKMError as error:
            problem = error.problem if isinstance(error, FileFormatError) else str(error)
            if os.path.isfile(previous(path)):
                problem += f"; the last file that was good is {previous(path)}: copy it here to go on with it"
            raise FileFormatError(path, problem) from None


def previous(path: str | os.PathLike) -> Path:
    """Where :meth:`HandKnowledge.save` keeps the file that it replaces."""
    return Path(path).parent / f"{Path(path).name}.previous"


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
