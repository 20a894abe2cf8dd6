"""How bad it is: named sets of plant parameters."""

from __future__ import annotations

import math
from collections.abc import Callable

from ..exceptions import UnknownNameError
from .parameters import PlantParameters

_DEG = math.pi / 180


def _worn() -> PlantParameters:
    """After some hundred manipulations: slack, friction and play have grown."""
    return PlantParameters.nominal_mismatch().replace(
        spring=0.7,
        servo_stiffness=0.4,
        joint_friction=2.0,
        tendon_elongation=2.0 * _DEG,
        tendon_creep=5e-4,
        friction=0.85,
        actuator_bias=0.4 * _DEG,
        actuator_error=0.3 * _DEG,
        dead_zone=1.6 * _DEG,
        backlash=0.8 * _DEG,
        joint_noise=0.5 * _DEG,
        position_noise=0.0003,
        rotation_noise=0.2 * _DEG,
        force_noise=0.15,
        force_offset=0.2,
        force_hysteresis=0.2,
        latency=0.05,
        frame_loss=0.02,
    )


def _hostile() -> PlantParameters:
    """Nothing is as described, and a sensor is dead."""
    return _worn().replace(
        moment_arm=1.4,
        spring=0.5,
        servo_stiffness=0.25,
        joint_friction=3.0,
        tendon_elongation=4.0 * _DEG,
        tendon_creep=2e-3,
        friction=0.75,
        mass=1.3,
        com_shift=(0.005, 0.004, 0.0),
        object_scale=1.03,
        actuator_bias=0.8 * _DEG,
        actuator_error=0.6 * _DEG,
        dead_zone=2.0 * _DEG,
        backlash=1.0 * _DEG,
        joint_noise=1.0 * _DEG,
        position_noise=0.0005,
        rotation_noise=0.4 * _DEG,
        force_noise=0.3,
        force_offset=0.4,
        force_hysteresis=0.4,
        latency=0.15,
        frame_loss=0.1,
        stuck_joints=("index_3",),
    )


PRESETS: dict[str, Callable[[], PlantParameters]] = {
    "none": PlantParameters.exact,
    "nominal": PlantParameters.nominal_mismatch,
    "worn": _worn,
    "hostile": _hostile,
}


def preset(name: str) -> PlantParameters:
    """The parameters called "none", "nominal", "worn" or "hostile".

    Raises:
        UnknownNameError: there is no such preset; the message lists them.
    """
    if name not in PRESETS:
        raise UnknownNameError("preset", name, PRESETS)
    return PRESETS[name]()
