"""A hand that opens and closes, and a grasp whose actuators are moved: what there is to look at."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from ...description import HandDescription
from ...kinematics import ActuationMap
from ...plant import PlantStatus
from ...rendering import Scene, make_scene
from ...rendering.visuals import visuals
from ...simulation import SimulatedHand
from ...typing import Array
from .words import as_html

_FRAMES = 10  # of one actuator's way through its range
_STEP_DEG = 3.0  # most that the grasp's actuators are moved at once: the object has time to follow


class HandShow:
    """``q(a) = argmin 1/2 q^T K_s q  s.t.  J_a q = a - a_0,  C q = 0``: the hand that touches nothing.

    Joint stops are kept. One slider for each actuator; as a page, each closes and opens in turn.
    """

    def __init__(self, hand: HandDescription) -> None:
        self.hand, self._map = hand, ActuationMap(hand)
        self._lower, self._upper = np.array([(part.lower, part.upper) for part in hand.actuators]).T
        self._a = np.clip(np.zeros(hand.n_a), self._lower, self._upper)
        self.title = hand.name
        self.notes = visuals(hand.urdf).problems
        """What could not be drawn."""

    def scene(self) -> Scene:
        """A frame for each of 20 postures of every actuator's way through its range, one after another."""
        postures = [self._a]
        for i in range(self.hand.n_a):
            for part in np.r_[np.linspace(0, 1, _FRAMES), np.linspace(1, 0, _FRAMES)]:
                a = self._a.copy()
                a[i] += part * (self._upper[i] - a[i])
                postures.append(a)
        return self._scene(np.array(postures))

    def add_controls(self, gui: Any) -> None:
        """A slider for each actuator, its position [deg] within its range."""
        ranges = np.degrees([self._lower, self._upper, self._a]).T.tolist()
        self._sliders = [
            gui.add_slider(f"{name} [deg]", min=low, max=high, step=0.5, initial_value=start)
            for name, (low, high, start) in zip(self.hand.actuator_names, ranges, strict=True)
        ]

    def update(self) -> Array | None:
        """Where everything is now, ``(n_shapes, 4, 4)``; None if nothing has moved."""
        a = np.radians([slider.value for slider in self._sliders])
        if np.array_equal(a, self._a):
            return None
        self._a = a
        return self._scene(a[None]).transforms[0]

    def _scene(self, a: Array) -> Scene:
        q = self._map.joints(torch.from_numpy(a)).numpy().clip(self.hand.joint_lower, self.hand.joint_upper)
        return make_scene(self.hand, None, q, None, None, np.array(self.hand.gravity))


class GraspShow:
    """A pinch in the simulated hand. Served, its actuators can be moved; as a page, it is closed and held.

    Raises:
        EquilibriumError, GraspError: the object cannot be pinched by this hand.
    """

    def __init__(self, hand: str, object: str, seed: int = 0) -> None:
        self.plant = SimulatedHand(hand, object)
        self._seed = seed
        self._seen = self.plant.reset(seed)
        self._start = self._seen.a.numpy()
        self.title = f"{self.plant.hand.name} holds {self.plant.object.name}"

    def scene(self) -> Scene:
        """One frame: the true state of the grasp as it is now, hand frame."""
        return self.scene_of(*(part[None] for part in self.plant.hand_state()))

    def scene_of(self, q: Array, position: Array, rotation: Array) -> Scene:
        """A frame for each posture and pose, seen along the axis about which the object turns."""
        hand, axis = self.plant.hand, self.plant.rotation_axis.numpy()
        return make_scene(hand, self.plant.object, q, position, rotation, np.array(hand.gravity), axis=axis)

    def add_controls(self, gui: Any) -> None:
        """A slider for each actuator, increments since the grasp [deg], and a button to grasp again."""
        self._sliders = [
            gui.add_slider(f"{name} [deg]", min=-30.0, max=30.0, step=0.5, initial_value=0.0)
            for name in self.plant.hand.actuator_names
        ]
        self._clicked = False

        def click(_: Any) -> None:  # in a thread of viser's: the simulation belongs to another
            self._clicked = True

        gui.add_button("Grasp again").on_click(click)
        self._note = gui.add_html(self._words())

    def update(self) -> Array | None:
        """Move the actuators towards the sliders; where everything is now, None if nothing has moved."""
        if self._clicked:
            self._clicked = False
            for slider in self._sliders:
                slider.value = 0.0
            self._seen = self.plant.reset(self._seed)
            self._start = self._seen.a.numpy()
        else:
            wanted = self._start + np.radians([slider.value for slider in self._sliders])
            delta = wanted - self._seen.a.numpy()
            if np.abs(delta).max() < math.radians(0.25):
                return None
            limit = math.radians(_STEP_DEG)
            before = self._seen.a
            self._seen = self.plant.command(torch.from_numpy(delta.clip(-limit, limit)))
            if torch.equal(before, self._seen.a):  # at the end of an actuator's range
                return None
        self._note.content = self._words()
        return self.scene().transforms[0]

    def _words(self) -> str:
        force, shown = self._seen.fingertip_force, "no sensors"
        if force is not None:
            forces = zip(self.plant.hand.pads, force.tolist(), strict=True)
            shown = ", ".join(f"{pad.name} {force:.1f} N" for pad, force in forces if force > 0)
        status = "lost" if self._seen.status is PlantStatus.LOST else "held"
        return as_html([f"The object is {status}; fingertips: {shown or 'nothing'}."])
