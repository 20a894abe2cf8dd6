"""What the kinematic model takes into account."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from ..contact.contact_set import CHARACTERISTIC_LENGTH
from ..contact.forces.options import ForceOptions
from ..exceptions import ParameterError


@dataclass(frozen=True)
class ModelOptions:
    """Options of :class:`~torch_ekm.model.KinematicModel`.

    Raises:
        ParameterError: a value outside its range.
    """

    gravity: tuple[float, float, float] | None = None
    """g in the **hand frame** [m/s^2], constant while the hand's pose is static. None: the hand's."""
    link_weights: bool = False
    """Count the weight of the hand's own links (masses of its URDF)."""
    length: float = CHARACTERISTIC_LENGTH
    """L, characteristic length [m], of the order of the object's size. Translations and moments are divided
    by it where they are compared with rotations and forces: in rank decisions and in the force problem."""
    hand_stiffness: bool = True
    """Keep S, the change of moment arms with posture. False only for ablation."""
    object_stiffness: bool = True
    """Keep T, the object's lever arms. False only for ablation."""
    rolling: bool = True
    """Contact points run over the surfaces. False treats them as pinned."""
    actuator_compliance: bool = True
    """Use the actuators' series stiffness K_a where it is finite. False: all rigid."""
    contact_stiffness: float = math.inf
    """K_c of every force row of a contact [N/m], and K_c L^2 of a spin row [N m/rad]; infinite: rigid."""
    slack_tension: float | None = 0.0
    """A tendon that pulls with at most this much [N, or N m for a in rad] is slack: it moves nothing. None:
    all stay taut, as rods do, whatever the forces say."""
    stiffness_floor: float = 0.0
    """Added to every joint's stiffness [N m/rad]: a floor for springless free joints, e.g. 1e-4."""
    contact_margin: float = 0.002
    """Gap up to which the detector takes a pad for touching [m]; more for noisy poses."""
    crown_radius: float = 0.5
    """Of the slight crown along a pad where it lies flat on a flat face [m], which gives that line of contact
    a point; infinite: none, and the point jumps from end to end as the finger tilts."""
    link_margin: float = 0.001
    """Gap up to which a link that is no pad is reported as touching [m]."""
    max_overlap: float = 0.005
    """Deepest penetration of finger and object that is still modelled [m]."""
    stop_tolerance: float = math.radians(0.1)
    """How near to a limit a joint counts as touching its stop [rad]. Joint angles alone cannot tell how
    much torque a stop takes from the contact forces: fingertip sensors can, so give them if there are any."""
    stop_torque: float = 0.01
    """Torque above which a stop holds its joint [N m]; below, the joint may leave."""
    on_unstable: str = "raise"
    """"raise" UnstableGraspError, or "flag": return the formal Jacobian with status "unstable"."""
    forces: ForceOptions = field(default_factory=ForceOptions)

    def __post_init__(self) -> None:
        if self.on_unstable not in ("raise", "flag"):
            raise ParameterError("on_unstable", self.on_unstable, "'raise' or 'flag'")
        for name in ("length", "max_overlap", "contact_stiffness", "crown_radius"):
            if not getattr(self, name) > 0:
                raise ParameterError(name, getattr(self, name), "positive")
        for name in ("stiffness_floor", "stop_tolerance", "stop_torque", "contact_margin", "link_margin"):
            if not getattr(self, name) >= 0:
                raise ParameterError(name, getattr(self, name), "not negative")
        if self.slack_tension is not None and not self.slack_tension >= 0:
            raise ParameterError("slack_tension", self.slack_tension, "not negative, or None")
        if self.gravity is not None and (len(self.gravity) != 3 or not all(map(math.isfinite, self.gravity))):
            raise ParameterError("gravity", self.gravity, "three finite numbers [m/s^2]")
