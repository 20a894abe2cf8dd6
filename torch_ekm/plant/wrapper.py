"""What is put around a plant: one base, as ``gymnasium.Wrapper`` is for environments."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..typing import Float, Tensor
from .observation import Observation
from .path import Path
from .plant import Plant, can_follow


class PlantWrapper:
    """Passes everything on to ``plant``; implements :class:`Plant`.

    A subclass overrides :meth:`observation` to change what is seen, :meth:`command` to change what is
    commanded, :meth:`reset` to begin again. What a plant offers beyond the contract (``hand``, ``object``,
    ``rotation_axis`` of a simulated hand) is found on the wrapper, too. So is ``follow``, unless a subclass
    overrides :meth:`command` and not :meth:`_followed`: no motion passes it by.
    """

    def __init__(self, plant: Plant) -> None:
        self.plant = plant

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name in ("plant", "follow"):  # not yet set: no endless search
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        return getattr(self.plant, name)

    def reset(self, seed: int) -> Observation:
        """Grasp the object again; the observation after it, as :meth:`observation` changes it."""
        return self.observation(self.plant.reset(seed))

    def observe(self) -> Observation:
        """Read the sensors, as :meth:`observation` changes the reading."""
        return self.observation(self.plant.observe())

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """Move the actuators by ``delta_a`` [rad], wait, read the sensors."""
        return self.observation(self.plant.command(delta_a))

    @property
    def follow(self) -> Callable[[Path, Callable[[Observation], bool]], Observation]:
        """See :class:`FollowingPlant`; there is none where ``plant`` has none."""
        own = type(self)
        passed_by = own.command is not PlantWrapper.command and own._followed is PlantWrapper._followed
        if passed_by or not can_follow(self.plant):
            raise AttributeError(f"{own.__name__} has no attribute 'follow'")
        return self._followed

    def _followed(self, path: Path, watch: Callable[[Observation], bool]) -> Observation:
        """``follow``, with all readings as :meth:`passing` and :meth:`observation` change them."""
        assert can_follow(self.plant)
        return self.observation(self.plant.follow(path, lambda seen: watch(self.passing(seen))))

    def passing(self, seen: Observation) -> Observation:
        """What is passed on of a reading on the way, which nothing may delay."""
        return self.observation(seen)

    def observation(self, seen: Observation) -> Observation:
        """What is passed on of what ``plant`` has seen."""
        return seen

    def close(self) -> None:
        """Close the wrapped plant: its devices, windows and files."""
        self.plant.close()
