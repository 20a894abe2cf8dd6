"""The simulated hand: ground truth for everything that is learned."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from .._checks import check_count, check_kind
from ..description import HandDescription, ObjectDescription, load_hand, load_object
from ..exceptions import EquilibriumError, GraspError, ParameterError, StateError, UnknownNameError
from ..kinematics import GraspState
from ..model import KinematicModel, ModelOptions
from ..model.kinematic_model import softened
from ..plant import Observation, PlantStatus, Stamps, Truth
from ..plant import Path as Waypoints
from ..typing import Array, Float, Tensor
from .config import PlantConfig
from .grasp_planning.pinch import PinchPlan, pinch_hint, pinch_problem, remembered_pinch, solve
from .grasp_planning.pinch_problem import PinchRequest
from .mechanism.assembly import true_hand, true_object
from .parameters import PlantParameters
from .physics.rig import Rig
from .physics.scene import ENGINES
from .presets import preset as parameters_of
from .sensors import Sensors

_ATTEMPTS = 5
_GENTLE = 3.0  # [N] of a pinch whose springs are too soft for the usual force
_LONGEST_REST = 0.8  # [s] that rest is waited for after a motion
_FAR = 0.05  # [m] from where it was grasped: out of the hand
_OFFSET_ALONG, _OFFSET_ACROSS = 0.010, 0.002  # [m]: grasp points are drawn within +- these, object's axes
_TILT = 5 * np.pi / 180  # [rad]: the object's long axis is drawn within +- this of the wanted direction


class PlantSnapshot(NamedTuple):
    """Everything needed to go back to a moment; give it to :meth:`SimulatedHand.restore`."""

    rig: tuple[bytes, dict[str, Any]]
    parameters: PlantParameters
    sensors: Sensors
    generator: dict[str, Any]
    plan: PinchPlan


class SimulatedHand:
    """A hand with tendons that holds an object, in SAPIEN or MuJoCo; implements :class:`Plant`.

    ::

        plant = SimulatedHand("icub_right", "box", preset="nominal")
        observation = plant.reset(seed=0)
        observation = plant.command(delta_a)

    Everything is in the hand frame, SI units. ``observation.truth`` is for reports and for
    sensors that are simulated. The same seed gives the same run, bit by bit.

    Args:
        hand: a description, or the name or path that :func:`load_hand` takes.
        object: a description, or the name or path that :func:`load_object` takes.
        config: time, gravity, the grasp.
        parameters: what the plant really is; as described by default.
        preset: the parameters by name, as :func:`torch_ekm.simulation.preset` takes it.
        engine: the physics, "sapien" or "mujoco" (extra ``mujoco``).

    Raises:
        UnknownNameError: no such hand, object, preset or engine; the message lists them.
        ParameterError: both ``parameters`` and ``preset`` are given.
    """

    def __init__(
        self,
        hand: HandDescription | str | Path = "icub_right",
        object: ObjectDescription | str | Path = "box",
        config: PlantConfig | None = None,
        parameters: PlantParameters | None = None,
        preset: str | None = None,
        engine: str = "sapien",
    ) -> None:
        if parameters is not None and preset is not None:
            valid = "None with parameters: preset(name).replace(...) changes single figures of a preset"
            raise ParameterError("preset", preset, valid)
        if parameters is not None:
            check_kind("parameters", parameters, PlantParameters, "PlantParameters; a name goes to preset=")
        if engine not in ENGINES:
            raise UnknownNameError("engine", engine, ENGINES)
        self.engine = engine
        self.hand = (load_hand(hand) if isinstance(hand, str | Path) else hand).counted()
        self.object = load_object(object) if isinstance(object, str | Path) else object
        self.config = PlantConfig() if config is None else config
        if self.config.gravity is not None:
            self.hand = dataclasses.replace(self.hand, gravity=self.config.gravity)
        self.parameters = parameters_of(preset or "none") if parameters is None else parameters
        self._problem = pinch_problem(self.hand, self.object, self.config, self.parameters)
        self._sensors = Sensors(self.parameters, self.hand.n_q, len(self.hand.pads), self.hand.joint_names)
        self._generator = np.random.default_rng(0)
        self._rig: Rig | None = None
        self._plan: PinchPlan | None = None
        self._ungraspable: EquilibriumError | None = None

    # -- the plant contract -------------------------------------------------------------------------

    def reset(self, seed: int) -> Observation:
        """Grasp the object again: plan a pinch, close on the held object, release it, let it settle.

        Raises:
            ParameterError: the seed is no integer of at least 0.
            EquilibriumError: no pinch could be planned.
            GraspError: the planned pinches did not hold the object.
        """
        self._generator = np.random.default_rng(check_count("seed", seed, least=0))
        if self._rig is None:
            described = self.hand, self.object, self.config, self.parameters
            # a restored plant has other sensors
            self._rig = Rig(*described, lambda frame: self._sensors.remember(frame), self.engine)
        if self._ungraspable is not None:
            raise self._ungraspable
        unplanned = 0
        for _ in range(_ATTEMPTS):
            request = self._request()
            try:
                plan = self._planned(request)
            except EquilibriumError as refused:
                unplanned += 1
                if unplanned == 2 or not self._graspable(request, refused):
                    raise
                continue
            self._plan = plan
            self._sensors.forget()
            self._rig.grasp(plan)
            if self.status is PlantStatus.HELD:
                return self.observe()
        raise GraspError(
            f"none of {_ATTEMPTS} planned pinches of '{self.object.name}' held it (seed {seed}); "
            + (pinch_hint(self._problem) or "another pinch_force, more friction or another gravity may help")
        )

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """Move the actuators by ``delta_a`` [rad], let the hand come to rest, read the sensors.

        It rests where two frames of camera and joint sensors, both newer than the motion, agree within their
        noise; 0.8 s are waited at most.

        Raises:
            ShapeError, NonFiniteError: ``delta_a`` is not ``n_a`` finite numbers; nothing moves.
        """
        rig = self._grasped()
        delta = torch.as_tensor(delta_a).detach().cpu().double().numpy()
        rig.follow(rig.servo.plan(delta, self._generator)[None], np.zeros(1))
        return self._at_rest()

    def follow(self, path: Waypoints, watch: Callable[[Observation], bool]) -> Observation:
        """Move through the waypoints; ``watch`` has the readings of each frame of the camera on the way.

        Raises:
            ShapeError: the waypoints are not of ``n_a`` numbers; nothing moves.
        """
        rig = self._grasped()
        goals = rig.servo.plan(path.waypoints.numpy(), self._generator)
        rig.follow(goals, path.times.numpy(), lambda: watch(self.observe()))
        return self._at_rest()

    def observe(self) -> Observation:
        """Read the sensors; their noise is drawn again."""
        rig, draw = self._grasped(), self._generator
        _, q, position, rotation = now = rig.state
        status = self.status
        frame, seen = self._sensors.frame(now, draw)
        picture = self._sensors.pictured(now)
        felt = self._sensors.forces(rig.normal, rig.time, draw)
        if not seen and status is PlantStatus.HELD:
            status = PlantStatus.NOT_SEEN
        torque = rig.transmission.actuator_torque(q, rig.servo.output)
        pictured = GraspState(*_tensors(picture.q, picture.position, picture.rotation))
        *read, force = _tensors(frame.q, rig.servo.encoder, frame.position, frame.rotation, felt)
        return Observation(
            *read,
            fingertip_force=force if self.parameters.force_sensors else None,
            time=rig.time,
            status=status,
            truth=Truth(*_tensors(q, position, rotation, rig.normal, torque), pictured=pictured),
            stamps=Stamps(rig.time, rig.time, frame.time, rig.time),
        )

    def close(self) -> None:
        """Drop the scene; the next :meth:`reset` makes a new one."""
        self._rig = None

    # -- beyond the contract ------------------------------------------------------------------------

    @property
    def status(self) -> PlantStatus:
        """LOST when fewer than two fingers touch the object, or it has left its place in the hand."""
        rig = self._grasped()
        away = float(np.linalg.norm(rig.scene.object_pose[0] - self.plan.position))
        return PlantStatus.HELD if rig.fingers >= 2 and away < _FAR else PlantStatus.LOST

    @property
    def plan(self) -> PinchPlan:
        """The pinch that the last :meth:`reset` planned."""
        if self._plan is None:
            raise GraspError("there is no grasp yet: call reset(seed) first")
        return self._plan

    @property
    def rotation_axis(self) -> Float[Tensor, " 3"]:
        """Unit vector of the hand frame about which this pinch can turn the object.

        Thumb and fingers flex in nearly parallel planes; the axis is the normal of those planes
        that the contacts show: the line through the finger contacts, made square to the line from
        the thumb to them. With one opposing finger it is the direction of the object's long axis.
        """
        points = self.plan.points
        across = points[1:].mean(axis=0) - points[0]
        across /= np.linalg.norm(across)
        along = self._problem.along
        axis = points[-1] - points[1] if len(points) > 2 else along
        axis = axis - across * (axis @ across)
        axis *= np.sign(axis @ along) / np.linalg.norm(axis)
        return torch.from_numpy(axis)

    def true_descriptions(self) -> tuple[HandDescription, ObjectDescription]:
        """Hand and object as they really are, for a model without mismatch (an upper bound in reports)."""
        return true_hand(self.hand, self.parameters), true_object(self.object, self.parameters)

    def snapshot(self) -> PlantSnapshot:
        """Physics, sensors and noise of this moment, for :meth:`restore`."""
        sensors, generator = copy.deepcopy(self._sensors), dict(self._generator.bit_generator.state)
        return PlantSnapshot(self._grasped().snapshot(), self.parameters, sensors, generator, self.plan)

    def restore(self, snapshot: PlantSnapshot) -> Observation:
        """Go back to ``snapshot``, noise included; two restored runs are alike bit by bit."""
        rig = self._grasped()
        if snapshot.parameters != self.parameters:
            self._adopt(snapshot.parameters)
        rig.restore(snapshot.rig)
        self._sensors = copy.deepcopy(snapshot.sensors)
        self._generator.bit_generator.state = snapshot.generator
        self._plan = snapshot.plan
        return self.observe()

    def wait(self, duration: float) -> None:
        """Let time pass with the motors at rest [s]."""
        self._grasped().wait(duration)

    def change(self, **changes: Any) -> None:
        """Change :class:`PlantParameters` by name, now and in mid-grasp; motors stay where they are.

        A tendon with other moment arms or stiffness is put on so that the joints feel no difference
        at that moment. A held object cannot grow: :meth:`close` first, then change ``object_scale``, then
        :meth:`reset`.

        Raises:
            ParameterError: an unknown name, or a wrong figure; nothing is changed.
            StateError: ``object_scale`` while there is a grasp; nothing is changed.
        """
        new = self.parameters.replace(**changes)
        if self._rig is not None and new.object_scale != self.parameters.object_scale:
            raise StateError("the object is held, and cannot grow: close(), change object_scale, reset(seed)")
        self._adopt(new)

    def tug(self, force: Array, torque: Array, duration: float = 0.05) -> Observation:
        """Pull at the object [N, at its centre of mass] and twist it [N m], hand frame, then settle."""
        rig = self._grasped()
        rig.wait(duration, (np.asarray(force, dtype=np.float64), np.asarray(torque, dtype=np.float64)))
        return self._at_rest()

    # -- inside -------------------------------------------------------------------------------------

    def _grasped(self) -> Rig:
        if self._rig is None or self._plan is None:
            raise GraspError("there is no grasp yet: call reset(seed) first")
        return self._rig

    def _at_rest(self) -> Observation:
        """The reading once two frames agree that are newer than now."""
        rig, before = self._grasped(), None
        moved = rig.time
        while rig.time < moved + _LONGEST_REST:
            rig.wait(rig.to_frame * self.config.time_step)
            frame, _ = self._sensors.frame(rig.state, self._generator)
            if frame.time > (moved if before is None else before.time) + 1e-9:
                if before is not None and self._sensors.agree(before, frame):
                    break
                before = frame
        return self.observe()

    def _adopt(self, parameters: PlantParameters) -> None:
        self._problem = pinch_problem(self.hand, self.object, self.config, parameters)  # may refuse: first
        self.parameters, self._ungraspable = parameters, None
        self._sensors.set_parameters(parameters)
        if self._rig is not None:
            self._rig.change(parameters)

    def _planned(self, request: PinchRequest) -> PinchPlan:
        """The pinch that is wanted, or a gentler one where its force makes the grasp soft."""
        plan = remembered_pinch(self._problem, request)
        if self.config.pinch_force is None and request.force > _GENTLE and self._softened(plan):
            with contextlib.suppress(EquilibriumError):
                return remembered_pinch(self._problem, dataclasses.replace(request, force=_GENTLE))
        return plan

    @functools.cached_property
    def _model(self) -> KinematicModel:  # as described
        return KinematicModel(self.hand, self.object, ModelOptions(on_unstable="flag"))

    def _softened(self, plan: PinchPlan) -> bool:
        """Its forces have made the grasp soft, by the model."""
        named = dict(zip(plan.pads, -np.einsum("ci,ci->c", plan.forces, plan.normals), strict=True))
        (force,) = _tensors(np.array([named.get(pad.name, 0.0) for pad in self.hand.pads]))
        try:
            state = GraspState(*_tensors(plan.q, plan.position, plan.rotation))
            return softened(self._model, self._model.linearize(state, fingertip_force=force))
        except GraspError:
            return False

    def _graspable(self, request: PinchRequest, refused: EquilibriumError) -> bool:
        """Some pinch is known, or the centred one exists; what has none is refused from then on."""
        if self._plan is None and not solve(self._problem, PinchRequest(request.force)).holds:
            self._ungraspable = refused
        return self._ungraspable is None

    def _request(self) -> PinchRequest:
        """Where to grasp."""
        c = self.config
        drawn = self._generator.uniform(-1.0, 1.0, size=6)  # the last two keep the noise of earlier versions
        along, across, first, second = (c.spread * drawn[:4]).tolist()
        return PinchRequest(
            force=self.hand.pinch_force if c.pinch_force is None else c.pinch_force,
            along=along * _OFFSET_ALONG,
            across=across * _OFFSET_ACROSS,
            tilt=(first * _TILT, second * _TILT),
        )


def _tensors(*arrays: Array) -> list[Tensor]:
    return [torch.tensor(value) for value in arrays]
