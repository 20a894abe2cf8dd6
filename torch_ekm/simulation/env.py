"""The simulated hand as a Gymnasium environment.

Importing this module registers ``torch_ekm/InHandRotation-v0``;
``gymnasium.make("torch_ekm.simulation.env:torch_ekm/InHandRotation-v0")`` does both at once.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from .._extras import require
from ..description import HandDescription, ObjectDescription
from ..exceptions import ParameterError, UnknownNameError
from ..kinematics.poses import log
from ..plant import Observation, PlantStatus
from ..rendering import Picture, make_scene
from ..typing import Array
from .parameters import PlantParameters
from .presets import preset
from .simulated_hand import SimulatedHand

if TYPE_CHECKING:
    import gymnasium
else:
    gymnasium = require("gymnasium")

_DEG = math.pi / 180
_OFF_AXIS = 0.1  # weight of rotation off the axis in the reward
_TOLERANCE = 0.5 * _DEG  # the goal is reached within this [rad]
_LOST = 10.0  # what losing the object costs


class InHandRotation(gymnasium.Env):
    """Turn a pinched object about the axis of its grasp, by increments of the actuators.

    **Action** ``(n_a,)``, in [-1, 1]: increment of each actuator in units of ``step_limit`` [rad].

    **Observation** ``(n_q + n_a + 3 + 3 + n_pads + 2,)``, float64, as the sensors say, never the truth:

    ============== ======= ==============================================================
    entries        unit    what
    ============== ======= ==============================================================
    n_q            rad     joint angles
    n_a            rad     actuator encoders
    3              m       position of the object since the reset, hand frame
    3              rad     its rotation vector since the reset, hand frame
    n_pads         N       normal force of each fingertip; none without ``force_sensors``
    1              rad     angle turned so far, about the grasp's axis
    1              rad     angle still to turn
    ============== ======= ==============================================================

    **Reward** per step: ``-|angle to go|`` in units of 10 deg, -0.1 times the rotation about
    other axes in the same unit, +1 at the goal, -10 when the object is lost.

    **Ends** at the goal (within 0.5 deg) or with the object lost; truncated after 40 steps by the
    registered time limit. ``info`` has ``is_success``, ``status`` and ``truth`` (for reports).

    ``reset(options={"angle": rad})`` sets the target; else it is drawn from ``angles``.

    Args:
        hand, object: names, paths or descriptions.
        parameters: plant parameters, or the name of a preset.
        angles: least and largest target [rad].
        render_mode: None or "rgb_array" (PyVista).
        engine: the physics, as :class:`SimulatedHand` takes it.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 2}
    step_limit = 3 * _DEG
    """Largest increment of an actuator [rad]."""

    def __init__(
        self,
        hand: HandDescription | str | Path = "icub_right",
        object: ObjectDescription | str | Path = "box",
        parameters: PlantParameters | str = "nominal",
        angles: tuple[float, float] = (5 * _DEG, 25 * _DEG),
        render_mode: str | None = None,
        engine: str = "sapien",
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ParameterError("render_mode", render_mode, "None or 'rgb_array'")
        if np.shape(angles) != (2,) or not -math.pi < angles[0] <= angles[1] < math.pi:
            raise ParameterError("angles", angles, "the least and the largest target [rad], below pi")
        if isinstance(parameters, str):
            parameters = preset(parameters)
        self.plant = SimulatedHand(hand, object, parameters=parameters, engine=engine)
        self.angles, self.render_mode = angles, render_mode
        self._picture: Picture | None = None
        n_q, n_a = self.plant.hand.n_q, self.plant.hand.n_a
        bounds = (math.pi, 2 * math.pi, 1.0, math.pi, 100.0, 2 * math.pi)
        n_pads = len(self.plant.hand.pads) if parameters.force_sensors else 0
        high = np.repeat(bounds, (n_q, n_a, 3, 3, n_pads, 2))
        self.observation_space = gymnasium.spaces.Box(-high, high, dtype=np.float64)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (n_a,), dtype=np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Grasp the object again and draw a target.

        Raises:
            ParameterError: ``options["angle"]`` is no angle below pi.
            UnknownNameError: there is no such option.
        """
        for name, value in (options or {}).items():
            if name != "angle":
                raise UnknownNameError("option", name, ["angle"])
            if np.ndim(value) or not abs(float(value)) < math.pi:
                raise ParameterError("options['angle']", value, "an angle below pi [rad]")
        super().reset(seed=seed)
        self._target = float((options or {}).get("angle", self.np_random.uniform(*self.angles)))
        self._start = self.plant.reset(int(self.np_random.integers(2**31)))
        self._axis = self.plant.rotation_axis
        return self._observed(self._start)[:2]

    def step(self, action: NDArray[Any]) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Move the actuators and let the hand settle."""
        delta = np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0) * self.step_limit
        observation = self.plant.command(torch.from_numpy(delta))
        observed, info, to_go, off = self._observed(observation)
        lost, reached = observation.status is PlantStatus.LOST, info["is_success"]
        reward = -(abs(to_go) + _OFF_AXIS * off) / (10 * _DEG) + reached - _LOST * lost
        return observed, float(reward), lost or reached, False, info

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """A picture ``(height, width, 3)`` of the true state, or None without a render mode."""
        if self.render_mode is None:
            return None
        hand, truth = self.plant.hand, self._truth
        q, position, rotation = (part[None].numpy() for part in (truth.q, truth.position, truth.rotation))
        scene = make_scene(hand, self.plant.object, q, position, rotation, np.array(hand.gravity))
        if self._picture is None:
            self._picture = Picture(scene.meshes)
        return self._picture.draw(scene.transforms, scene.camera)

    def close(self) -> None:
        """Give back the scene and the window."""
        self.plant.close()
        if self._picture is not None:
            self._picture.close()
            self._picture = None

    def _observed(self, observation: Observation) -> tuple[Array, dict[str, Any], float, float]:
        """Observation and info; the angle still to turn about the grasp's axis, and what turned about others
        since the reset [rad]."""
        assert observation.truth is not None  # the plant is simulated
        self._truth = observation.truth
        rotation = log(observation.rotation @ self._start.rotation.mT)
        turned = float(rotation @ self._axis)
        to_go, off = self._target - turned, float(torch.linalg.vector_norm(rotation - turned * self._axis))
        parts = (
            observation.q,
            observation.a,
            observation.position - self._start.position,
            rotation,
            *(() if observation.fingertip_force is None else (observation.fingertip_force,)),
            torch.tensor([turned, to_go], dtype=torch.float64),
        )
        space: Any = self.observation_space
        info = {
            "is_success": observation.status is not PlantStatus.LOST and abs(to_go) < _TOLERANCE,
            "status": observation.status.value,
            "truth": {name: value.numpy() for name, value in self._truth.arrays().items()},
        }
        return np.clip(torch.cat(parts).numpy(), space.low, space.high), info, to_go, off


gymnasium.register("torch_ekm/InHandRotation-v0", f"{__name__}:InHandRotation", max_episode_steps=40)
