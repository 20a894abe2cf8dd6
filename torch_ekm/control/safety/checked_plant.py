"""What a loop reads: readings in float64, of the right lengths; and whose failure an exception is."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch

from ..._checks import check_kind, check_shape
from ...description import HandDescription
from ...plant import Observation, Plant, PlantWrapper
from ...typing import Tensor


class PlantFailedError(Exception):
    """The plant raised :attr:`cause`; :class:`CheckedPlant` says so to the loop, which ends with a Stop."""

    def __init__(self, cause: Exception) -> None:
        super().__init__(str(cause))
        self.cause = cause


class CheckedPlant(PlantWrapper):
    """A plant whose readings are looked at: float32 is made float64, another length is a ShapeError.

    Args:
        plant: a driver.
        hand: gives the lengths.

    Raises:
        PlantFailedError: by :meth:`observe` and :meth:`command`, for any error of the plant.
    """

    def __init__(self, plant: Plant, hand: HandDescription) -> None:
        super().__init__(plant)
        self._hand = hand
        self.last: Observation | None = None
        """The newest reading that could be used."""

    def observe(self) -> Observation:
        """Read the sensors."""
        return self._checked(super().observe)

    def command(self, delta_a: Tensor) -> Observation:
        """Move the actuators, wait, read the sensors."""
        return self._checked(lambda: super(CheckedPlant, self).command(delta_a))

    def observation(self, seen: Observation) -> Observation:
        """``seen`` in float64.

        Raises:
            ShapeError: it is of another hand, or part of it is missing.
            ParameterError: it is no reading, or its rotation is none.
        """
        check_kind("the plant's reading", seen, Observation, "an Observation")
        hand, shapes = self._hand, {"position": (3,), "rotation": (3, 3)}
        shapes |= {"q": (hand.n_q,), "a": (hand.n_a,), "fingertip_force": (len(hand.pads),)}
        changed = {}
        for name, shape in shapes.items():
            value: Tensor | None = getattr(seen, name)
            if value is None:  # the forces
                continue
            check_shape(f"Observation.{name}", value, shape, f"the hand is '{hand.name}'")
            if value.dtype != torch.float64:
                changed[name] = value.double()
        seen = dataclasses.replace(seen, **changed) if changed else seen
        _ = seen.state  # kept by the reading
        return seen

    def _checked(self, read: Callable[[], Observation]) -> Observation:
        try:
            self.last = read()
        except Exception as error:
            raise PlantFailedError(error) from error
        return self.last
