"""Controllers that are compared: each is one of the bench's with something changed in its setting.

"As printed" is the paper's system around this package's J_m (the printed formulas cannot be right): forces
from the minimal-force problem alone, least motor increments that meet the limited error within the motors'
ranges, a plain sparse online GP of [q; p; da] with commanded da; no servo inverse, no grip, no plan, no bound
of a step, no gates on what teaches. "With tasks" adds this package's tasks of grip and off-axis motion.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from sessions import axes_of

from torch_ekm.contact.contacts import ContactKinematics
from torch_ekm.control import (
    DEFAULT_TASKS,
    ActuatorLimit,
    ClosedLoop,
    Direction,
    EffortTask,
    FocusedPose,
    FocusTask,
    Guards,
    LimitingFunction,
    LookAndMoveController,
    OneStep,
    Safety,
    StoppingRule,
    WholeTurn,
)
from torch_ekm.experiments.config import Setting
from torch_ekm.experiments.runner import Bench
from torch_ekm.kinematics.se3 import hat
from torch_ekm.model import KinematicModel, Linearization
from torch_ekm.model.stiffness import posture_stiffness
from torch_ekm.plant import Observation, Plant, PlantStatus
from torch_ekm.plant.plant import PlantWrapper
from torch_ekm.simulation.mechanism.assembly import true_hand, true_object

_DEG = math.pi / 180
_CAPACITY = 60  # basis vectors of the paper's learner, which gives no figure
#: Nothing is gated or watched for; readings that cannot be are still refused.
_NO_GUARDS = Guards(gate=math.inf, force_ceiling=math.inf, stuck_command=math.inf)


@dataclass(frozen=True)
class Contender:
    """A controller of the bench, what is other than in a :class:`Setting`, and the bench."""

    controller: str = "E-KM"
    changes: Mapping[str, Any] | Callable[[Setting], Mapping[str, Any]] = dataclasses.field(
        default_factory=dict
    )
    """Of the setting, or a function of it that gives them."""
    bench: type[Bench] = Bench

    def setting(self, base: Setting) -> Setting:
        """The plant's setting, changed."""
        changes = self.changes if isinstance(self.changes, Mapping) else self.changes(base)
        return base.replace(**changes)


class UnwatchedLoop(ClosedLoop):
    """Readings on the way end no movement."""

    def __init__(self, *given: Any, **options: Any) -> None:
        super().__init__(*given, **options)
        send = self.plant.send_path
        self.plant.send_path = lambda path, watch, *rest: send(path, lambda seen: True, *rest)


class UnwatchedBench(Bench):
    """Movements go to their end."""

    loops = UnwatchedLoop


class PlaceKept(Bench):
    """The object's place along the grip is a second direction of the focus."""

    def look_and_move(self, focus: FocusedPose | None = None) -> LookAndMoveController:
        along = Direction(axes_of(self)["b"], "mm", tolerance=0.3)
        return super().look_and_move(focus or FocusedPose([Direction(self.hand.rotation_axis, "deg"), along]))


class PrintedController(LookAndMoveController):
    """Contact forces of each state alone: neither pads nor the last forces speak for any."""

    def linearize(self, state: Any, a: Any, fingertip_force: Any) -> Linearization:
        return self.kinematic.linearize(state)


class PrintedBench(Bench):
    """The system as printed; its gain is this package's, for the paper gives none."""

    controllers = PrintedController


class MisprintedModel(KinematicModel):
    """``D = [[V_qq + S, 0], [T, V_pp]]``, ``T = + dG/dtheta mu``: the printed K, letter by letter.

    It is that of pinned contacts which the fingers carry, with the wrong sign of T. Grasps that it takes for
    unstable are turned all the same.
    """

    def load_stiffness(self, kin: ContactKinematics, force: Any, spin_moment: Any) -> Any:
        D, n_q, plain = 0 * super().load_stiffness(kin, force, spin_moment), self.hand.n_q, kin.point_jacobian
        D[..., :n_q, :n_q] = posture_stiffness(force, plain.mT, kin.axis, self.precedes)
        D[..., n_q + 3 :, :n_q] = -(hat(force) @ plain).sum(-3)
        return D


class MisprintedBench(PrintedBench):
    """The system as printed, with J_m by the printed K."""

    def __init__(self, setting: Setting, object: Any, controller: str, **options: Any) -> None:
        super().__init__(setting, object, controller, **options)
        flagged = replace(setting.model, on_unstable="flag", rolling=False)
        self.model = MisprintedModel(self.hand.hand, self.hand.object, flagged)


class Known(PlantWrapper):
    """A simulated plant some of whose readings are true."""

    def __init__(self, plant: Plant, names: tuple[str, ...]) -> None:
        super().__init__(plant)
        self.names = names

    def observation(self, seen: Observation) -> Observation:
        if seen.truth is None or seen.status is PlantStatus.LOST:
            return seen
        return dataclasses.replace(seen, **{name: getattr(seen.truth, name) for name in self.names})


class TrueJoints(Bench):
    """Joint angles are true."""

    known: tuple[str, ...] = ("q",)

    def __init__(self, *given: Any, **options: Any) -> None:
        super().__init__(*given, **options)
        self.plant = Known(self.plant, self.known)


class TruePoses(TrueJoints):
    """The object's pose is true."""

    known = ("position", "rotation")


class OracleBench(TrueJoints):
    """A bench whose model is the plant's own, and whose pose, joints and forces are the true ones."""

    known = ("q", "position", "rotation", "fingertip_force")

    def __init__(self, setting: Setting, *given: Any, **options: Any) -> None:
        no_doubts = WholeTurn(deviations=0.0, off_rotation=StoppingRule().off_limit, force=0.0)
        super().__init__(setting.replace(planner=no_doubts), *given, **options)
        plant = self.hand
        hand, obj = true_hand(plant.hand, plant.parameters), true_object(plant.object, plant.parameters)
        self.model = KinematicModel(hand, obj, self.setting.model)


def _without_fingertips(base: Setting) -> dict[str, Any]:
    return {"plant": base.parameters.replace(force_sensors=False)}


def _without_noise(base: Setting) -> dict[str, Any]:
    exact = dict.fromkeys(("joint_noise", "position_noise", "rotation_noise"), 0.0)
    return {"sensing": False, "plant": base.parameters.replace(**exact)}


def _as_printed(base: Setting) -> dict[str, Any]:
    return _without_fingertips(base) | {
        "tasks": (EffortTask(), FocusTask()),
        "limits": (ActuatorLimit(step=math.inf),),
        "limiting": LimitingFunction(contact_travel=None),
        "bound": None,
        "planner": OneStep(),
        "safety": Safety(base.safety.rule, _NO_GUARDS),
        "servo_inverse": False,
        "adapts": False,
        "learner": "rbf",
        "learner_options": {"robust": None, "forgetting_factor": 1.0},
        "capacity": _CAPACITY,
    }


def _with_tasks(base: Setting) -> dict[str, Any]:
    return _as_printed(base) | {"tasks": DEFAULT_TASKS}


def _model(**figures: Any) -> Contender:
    return Contender("E-KM", lambda base: {"model": replace(base.model, **figures)})


def _plan(**figures: float) -> Contender:
    return Contender("E-KM", {"planner": WholeTurn(**figures)})


PLAIN = {name: Contender(name) for name in ("E-KM", "KM+I", "KM+S", "KM")}
WHOLE_TURNS = {
    "E-KM": Contender(),
    "without plan": Contender("E-KM", {"planner": OneStep()}),
    "KM": Contender("KM"),
    "KM+S": Contender("KM+S"),
    "KM + plan": Contender("KM", {"planner": WholeTurn()}),
    "KM+S + plan": Contender("KM+S", {"planner": WholeTurn()}),
    "f alone + plan": Contender("E-KM", {"learner": "model alone"}),
    "g alone + plan": Contender("E-KM", {"adapts": False}),
}
#: Parts of the plan, changed or left out.
PLANS = {
    "as it is": Contender(),
    "1 deviation": _plan(deviations=1.0),
    "off the axis by 16 deg": _plan(off_rotation=16 * _DEG),
    "no band of forces": _plan(force=-math.inf),
    "no bands": _plan(force=-math.inf, off_rotation=math.inf),
    "no watch on the way": Contender(bench=UnwatchedBench),
    "without plan": WHOLE_TURNS["without plan"],
    "without plan and bound": Contender("E-KM", {"planner": OneStep(), "bound": None}),
}
#: Parts of model and learner, changed or left out.
PARTS = {
    "as it is": Contender(),
    "f as described": Contender("E-KM", {"adapts": False}),
    "no g": Contender("E-KM", {"learner": "model alone"}),
    "g: rbf": Contender("E-KM", {"learner": "rbf"}),
    "no servo inverse": Contender("E-KM", {"servo_inverse": False}),
    "no robust update": Contender("E-KM", {"learner_options": {"robust": None}}),
    "no rolling": _model(rolling=False),
    "rigid actuators": _model(actuator_compliance=False),
}
PRINTED = {
    "KM, as printed": Contender("KM", _as_printed, PrintedBench),
    "E-KM, as printed": Contender("E-KM", _as_printed, PrintedBench),
    "KM, with tasks": Contender("KM", _with_tasks, PrintedBench),
    "E-KM, with tasks": Contender("E-KM", _with_tasks, PrintedBench),
    "KM, J_m as misprinted": Contender("KM", _as_printed, MisprintedBench),
    "E-KM, J_m as misprinted": Contender("E-KM", _as_printed, MisprintedBench),
    "E-KM": Contender(),
    "E-KM without fingertips": Contender("E-KM", _without_fingertips),
}
#: What an E-KM begins a new object with.
BEGINNINGS = {
    "learned hand": Contender(),
    "learned hand, f alone": Contender("E-KM", {"learner": "model alone"}),
    "empty": Contender("E-KM", {"adapts": False}),
}
PLACE = {"E-KM": Contender(), "place kept": Contender(bench=PlaceKept)}
ORACLE = {"E-KM": Contender(), "oracle": Contender("KM+S", {}, OracleBench)}
#: Readings replaced by the truth.
READINGS = {
    "all sensed": Contender(),
    "true joint angles": Contender(bench=TrueJoints),
    "true poses": Contender(bench=TruePoses),
    "all true": Contender("E-KM", _without_noise),
    "KM, all sensed": Contender("KM"),
}
