from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...control import ClosedLoop, LookAndMoveController, Reach
from ...kinematics import GraspState
from ...model import KinematicModel
from ...rendering.scene import Scene
from ...typing import Array
from .hand import GraspShow


class ReachShow:
    """A pinch, turned to and fro on the model. Served, a slider sets the angle; as a page, it is played.

    Raises:
        EquilibriumError, GraspError: the object cannot be pinched by this hand.
    """

    def __init__(self, hand: str, object: str, seed: int = 0) -> None:
        self._grasp = GraspShow(hand, object, seed)
        plant = self._grasp.plant
        controller = LookAndMoveController(KinematicModel(plant.hand, plant.object), plant.rotation_axis)
        loop = ClosedLoop(plant, controller)
        self.reaches: tuple[Reach, Reach] = tuple(  # type: ignore[assignment]
            loop.reach(sign=sign) for sign in (-1, 1)
        )
        back, forth = self.reaches
        self.path: tuple[GraspState, ...] = (*reversed(back.path), *forth.path[1:])
        self.angles_deg = np.degrees([*reversed(back.angles), *forth.angles[1:]])
        self.title = f"{plant.hand.name} turns {plant.object.name}"
        self._shown = len(back.path) - 1

    def rows(self) -> list[tuple[str, str, str]]:
        """Direction, angle [deg], and what ends it."""
        return [
            (name, f"{math.degrees(reach.angle):.1f}", reach.ends_by)
            for name, reach in zip(("back", "forth"), self.reaches, strict=True)
        ]

    def scene(self) -> Scene:
        """From the grasp to one end, to the other, and home."""
        n, middle = len(self.path), self._shown
        order = [*range(middle, n), *range(n - 2, -1, -1), *range(1, middle + 1)]
        return self._scene([self.path[k] for k in order])

    def add_controls(self, gui: Any) -> None:
        """A slider for the angle [deg], and what ends the turn."""
        low, high = float(self.angles_deg[0]), float(self.angles_deg[-1])
        high = max(high, low + 1)
        self._slider = gui.add_slider("angle [deg]", min=low, max=high, step=0.5, initial_value=0.0)
        gui.add_markdown("\n\n".join(f"**{angle} deg**: {end}" for _, angle, end in self.rows()))

    def update(self) -> Array | None:
        """Where everything is at the slider's angle, ``(n_shapes, 4, 4)``; None if nothing has moved."""
        wanted = int(np.abs(self.angles_deg - self._slider.value).argmin())
        if wanted == self._shown:
            return None
        self._shown = wanted
        return self._scene([self.path[wanted]]).transforms[0]

    def _scene(self, states: list[GraspState]) -> Scene:
        parts = ([getattr(state, name).numpy() for state in states] for name in ("q", "position", "rotation"))
        return self._grasp.scene_of(*map(np.stack, parts))
