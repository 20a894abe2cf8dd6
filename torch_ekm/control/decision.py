"""What a controller decides, what it expects of it, and why there may be no decision."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, NamedTuple

from ..typing import Float, Tensor

if TYPE_CHECKING:
    from ..model import Linearization


class StopReason(Enum):
    """Why a manipulation ended; ``RUNNING`` while it has not."""

    RUNNING = "running"
    REACHED = "reached"
    STALLED = "stalled"
    STEP_LIMIT = "step limit"
    ACTUATOR_LIMITS = "actuator limits"
    UNSTABLE_GRASP = "unstable grasp"
    GIVEN_UP = "given up"
    """With the object in the hand, see :class:`~torch_ekm.control.Caution`."""
    WEAK_GRASP = "weak grasp"
    """Declined before anything turned: a finger bears less than the object needs, and grips no better."""
    OUT_OF_REACH = "out of reach"
    """Declined before anything moved, see ``decline`` of :class:`~torch_ekm.control.ClosedLoop`."""
    OBJECT_LOST = "object lost"
    STOPPED = "stopped"
    """By :meth:`ClosedLoop.stop`, or by Ctrl-C."""
    PLANT_FAILED = "plant failed"
    """It raised ``Stop.cause``: its bus, a sensor, a reading of the wrong length."""
    COMMAND_REFUSED = "command refused"
    """By the :class:`~torch_ekm.plant.Gate` or the driver, before anything moved: see ``Stop.cause``."""
    WRONG_WAY = "wrong way"
    """See :attr:`~torch_ekm.control.Guards.wrong_way`."""
    STALE_SENSOR = "stale sensor"
    """This and what follows: see :class:`~torch_ekm.control.Guards`."""
    BLIND = "object not seen"
    ENCODER_JUMP = "encoder jump"
    ENCODER_DRIFT = "encoder drift"
    JOINT_JUMP = "joint jump"
    POSE_JUMP = "pose jump"
    OUT_OF_RANGE = "reading out of range"
    FINGERTIP_FAULT = "fingertip fault"
    ACTUATOR_STUCK = "actuator stuck"
    SPEED_CEILING = "speed ceiling"
    FORCE_CEILING = "force ceiling"


class Grip(NamedTuple):
    """What the fingers in contact bear before a motion."""

    force: Float[Tensor, " n_c"]
    """f_n, as measured, or as estimated where a pad does not measure [N]."""
    least: Float[Tensor, " n_c"]
    """What each should bear at least, see :class:`~torch_ekm.control.NormalForceLimit` [N]."""
    std: Float[Tensor, " n_c"]
    """How far predictions of it are off [N]; 0 where it is unknown."""
    wanted: float
    """Of the finger that opposes the others, see :class:`~torch_ekm.control.GripForceTask` [N]; 0: none."""


@dataclass(frozen=True)
class Decision:
    """The motion that the controller chose, what it predicts, and with which uncertainty."""

    delta_a: Float[Tensor, " n_a"]
    """Increment to command, relative to the encoders [rad]."""
    status: StopReason
    """RUNNING, or why no increment can be given."""
    desired: Float[Tensor, " n_x"]
    """dx_d, the limited error of the focused pose [rad, m]."""
    predicted: Float[Tensor, " n_s"]
    """(f + g)(s, da)."""
    nominal: Float[Tensor, " n_s"]
    """J_m da of the hand as described: what the kinematic model alone predicts."""
    share: float = 1.0
    """Of the largest step that the pace allows."""
    limited: bool = False
    """The step could not be met in full because actuators stand at their limits."""
    slack: float = 0.0
    """Largest focused error that the step leaves unmet, as a turn [rad]."""
    linearization: Linearization | None = None
    """The kinematic model at the state; None where it has none."""
    message: str = ""
    """Why there is no increment."""
    grip: Grip | None = None
    """None: no forces are known, or no :class:`~torch_ekm.control.NormalForceLimit` asks for any."""


class Expectation(NamedTuple):
    """What f + g predict of a motion that the encoders made."""

    moved: Float[Tensor, " n_a"]
    """w, of the encoders [rad]."""
    nominal: Float[Tensor, " n_s"]
    """f(s, w) = J_m w [rad, m, rad]."""
    increment: Float[Tensor, " n_s"]
    """(f + g)(s, w) [rad, m, rad]."""
    deviation: Float[Tensor, " n_s"]
    """Standard deviation of g(s, w) [rad, m, rad]; 0 where nothing is learned."""
