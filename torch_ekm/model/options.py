"""What the kinematic model takes into account."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..contact.forces import ForceOptions
from ..exceptions import ParameterError


@dataclass(frozen=True)
class ModelOptions:
    """Options of :class:`~torch_ekm.model.KinematicModel`.

    Raises:
        ParameterError: a value outside its range.
    """

    rolling: bool = True
    """Contact points run over the surfaces. False treats them as pinned."""
    actuator_compliance: bool = True
    """Use the actuators' series stiffness K_a where it is finite. False: all rigid."""
    slack_tension: float | None = 0.0
    """A tendon that pulls with at most this much [N, or N m for a in rad] is slack: it moves nothing. None:
    all stay taut, as rods do, at any force."""
    contact_margin: float = 0.002
    """Gap up to which the detector takes a pad for touching [m]; more for noisy poses."""
    max_overlap: float = 0.005
    """Deepest penetration of finger and object that is still modelled [m]."""
    on_unstable: str = "raise"
    """"raise" UnstableGraspError, or "flag": return the formal Jacobian with status "unstable"."""
    forces: ForceOptions = field(default_factory=ForceOptions)

    def __post_init__(self) -> None:
        if self.on_unstable not in ("raise", "flag"):
            raise ParameterError("on_unstable", self.on_unstable, "'raise' or 'flag'")
        if not self.max_overlap > 0:
            raise ParameterError("max_overlap", self.max_overlap, "positive")
        if not self.contact_margin >= 0:
            raise ParameterError("contact_margin", self.contact_margin, "not negative")
        if self.slack_tension is not None and not self.slack_tension >= 0:
            raise ParameterError("slack_tension", self.slack_tension, "not negative, or None")
