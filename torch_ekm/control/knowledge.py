"""What was learned of one hand, in one file."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from .._recorded import Recorded, check_state, describe
from ..description import HandDescription
from ..enhanced.hand_figures import DescribedFigures, HandFigures
from ..exceptions import FileFormatError, ParameterError
from ..kinematics import ServoModel
from ..kinematics.servo_model import IdealServos
from ..residual.files import known_classes, read, rebuild, write
from ..typing import Tensor
from .force_sensitivity import ForceSensitivity

KEPT = 8
"""Motions whose lessons can be taken back."""


class HandKnowledge(Recorded, nn.Module):
    """What a closed loop has learned of its hand, for any object: dead zones and biases of the servos, how
    the forces of the fingers answer to them, the figures by which it moves an object, and its last pace.

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

    def __init__(
        self,
        servo: ServoModel | IdealServos,
        forces: ForceSensitivity,
        figures: HandFigures | DescribedFigures,
    ) -> None:
        super().__init__()
        self.servo, self.forces, self.figures = servo, forces, figures
        self.pace = nn.Buffer(torch.tensor(0.0, dtype=torch.float64))
        """p at the end of the last turn, if that reached its target; else 0."""
        self._before: deque[dict[str, Tensor]] = deque(maxlen=KEPT)  # states before the last motions

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
            ParameterError: actuators, pads or figures of its description are others.
        """
        if tuple(self.servo.names) != tuple(hand.actuator_names):
            names = ", ".join(self.servo.names)
            valid = f"that of a hand with the actuators {', '.join(hand.actuator_names)}"
            raise ParameterError("knowledge", f"of a hand with the actuators {names}", valid)
        shape = tuple(self.forces.correction.shape)
        if shape != (len(hand.pads), hand.n_a):
            valid = f"that of a hand with {len(hand.pads)} pads and {hand.n_a} actuators"
            raise ParameterError("knowledge", f"of {shape[0]} pads and {shape[1]} actuators", valid)
        self.figures.check(hand)

    def checkpoint(self) -> None:
        """Before a motion is learned: what is known now can be had back by :meth:`take_back`."""
        self._before.append({name: value.clone() for name, value in self.state_dict().items()})

    def take_back(self, motions: int = 1) -> int:
        """All parts are as they were before the last ``motions`` checkpoints, eight of which are kept; how
        many that were."""
        taken = [self._before.pop() for _ in range(min(motions, len(self._before)))]
        if taken:
            super().load_state_dict(taken[-1], strict=False)  # a part may have been exchanged since
        return len(taken)

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:
        """See ``torch.nn.Module``; all or nothing.

        Raises:
            StateMismatchError: the state is of another hand, or holds NaN. Nothing was changed.
        """
        if strict:
            check_state(self, state_dict)
        self._before.clear()
        return super().load_state_dict(state_dict, strict=strict, assign=assign)

    def save(self, path: str | os.PathLike) -> None:
        """Write all of it; the file appears whole or not at all.

        Raises:
            OutputError: the file cannot be written.
        """
        write(path, describe(self), self.state_dict())

    @classmethod
    def load(cls, path: str | os.PathLike) -> HandKnowledge:
        """What :meth:`save` wrote. Nothing in the file is ever run.

        Raises:
            FileFormatError: it is no such file, or damaged.
            StateMismatchError: state and description do not go together.
        """
        described, state = read(path)
        made = rebuild(path, described, state, known_classes())
        if not isinstance(made, cls):
            raise FileFormatError(path, f"holds a {type(made).__name__}, no {cls.__name__}")
        return made
