"""The simulated hand: ground truth for everything that is learned."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ..description import HandDescription, ObjectDescription, load_hand, load_object
from ..exceptions import EquilibriumError, GraspError
from ..typing import Float, Tensor
from .config import PlantConfig
from .mechanism import make_planner, make_servo, make_transmission, moment_arms, turning_axis
from .parameters import PlantParameters
from .pinch import PinchPlan
from .pinch_problem import PinchRequest
from .plant import Observation, PlantStatus
from .scene import HandScene
from .sensors import Sensors, SensorState
from .servo import ServoState
from .transmission import TransmissionState

Array = NDArray[np.float64]

_FORCE_WINDOW = 10  # steps over which a fingertip force is averaged
_STILL = 2e-3  # [rad/s] and [m/s x 10]: slower than this is settled
_ATTEMPTS = 5


class PlantSnapshot(NamedTuple):
    """Everything needed to go back to a moment; give it to :meth:`SimulatedHand.restore`."""

    physics: bytes
    transmission: TransmissionState
    servo: ServoState
    sensors: SensorState
    parameters: PlantParameters
    generator: dict[str, Any]
    normal: Array
    time: float
    plan: PinchPlan


class SimulatedHand:
    """A hand with tendons that holds an object, in SAPIEN; implements :class:`Plant`.

    ::

        plant = SimulatedHand("icub_right", "box", parameters=PlantParameters.nominal_mismatch())
        observation = plant.reset(seed=0)
        observation = plant.command(delta_a)

    Everything is in the hand frame, SI units. ``observation.info["truth"]`` is for reports; a
    controller that reads it cheats. The same seed gives the same run, bit by bit.

    Args:
        hand: a description, or the name or path that :func:`load_hand` takes.
        object: a description, or the name or path that :func:`load_object` takes.
        config: time, gravity, the grasp.
        parameters: what the plant really is; :meth:`PlantParameters.exact` by default.
    """

    def __init__(
        self,
        hand: HandDescription | str = "icub_right",
        object: ObjectDescription | str = "box",
        config: PlantConfig | None = None,
        parameters: PlantParameters | None = None,
    ) -> None:
        self.hand = load_hand(hand) if isinstance(hand, str) else hand
        self.object = load_object(object) if isinstance(object, str) else object
        self.config = PlantConfig() if config is None else config
        self.parameters = PlantParameters.exact() if parameters is None else parameters
        self._transmission = make_transmission(self.hand, self.parameters)
        self._servo = make_servo(self.hand, self.config, self.parameters)
        self._sensors = Sensors(self.parameters, self.hand.n_q, len(self.hand.pads), self.hand.joint_names)
        self._planner = make_planner(self.hand, self.object, self.config, self.parameters)
        self._scene: HandScene | None = None
        self._plan: PinchPlan | None = None
        self._generator = np.random.default_rng(0)
        self._normal = np.zeros(len(self.hand.pads))
        self._time = 0.0

    # -- the plant contract -------------------------------------------------------------------------

    def reset(self, seed: int) -> Observation:
        """Grasp the object anew: plan a pinch, close on the held object, release it, let it settle.

        Raises:
            EquilibriumError: no pinch could be planned.
            GraspError: the planned pinches did not hold the object.
        """
        self._generator = np.random.default_rng(seed)
        unplanned = 0
        for _ in range(_ATTEMPTS):
            try:
                plan = self._planner.plan(self._request())
            except EquilibriumError:
                unplanned += 1
                if unplanned == 2:
                    raise
                continue
            self._grasp(plan)
            if self.status is PlantStatus.HELD:
                return self.observe()
        raise GraspError(
            f"none of {_ATTEMPTS} planned pinches of '{self.object.name}' held it (seed {seed}); "
            "a higher pinch_force, friction or another gravity direction may help"
        )

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """Move the actuators by ``delta_a`` [rad], let the hand settle, read the sensors.

        Raises:
            ShapeError, NonFiniteError: ``delta_a`` is not ``n_a`` finite numbers; nothing moves.
        """
        self._need_scene()
        start = self._servo.encoder
        goal = self._servo.plan(torch.as_tensor(delta_a).detach().cpu().double().numpy(), self._generator)
        ramp = max(self.config.ramp_time, float(np.abs(goal - start).max()) / self.config.rate_limit)
        steps = max(1, round(ramp / self.config.time_step))
        self._run(steps, lambda part: start + part * (goal - start))
        self._settle(self.config.command_time - self.config.ramp_time)
        return self.observe()

    def observe(self) -> Observation:
        """Read the sensors; their noise is drawn anew."""
        scene, draw = self._need_scene(), self._generator
        q, (position, rotation) = scene.q, scene.object_pose
        status = self.status
        joints = self._sensors.joints(q, draw)
        seen_position, seen_rotation, seen = self._sensors.pose(position, rotation, draw)
        force = self._sensors.forces(self._normal, draw)
        if not seen and status is PlantStatus.HELD:
            status = PlantStatus.NOT_SEEN
        truth = {
            "q": q,
            "position": position,
            "rotation": rotation,
            "fingertip_force": self._normal.copy(),
            "actuator_torque": self._transmission.actuator_torque(q, self._servo.output),
        }
        return Observation(
            q=torch.from_numpy(joints),
            a=torch.from_numpy(self._servo.encoder),
            position=torch.from_numpy(seen_position),
            rotation=torch.from_numpy(seen_rotation),
            fingertip_force=torch.from_numpy(force),
            time=self._time,
            status=status,
            info={"truth": {name: torch.from_numpy(value) for name, value in truth.items()}},
        )

    def close(self) -> None:
        """Drop the scene; the next :meth:`reset` makes a new one."""
        self._scene = None

    # -- beyond the contract ------------------------------------------------------------------------

    @property
    def status(self) -> PlantStatus:
        """LOST when fewer than two pads touch the object, or it has left its place in the hand."""
        scene, plan = self._need_scene(), self._plan
        assert plan is not None
        away = np.linalg.norm(scene.object_pose[0] - plan.position)
        held = (self._normal > 0).sum() >= 2 and away < 0.05
        return PlantStatus.HELD if held else PlantStatus.LOST

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
        along = np.array(turning_axis(self.hand, self.config))
        axis = points[-1] - points[1] if len(points) > 2 else along
        axis = axis - across * (axis @ across)
        axis *= np.sign(axis @ along) / np.linalg.norm(axis)
        return torch.from_numpy(axis)

    def hand_state(self) -> tuple[Array, Array, Array]:
        """True joint angles [rad], object position [m] and rotation, for pictures."""
        scene = self._need_scene()
        return scene.q, *scene.object_pose

    def snapshot(self) -> PlantSnapshot:
        """This moment, to come back to."""
        scene = self._need_scene()
        return PlantSnapshot(
            scene.snapshot(),
            self._transmission.snapshot(),
            self._servo.snapshot(),
            self._sensors.snapshot(),
            self.parameters,
            dict(self._generator.bit_generator.state),
            self._normal.copy(),
            self._time,
            self.plan,
        )

    def restore(self, snapshot: PlantSnapshot) -> Observation:
        """Go back to ``snapshot``, noise included; two restored runs are alike bit by bit."""
        scene = self._need_scene()
        if snapshot.parameters != self.parameters:
            self.change(**dataclasses.asdict(snapshot.parameters))
        scene.restore(snapshot.physics)
        self._transmission.restore(snapshot.transmission)
        self._servo.restore(snapshot.servo)
        self._sensors.restore(snapshot.sensors)
        self._generator.bit_generator.state = snapshot.generator
        self._normal, self._time, self._plan = snapshot.normal.copy(), snapshot.time, snapshot.plan
        return self.observe()

    def wait(self, duration: float) -> None:
        """Let time pass with the motors at rest [s]."""
        motor = self._servo.encoder
        self._run(max(1, round(duration / self.config.time_step)), lambda part: motor)

    def change(self, **changes: Any) -> None:
        """Change :class:`PlantParameters` by name, now and in mid-grasp; motors stay where they are.

        A tendon with other moment arms or stiffness is put on so that the joints feel no difference
        at that moment. ``object_scale``
        and ``link_weight`` shape the scene: they act from the next :meth:`reset`.

        Raises:
            ParameterError: an unknown name or a wrong figure; nothing is changed.
        """
        old, new = self.parameters, self.parameters.replace(**changes)
        moment_arms(self.hand, new)  # refuses before anything is touched
        self.parameters = new
        self._planner = make_planner(self.hand, self.object, self.config, new)
        self._sensors.set_parameters(new)
        motors = self._servo.snapshot()
        self._servo = make_servo(self.hand, self.config, new)
        self._servo.restore(motors)
        if self._scene is None:
            return
        # What did not change is left alone: PhysX would not go on bit by bit from it.
        if _differ(old, new, "moment_arm", "spring", "servo_stiffness", "joint_friction", "tendon_creep"):
            previous = self._transmission
            self._transmission = make_transmission(self.hand, new)
            self._transmission.take_over(previous, self._scene.q, self._servo.output)
            self._scene.set_drive_stiffness(self._transmission.drive_stiffness)
        self._transmission.lengthen(new.tendon_elongation - old.tendon_elongation)
        if _differ(old, new, "mass", "com_shift"):
            self._scene.set_object(new.mass, new.com_shift)
        if _differ(old, new, "friction"):
            self._scene.set_friction(new.friction * self.object.friction)

    def tug(self, force: Array, torque: Array, duration: float = 0.05) -> Observation:
        """Pull at the object [N, at its centre of mass] and twist it [N m], hand frame, then settle."""
        motor = self._servo.encoder
        push = (np.asarray(force, dtype=np.float64), np.asarray(torque, dtype=np.float64))
        self._run(max(1, round(duration / self.config.time_step)), lambda part: motor, push)
        self._settle(self.config.command_time)
        return self.observe()

    # -- inside -------------------------------------------------------------------------------------

    def _need_scene(self) -> HandScene:
        if self._scene is None:
            raise GraspError("there is no grasp yet: call reset(seed) first")
        return self._scene

    def _request(self) -> PinchRequest:
        c = self.config
        along, across, first, second = self._generator.uniform(-1.0, 1.0, size=4).tolist()
        return PinchRequest(
            c.pinch_force, along * c.offset_along, across * c.offset_across, (first * c.tilt, second * c.tilt)
        )

    def _grasp(self, plan: PinchPlan) -> None:
        c, p = self.config, self.parameters
        self._scene = scene = HandScene(
            self.hand, self.object, c.gravity, c.time_step, p.object_scale, p.link_weight
        )
        self._transmission = make_transmission(self.hand, p)
        self._transmission.lengthen(p.tendon_elongation)
        self._sensors.forget()
        scene.set_object(p.mass, p.com_shift)
        scene.set_friction(p.friction * self.object.friction)
        scene.set_drive_stiffness(self._transmission.drive_stiffness)
        self._plan = plan
        scene.q = plan.q
        scene.object_pose = (plan.position, plan.rotation)
        scene.hold_object(True)
        self._transmission.relax(plan.q)
        slack = self._transmission.offset + self._transmission.J_a @ plan.q
        self._servo.place(slack)
        self._run(round(0.2 / c.time_step), lambda part: slack + part * (plan.motor - slack))
        self._servo.place(plan.motor)
        self._time = 0.0
        self._run(round(0.3 / c.time_step), lambda part: plan.motor)
        scene.hold_object(False)
        self._settle(1.0)

    def _settle(self, least: float) -> None:
        """Wait at least that long [s], and until things are still."""
        self.wait(max(least, self.config.time_step))
        limit = self.config.settle_limit - self.config.command_time
        waited = 0.0
        scene = self._need_scene()
        while waited < limit:
            linear, angular = scene.object_speed
            if max(10 * linear, angular) < _STILL:
                break
            self.wait(0.05)
            waited += 0.05

    def _run(
        self, steps: int, motor_at: Callable[[float], Array], push: tuple[Array, Array] | None = None
    ) -> None:
        """Advance by ``steps``; ``motor_at(part)`` says where the motors are, part from 0 to 1."""
        scene, transmission, servo = self._need_scene(), self._transmission, self._servo
        normal = np.zeros_like(self._normal)
        window = min(_FORCE_WINDOW, steps)
        for k in range(1, steps + 1):
            output, q = servo.move_to(motor_at(k / steps)), scene.q
            if push is not None:
                scene.push(*push)
            scene.step(transmission.drive_targets(q, output))
            if self._sensors.wants_history and k % _FORCE_WINDOW == 0:
                self._sensors.remember(self._time + k * self.config.time_step, *scene.object_pose)
            if k > steps - window:
                touches = scene.touches()
                for i, pad in enumerate(self.hand.pads):
                    if pad.link in touches:
                        normal[i] += touches[pad.link].normal / window
        transmission.age(scene.q, servo.output, steps * self.config.time_step)
        self._normal = normal
        self._time += steps * self.config.time_step


def _differ(old: PlantParameters, new: PlantParameters, *names: str) -> bool:
    return any(getattr(old, name) != getattr(new, name) for name in names)
