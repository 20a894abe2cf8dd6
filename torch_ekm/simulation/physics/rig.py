"""Hand, tendons and motors, running in time: the mechanism behind the sensors."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...description import HandDescription, ObjectDescription
from ...typing import Array
from ..config import PlantConfig
from ..grasp_planning.pinch import PinchPlan, opposing_pads
from ..mechanism.assembly import chain, make_transmission, true_object
from ..mechanism.servo import Servo
from ..parameters import PlantParameters
from ..sensors import TimedState
from .mujoco_scene import MujocoScene
from .sapien_scene import SapienScene
from .scene import Scene

_SCENES = {"sapien": SapienScene, "mujoco": MujocoScene}
_FORCE_WINDOW = 10  # steps over which a fingertip force is averaged
_OFTEN = 0.01  # [s] between two states that a late camera may show
_STILL = 2e-3  # [rad/s] and [m/s x 10]: slower than this is settled
_RATE_LIMIT = 100 * np.pi / 180  # fastest motion of a motor [rad/s]
_SPIN_UP = 0.02  # [s] until it runs so fast: the mechanical time constant of small geared motors
_FURTHER = 0.5  # longest further wait for a still object [s]
_CLOSING, _HOLDING, _SETTLING = 0.2, 0.3, 1.0  # [s] of a grasp, object held fixed in the first two


@dataclass(eq=False)
class Rig:
    """Steps the scene with the transmission's torques while the servos move, and measures contact forces."""

    hand: HandDescription
    obj: ObjectDescription
    config: PlantConfig
    parameters: PlantParameters
    """What hand and object really are."""
    remember: Callable[[TimedState], None]
    """Called every 0.01 s if the camera is late."""
    engine: str
    """Which physics, one of :data:`ENGINES`."""

    def __post_init__(self) -> None:
        hand, config = self.hand, self.config
        self.transmission = make_transmission(hand, self.parameters)
        limits = hand.actuator_lower, hand.actuator_upper
        self.servo = Servo(*limits, self.parameters, config.relative_to, hand.actuator_backlash)
        self.time = 0.0
        """[s] since the fingers closed."""
        self.normal = np.zeros(len(hand.pads))
        """Normal force of each pad, mean of the last 10 steps [N]."""
        self.fingers = 0
        """How many fingers touched the object in these steps, with any of their links."""
        self._finger_of = {link: joints[-1] for link in hand.link_names if (joints := chain(hand, link))}
        thumb, _ = opposing_pads(hand, config)
        pad = next(pad.link for pad in hand.pads if pad.name == thumb)
        finger = self._finger_of.get(pad)  # None: a part of the palm
        self._opposing = {pad} | {link for link, root in self._finger_of.items() if root == finger}
        self._build()

    def _build(self) -> None:
        p = self.parameters
        obj, step = true_object(self.obj, p), self.config.time_step
        self.scene: Scene = _SCENES[self.engine](self.hand, obj, step, p.contact_stiffness)
        self._set_friction()
        self.scene.set_link_weight(p.link_weight)
        self._built_scale = p.object_scale
        self.scene.set_drive_stiffness(self.transmission.drive_stiffness)

    def grasp(self, plan: PinchPlan) -> None:
        """Close on the object held in its planned place, release it, let it settle.

        The scene is new each time, so that nothing of an earlier run is left in the engine.
        """
        self.transmission = make_transmission(self.hand, self.parameters)
        self._build()
        scene, transmission, step = self.scene, self.transmission, self.config.time_step
        scene.place(plan.q, plan.position, plan.rotation)
        scene.hold_object(True)
        transmission.relax(plan.q)
        slack = transmission.offset + transmission.length(plan.q)
        self.servo.place(slack)
        self.time = -_CLOSING  # time runs on while the object is grasped: a late camera looks back into it
        self.run(round(_CLOSING / step), lambda part: slack + part * (plan.motor - slack))
        self.servo.place(plan.motor)
        self.time = 0.0
        self.run(round(_HOLDING / step), lambda part: plan.motor)
        scene.hold_object(False)
        self.wait(_SETTLING)
        for _ in range(round(_FURTHER / 0.05)):
            linear, angular = self.scene.object_speed
            if max(10 * linear, angular) < _STILL:
                break
            self.wait(0.05)

    def follow(self, goals: Array, times: Array, frame: Callable[[], bool] | None = None) -> None:
        """Motors straight from goal to goal ``(n, n_a)`` [rad], at ``times (n,)`` [s] from now, or as fast as
        they can; ``frame`` at each frame of the camera. Where it answers False they stay where they are."""
        way = np.abs(np.diff(goals, axis=0, prepend=self.servo.encoder[None])).max(axis=1)
        fastest = way / _RATE_LIMIT
        fastest[0] += _SPIN_UP
        seconds = np.maximum(np.diff(times, prepend=0.0), fastest)
        for goal, steps in zip(goals, np.maximum(1, np.round(seconds / self.config.time_step)), strict=True):
            start, left = self.servo.encoder, int(steps)
            while left:
                n, done = min(left, self.to_frame) if frame else left, 1 - left / steps
                self.run(n, lambda part: start + (done + part * n / steps) * (goal - start))  # noqa: B023
                left -= n
                if frame and self.to_frame == self._period and not frame():
                    self.servo.setpoint = self.servo.encoder
                    return

    @property
    def _period(self) -> int:
        """Steps between two frames of the camera."""
        return max(1, round(1 / (self.parameters.frame_rate * self.config.time_step)))

    @property
    def to_frame(self) -> int:
        """Steps to the camera's next frame, at least 1: it runs by the clock, whatever the hand does."""
        return self._period - round(self.time / self.config.time_step) % self._period

    @property
    def state(self) -> TimedState:
        """As it truly is now."""
        return TimedState(self.time, self.scene.q, *self.scene.object_pose)

    def wait(self, duration: float, push: tuple[Array, Array] | None = None) -> None:
        """Let time pass [s] with the motors at rest, pushing the object by (force, torque) if asked."""
        motor = self.servo.encoder
        self.run(max(1, round(duration / self.config.time_step)), lambda part: motor, push)

    def run(
        self, steps: int, motor_at: Callable[[float], Array], push: tuple[Array, Array] | None = None
    ) -> None:
        """Advance by ``steps``; ``motor_at(part)`` says where the motors are, part from 0 to 1."""
        scene, transmission, servo = self.scene, self.transmission, self.servo
        normal = np.zeros(len(self.hand.pads))
        fingers: set[int] = set()
        window = min(_FORCE_WINDOW, steps)
        begun, often = round(self.time / self.config.time_step), max(1, round(_OFTEN / self.config.time_step))
        for k in range(1, steps + 1):
            output = servo.move_to(motor_at(k / steps))
            if push is not None:
                scene.push(*push)
            q = scene.next_q if transmission.stiff else scene.q
            scene.step(transmission.drive_targets(q, output))
            if self.parameters.latency > 0 and (begun + k) % often == 0:
                self.remember(self.state._replace(time=self.time + k * self.config.time_step))
            if k > steps - window:
                touches = scene.touches()
                fingers |= {self._finger_of[link] for link in touches if link in self._finger_of}
                for i, pad in enumerate(self.hand.pads):
                    if pad.link in touches:
                        normal[i] += touches[pad.link] / window
        duration = steps * self.config.time_step
        transmission.age(scene.q, servo.output, duration)
        self.normal, self.fingers = normal, len(fingers)
        self.time += duration

    def change(self, new: PlantParameters) -> None:
        """Take on other parameters in mid-run, the motors staying where they are.

        What does not differ is left alone: PhysX would not go on bit by bit from being set again.
        """
        old, self.parameters = self.parameters, new
        self.servo.set_parameters(new)
        if _differ(old, new, *_TRANSMISSION):
            previous, self.transmission = self.transmission, make_transmission(self.hand, new)
            self.transmission.take_over(previous, self.scene.q, self.servo.output)
            self.scene.set_drive_stiffness(self.transmission.drive_stiffness)
        self.transmission.lengthen(new.tendon_elongation - old.tendon_elongation)
        obj = true_object(self.obj, new)
        if _differ(old, new, "mass", "com_shift"):
            self.scene.set_object(obj)
        if _differ(old, new, "link_weight"):
            self.scene.set_link_weight(new.link_weight)
        if _differ(old, new, "friction", "friction_unevenness", "hardware_seed"):
            self._set_friction()

    def _set_friction(self) -> None:
        """Of the object's two sides."""
        p = self.parameters
        friction = true_object(self.obj, p).friction
        sides = [friction, (1 - p.friction_unevenness) * friction]
        if np.random.default_rng([p.hardware_seed, 3]).random() < 0.5:
            sides.reverse()
        self.scene.set_friction(sides[0], sides[1], self._opposing)

    def snapshot(self) -> tuple[bytes, dict[str, Any]]:
        """All that changes, for :meth:`restore`: of the physics, and of the rest by name."""
        return self.scene.snapshot(), copy.deepcopy({name: getattr(self, name) for name in _CHANGING})

    def restore(self, state: tuple[bytes, dict[str, Any]]) -> None:
        """Go back to ``state``, taken with the parameters that hold now."""
        if self._built_scale != self.parameters.object_scale:
            self._build()
        physics, rest = state
        self.scene.restore(physics)
        vars(self).update(copy.deepcopy(rest))


_CHANGING = ("transmission", "servo", "normal", "fingers", "time")
_TRANSMISSION = (
    "moment_arm", "spring", "servo_stiffness", "joint_friction", "tendon_creep", "arm_variation", "arm_phase",
    "spring_stiffening", "cable_friction", "hysteresis", "tendon_coupling", "joint_play", "joint_law",
    "hardware_seed",
)  # fmt: skip


def _differ(old: PlantParameters, new: PlantParameters, *names: str) -> bool:
    return any(getattr(old, name) != getattr(new, name) for name in names)
