"""What was learned of one hand, in one file."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from torch import nn

from .._files import write_whole
from .._recorded import Recorded, bound_problems, check_state, describe, make
from ..description import HandDescription
from ..exceptions import EKMError, FileFormatError, ParameterError, StateError
from ..kinematics import ServoModel
from ..kinematics.servo_model import IdealServos
from ..residual.files import known_classes, read, rebuild, write
from ..typing import Float, Tensor
from .filters import ForceSensitivity
from .hand_figures import DescribedFigures, HandFigures

_START = 0.07, 0.2  # along and across, of a hand of which nothing is known
_RECENT = 0.25  # weight of the last motion,
_WHOLE = math.radians(2.5)  # if it is as long as this [rad]
_SLIP, _LOSS, _MOST = 0.5, 1.5, 3.0  # [N] by which is gripped tighter, and at most
_FORGETS = 0.7  # share of it that is left in the next turn
STEADY = math.radians(0.4)  # [rad] of a motion as measured: two poses, and a pad that creeps as it settles


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
