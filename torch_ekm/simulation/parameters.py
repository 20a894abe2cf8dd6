"""What the simulated hand really is, where it differs from its description."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

from ..exceptions import ParameterError
from ..typing import Array


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

    # -- the mechanism is of another kind than its description
    arm_variation: float = 0.0
    """v: moment arms vary with the joint angle, ``J_a (1 + v sin(2 q + phase))``, as those of pulleys that
    are not round; joints of rigid couplings keep theirs."""
    arm_phase: float = 0.0
    """Bound of the phase of each joint [rad]; drawn once, from ``hardware_seed``."""
    spring_stiffening: float = 0.0
    """s: joint springs stiffen, ``k x (1 + s x^2)``, x from their rest [rad]; negative: they sag."""
    cable_friction: float = 0.0
    """Share of the cables' torque at a joint that friction holds, ``1 - exp(-mu w)`` of a cable that is wound
    by w round its pulleys (capstan)."""
    hysteresis: float = 0.0
    """Full width of the transmissions' hysteresis, as a share of their torque."""
    tendon_coupling: float = 0.0
    """The pull of one tendon lengthens the others: their share of its own stretch, below 1."""
    joint_play: float = 0.0
    """Full width of the play of one joint of each finger [rad]; which one is drawn from ``hardware_seed``."""
    joint_law: Callable[[Array, Array], Array] | None = None
    """A law of one's own: torques that it adds at the joints ``(n_q,)`` [N m], of their angles ``(n_q,)``
    [rad] and the torques of the actuators ``(n_a,)`` [N m], asked at each time step. It may remember: each
    grasp begins with a copy. Grasps are planned without it; slopes of some N m/rad are not stable."""
    contact_stiffness: float = 0.0
    """Of each contact [N/m]: pads give way; 0: they do not. A change holds from the next grasp on."""

    # -- the object
    friction: float = 1.0
    """Factor on the friction coefficient."""
    friction_unevenness: float = 0.0
    """One side of the object has so much less friction, as a share, 0.5 at most: that of the finger which
    opposes the others, or theirs, as ``hardware_seed`` has it."""
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
    force_scale: float = 1.0
    """Each fingertip reads its force times a factor between 1/x and x; drawn once, from ``hardware_seed``."""
    force_drift: float = 0.0
    """Bound of how fast the reading of each fingertip drifts, from no error at the start of a grasp [N/s];
    drawn once, from ``hardware_seed``."""
    force_hysteresis: float = 0.0
    """Full width of the play between force and reading [N]."""
    force_range: float = 0.0
    """Full scale of an 8-bit converter [N]; 0: not quantised."""
    frame_rate: float = 20.0
    """Of the camera [1/s]."""
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
            if field.name in ("stuck_joints", "joint_law"):
                continue
            entries = value if isinstance(value, tuple) else (value,)
            if not all(math.isfinite(entry) for entry in entries):
                raise ParameterError(field.name, value, "finite")
            if field.name in _POSITIVE and not all(entry > 0 for entry in entries):
                raise ParameterError(field.name, value, "greater than 0")
            if field.name not in _POSITIVE | _SIGNED and not all(entry >= 0 for entry in entries):
                raise ParameterError(field.name, value, "0 or more")
        for name, (valid, most) in _BELOW.items():
            if abs(getattr(self, name)) > most:
                raise ParameterError(name, getattr(self, name), valid)
        if self.force_scale < 1:
            raise ParameterError("force_scale", self.force_scale, "1 or more")

    def replace(self, **changes: object) -> PlantParameters:
        """A copy in which some figures, given by name in their SI units, are changed."""
        known = {field.name for field in dataclasses.fields(self)}
        for name in changes:
            if name not in known:
                raise ParameterError("parameter", name, f"one of {', '.join(sorted(known))}")
        return dataclasses.replace(self, **changes)  # type: ignore[arg-type]


_POSITIVE = {"moment_arm", "spring", "servo_stiffness", "friction", "mass", "object_scale", "frame_rate"}
_SIGNED = {"com_shift", "spring_stiffening", "arm_variation"}
_BELOW = {
    "arm_variation": ("between -0.9 and 0.9", 0.9),
    "cable_friction": ("between 0 and 0.9", 0.9),
    "hysteresis": ("between 0 and 1", 1.0),
    "tendon_coupling": ("between 0 and 0.9", 0.9),
    "friction_unevenness": ("between 0 and 0.5", 0.5),
    "frame_loss": ("a chance between 0 and 1", 1.0),
}
