"""What physics allows: a controller that is told everything."""

from __future__ import annotations

import dataclasses

from ..model import KinematicModel, ModelOptions
from ..plant import Observation, PlantStatus
from ..plant.wrapper import PlantWrapper
from ..simulation import SimulatedHand
from ..simulation.mechanism.assembly import true_hand, true_object


class Omniscient(PlantWrapper):
    """A simulated plant whose joints, pose and fingertip forces are reported as they are."""

    def observation(self, seen: Observation) -> Observation:
        truth = seen.truth
        if truth is None or seen.status is PlantStatus.LOST:
            return seen
        known = {name: getattr(truth, name) for name in ("q", "position", "rotation", "fingertip_force")}
        return dataclasses.replace(seen, **known)


def true_model(plant: SimulatedHand, options: ModelOptions) -> KinematicModel:
    """The kinematic model of the plant's own tendons, springs and object."""
    hand, obj = true_hand(plant.hand, plant.parameters), true_object(plant.object, plant.parameters)
    return KinematicModel(hand, obj, options)
