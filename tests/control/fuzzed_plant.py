from __future__ import annotations

import dataclasses
import math
from collections import Counter, deque
from typing import Any

import numpy as np
import torch

from torch_ekm.exceptions import ParameterError
from torch_ekm.kinematics.se3 import exp
from torch_ekm.plant import Observation, Plant, PlantStatus, PlantWrapper
from torch_ekm.typing import Tensor

KINDS = ("late", "frozen", "frozen, with running stamps", "jumping", "missing", "out of range")
_LONGEST = 12  # observations of a fault
_SENSORS = ("encoders", "joints", "pose", "fingertips")
_FIELDS = {"encoders": ("a",), "joints": ("q",), "pose": ("position", "rotation"),
           "fingertips": ("fingertip_force",)}  # fmt: skip
_JUMPS = {"encoders": (0.01, 50.0), "joints": (0.01, 50.0), "pose": (0.01, 3.0), "fingertips": (0.5, 50.0)}
"""Least and largest [rad], [rad], [rad, 0.1 m], [N], log-uniform."""


class FuzzedPlant(PlantWrapper):
    """Any plant whose readings are spoilt at random: what guards must live through.

    One fault at a time: it begins at an observation with probability ``chance``, strikes one sensor in one
    of the ways of :data:`KINDS`, and lasts one observation, or in one of four cases up to twelve.
    The same seed gives the same faults. ``info["events"]`` and ``faults`` name them.

    Args:
        plant: to be spoilt.
        chance: of a fault's begin, 0 to 1.
        seed: of the faults.
    """

    def __init__(self, plant: Plant, chance: float = 0.15, seed: int = 0) -> None:
        super().__init__(plant)
        if not 0 <= chance <= 1:
            raise ParameterError("chance", chance, "between 0 and 1")
        self.chance = chance
        self.faults: Counter[str] = Counter()
        """Spoilt observations by kind."""
        self.observations = 0
        self._random = np.random.default_rng(seed)
        self._past: deque[Observation] = deque(maxlen=4)
        self._left, self._kind, self._sensor = 0, "", ""

    def repair(self) -> None:
        """End the fault under way; the next reading is passed on unchanged, unless a new one begins."""
        self._left = 0

    def observation(self, seen: Observation) -> Observation:
        """``seen``, or what a fault makes of it."""
        self.observations += 1
        self._past.append(seen)
        draw = self._random
        if self._left == 0 and draw.random() < self.chance and len(self._past) > 1:
            self._kind, self._sensor = str(draw.choice(KINDS)), str(draw.choice(_SENSORS))
            self._left = 1 if draw.random() < 0.75 else int(draw.integers(2, _LONGEST + 1))
            self._held = self._past[-2]
        if self._left == 0:
            return seen
        self._left -= 1
        self.faults[self._kind] += 1
        spoilt = dataclasses.replace(seen, **self._spoil(seen))
        return dataclasses.replace(spoilt, info={**seen.info, "events": (f"{self._sensor} {self._kind}",)})

    def _spoil(self, seen: Observation) -> dict[str, Any]:
        sensor, fields = self._sensor, _FIELDS[self._sensor]
        old = self._past[0] if self._kind == "late" else self._held
        if self._kind in ("late", "frozen"):
            stamps = seen.taken._replace(**{sensor: getattr(old.taken, sensor)})
            return {**{name: getattr(old, name) for name in fields}, "stamps": stamps}
        if self._kind.startswith("frozen"):
            return {name: getattr(old, name) for name in fields}
        if self._kind == "missing":
            if sensor == "fingertips":
                return {"fingertip_force": None}
            stamps = seen.taken._replace(pose=old.taken.pose)
            return {"position": old.position, "rotation": old.rotation, "stamps": stamps,
                    "status": PlantStatus.NOT_SEEN}  # fmt: skip
        least, most = _JUMPS[sensor]
        size = 1e3 if self._kind == "out of range" else math.exp(self._random.uniform(*np.log([least, most])))
        return self._moved(seen, size)

    def _moved(self, seen: Observation, size: float) -> dict[str, Any]:
        """One entry of the sensor, or a direction of the pose, is off by ``size``."""
        if self._sensor == "pose":
            way, turn = self._direction(), self._direction()
            rotation = exp(min(size, math.pi) * turn) @ seen.rotation
            return {"position": seen.position + 0.1 * size * way, "rotation": rotation}
        (name,) = _FIELDS[self._sensor]
        value = getattr(seen, name)
        if value is None:
            return {}
        spoilt = value.clone()
        spoilt[int(self._random.integers(len(value)))] += size * self._random.choice([-1.0, 1.0])
        return {name: spoilt.clamp(min=0.0) if name == "fingertip_force" else spoilt}

    def _direction(self) -> Tensor:
        way = self._random.standard_normal(3)
        return torch.from_numpy(way / np.linalg.norm(way))
