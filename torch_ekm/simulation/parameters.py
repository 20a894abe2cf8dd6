"""What the simulated hand really is, where it differs from its description."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

from ..exceptions import ParameterError


@dataclass(frozen=True)
class PlantParameters:
    """The plant, relative to its nominal description; ``PlantParameters()`` is the description itself.

    Units are SI, angles [rad]. Factors multiply the description's figure.

    Raises:
        ParameterError: a figure is not finite, or outside its range.
    """

    # -- the mechanism
    moment_arm: float | tuple[float, ...] = 1.0
    """Factor on J_a: pulley radii at the joints; one for all, or one per actuator. Above 1 the
    joints turn less than the model says."""
    spring: float = 1.0
    """Factor on the joint springs K_s."""
    servo_stiffness: float = 1.0
    """Factor on the series stiffness of tendon and servo."""
    joint_friction: float = 0.0
    """Factor on the description's Coulomb friction of the joints; the kinematic model has none."""
    tendon_elongation: float = 0.0
    """Permanent lengthening of every tendon, at its actuator [rad]."""
    tendon_creep: float = 0.0
    """Further lengthening per torque and time [rad/(N m s)]; each grasp starts without it."""
    link_weight: bool = False
    """Gravity pulls at the fingers too (the kinematic model leaves their weight out)."""

    # -- the object
    friction: float = 1.0
    """Factor on the friction coefficient."""
    mass: float = 1.0
    """Factor on the object's mass and inertia."""
    com_shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Shift of the centre of mass, object frame [m]."""
    object_scale: float = 1.0
    """Factor on the object's shapes (its mass stays)."""

    # -- the position controller
    actuator_bias: float = 0.0
    """Bound of a constant error of each actuator [rad]; drawn once, from ``hardware_seed``."""
    actuator_error: float = 0.0
    """Bound of an error drawn again at every command [rad], uniform."""
    dead_zone: float = 0.0
    """Coulomb dead band: an actuator stops short of its set-point by this [rad]."""
    backlash: float = 0.0
    """Full width of the play between motor and tendon [rad], added to that of the description."""

    # -- the sensors
    joint_noise: float = 0.0
    """Standard deviation of a joint angle [rad]."""
    position_noise: float = 0.0
    """Standard deviation of the object's position, per axis [m]."""
    rotation_noise: float = 0.0
    """Standard deviation of the object's orientation, per axis [rad]."""
    force_sensors: bool = True
    """The fingertips measure forces; without, ``Observation.fingertip_force`` is None."""
    force_noise: float = 0.0
    """Standard deviation of the force of a fingertip that touches [N]."""
    force_offset: float = 0.0
    """Bound of a constant error of each fingertip [N]; drawn once, from ``hardware_seed``."""
    force_hysteresis: float = 0.0
    """Full width of the play between force and reading [N]."""
    force_range: float = 0.0
    """Full scale of an 8-bit converter [N]; 0: not quantised."""
    latency: float = 0.0
    """Age of the camera's picture [s]."""
    frame_loss: float = 0.0
    """Chance that the object is not seen in an observation."""
    stuck_joints: tuple[str, ...] = ()
    """Joints whose sensor keeps its first reading."""

    hardware_seed: int = 0
    """Which hardware instance: signs and sizes of the constant errors."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name == "stuck_joints":
                continue
            entries = value if isinstance(value, tuple) else (value,)
            if not all(math.isfinite(entry) for entry in entries):
                raise ParameterError(field.name, value, "finite")
            if field.name in _POSITIVE and not all(entry > 0 for entry in entries):
                raise ParameterError(field.name, value, "greater than 0")
            if field.name not in _POSITIVE | {"com_shift"} and not all(entry >= 0 for entry in entries):
                raise ParameterError(field.name, value, "0 or more")
        if self.frame_loss > 1:
            raise ParameterError("frame_loss", self.frame_loss, "a chance between 0 and 1")

    def replace(self, **changes: object) -> PlantParameters:
        """A copy in which some figures, given by name in their SI units, are changed."""
        known = {field.name for field in dataclasses.fields(self)}
        for name in changes:
            if name not in known:
                raise ParameterError("parameter", name, f"one of {', '.join(sorted(known))}")
        return dataclasses.replace(self, **changes)  # type: ignore[arg-type]


_POSITIVE = {"moment_arm", "spring", "servo_stiffness", "friction", "mass", "object_scale"}
