"""Named sets of plant parameters: how far the plant is from its description."""

from __future__ import annotations

import math
from typing import Any

from ..exceptions import UnknownNameError
from .parameters import PlantParameters

_DEG = math.pi / 180

# "nominal": what a used iCub hand is thought to have. Tendons run on pulleys 1.3 times as large as modelled
# and stretch twice as much; joints rub; the position controller stops up to 1.3 deg short of its set-point
# and has a constant error, a fresh one and play: somewhat more than the +-1 deg of the E-KM paper (section
# III.C.4), since with less a plain KM does not stall nearly as far off as the paper's 1 to 3 deg (here 0.8 to
# 1.2). The fingers have weight, the object is 10 % heavier, its centre 2 mm off. Sensors: 0.3 deg per joint,
# 0.2 mm and 0.15 deg for the object (a marker board seen from 0.4 m), 0.1 N each of noise, offset and
# hysteresis per fingertip, in 8 bit.
# "worn": after some hundred manipulations slack, friction and play have grown.
# "hostile": nothing is as described, and a sensor is dead.
_FIGURES: dict[str, tuple[Any, Any, Any]] = {  # nominal, worn, hostile
    "moment_arm": (1.3, 1.3, 1.4),
    "spring": (0.8, 0.7, 0.5),
    "servo_stiffness": (0.5, 0.4, 0.25),
    "joint_friction": (1.0, 2.0, 3.0),
    "tendon_elongation": (0.0, 2.0 * _DEG, 4.0 * _DEG),
    "tendon_creep": (0.0, 5e-4, 2e-3),
    "link_weight": (True, True, True),
    "friction": (0.9, 0.85, 0.75),
    "mass": (1.1, 1.1, 1.3),
    "com_shift": ((0.002, 0.002, 0.0), (0.002, 0.002, 0.0), (0.005, 0.004, 0.0)),
    "object_scale": (1.0, 1.0, 1.03),
    "actuator_bias": (0.2 * _DEG, 0.4 * _DEG, 0.8 * _DEG),
    "actuator_error": (0.1 * _DEG, 0.3 * _DEG, 0.6 * _DEG),
    "dead_zone": (1.3 * _DEG, 1.6 * _DEG, 2.0 * _DEG),
    "backlash": (0.5 * _DEG, 0.8 * _DEG, 1.0 * _DEG),
    "joint_noise": (0.3 * _DEG, 0.5 * _DEG, 1.0 * _DEG),
    "position_noise": (0.0002, 0.0003, 0.0005),
    "rotation_noise": (0.15 * _DEG, 0.2 * _DEG, 0.4 * _DEG),
    "force_noise": (0.1, 0.15, 0.3),
    "force_offset": (0.1, 0.2, 0.4),
    "force_hysteresis": (0.1, 0.2, 0.4),
    "force_range": (15.0, 15.0, 15.0),
    "latency": (0.0, 0.05, 0.15),
    "frame_loss": (0.0, 0.02, 0.1),
    "stuck_joints": ((), (), ("index_3",)),
}
_USED = {
    name: PlantParameters(**{key: levels[k] for key, levels in _FIGURES.items()})
    for k, name in enumerate(("nominal", "worn", "hostile"))
}
# "odd_1" to "odd_5": used hands that are of another kind than their description, mixtures of what others
# than ours may be. Strengths are those of the families in docs/benchmarks/objects.md.
_ODD: tuple[dict[str, Any], ...] = (
    {"arm_variation": 0.25, "arm_phase": math.pi, "spring_stiffening": 0.5},
    {"arm_variation": 0.2, "arm_phase": math.pi, "spring_stiffening": -0.3, "hysteresis": 0.1},
    {"cable_friction": 0.1, "tendon_coupling": 0.1, "friction_unevenness": 0.4},
    {"contact_stiffness": 5e3, "joint_play": 1.5 * _DEG, "force_scale": 1.5},
    {
        "arm_variation": 0.12, "arm_phase": math.pi, "spring_stiffening": 0.25, "cable_friction": 0.05,
        "hysteresis": 0.05, "tendon_coupling": 0.05, "joint_play": 0.8 * _DEG, "contact_stiffness": 1e4,
        "friction_unevenness": 0.2, "force_scale": 1.3, "force_drift": 0.02,
    },
)  # fmt: skip
#: Name -> parameters: "none", "nominal", "worn", "hostile" and "odd_1" to "odd_5".
PRESETS = {
    "none": PlantParameters(),
    **_USED,
    **{f"odd_{k}": _USED["nominal"].replace(**figures) for k, figures in enumerate(_ODD, 1)},
}


def preset(name: str) -> PlantParameters:
    """The parameters called "none" (as described, perfect sensors), "nominal" (a used hand, which the
    residual learners are for), "worn", "hostile", or "odd_1" to "odd_5" (of another kind than described).

    Raises:
        UnknownNameError: there is no such preset; the message lists them.
    """
    if name not in PRESETS:
        raise UnknownNameError("preset", name, PRESETS)
    return PRESETS[name]
