"""A driver skeleton: python examples/real_hand_driver.py. Replace FakeBus by your hardware, keep RealHand."""

import math

import torch

from torch_ekm.control import ClosedLoop, Guards, LookAndMoveController, PoseTarget
from torch_ekm.description import load_hand, load_object
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.model import KinematicModel
from torch_ekm.plant import Observation, PlantStatus
from torch_ekm.simulation import SimulatedHand

TICK = 2 * math.pi / 4096  # of an encoder [rad]


class FakeBus(SimulatedHand):
    """Stands for the hardware: encoder ticks, joint angles [rad], the object's pose in the hand frame."""

    def move(self, ticks: torch.Tensor) -> None:  # returns when the motors stand still
        self.command(ticks * TICK - self.observe().a)

    def read(self) -> dict:
        now = self.observe()
        ticks = (now.a / TICK).round()
        return {"ticks": ticks, "q": now.q, "pose": (now.position, now.rotation), "t": now.time}


class RealHand:  # the Plant protocol: reset, observe, command, close
    def __init__(self, bus: FakeBus) -> None:
        self.bus = bus

    def reset(self, seed: int) -> Observation:  # a person puts the object between the fingers
        return self.observe()

    def observe(self) -> Observation:  # SI units, hand frame, dated by one clock
        seen = self.bus.read()
        self.pose = seen["pose"] or self.pose  # an old one if the camera sees nothing
        status = PlantStatus.HELD if seen["pose"] else PlantStatus.NOT_SEEN
        return Observation(seen["q"], seen["ticks"] * TICK, *self.pose, time=seen["t"], status=status)

    def command(self, delta_a: torch.Tensor) -> Observation:  # [rad], relative to the encoders
        self.bus.move(self.bus.read()["ticks"] + torch.as_tensor(delta_a) / TICK)
        return self.observe()

    def close(self) -> None:
        self.command(torch.zeros(2))  # hold


if __name__ == "__main__":
    bus = FakeBus("planar_two_finger", "can", preset="nominal")
    bus.reset(seed=0)
    plant, axis = RealHand(bus), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    seen = plant.reset(seed=0)
    model = KinematicModel(load_hand("planar_two_finger"), load_object("can"))
    controller = LookAndMoveController(EnhancedModel.for_grasp(model, seen.state), focus=axis)
    result = ClosedLoop(plant, controller, guards=Guards()).run(
        PoseTarget.turned(seen.state, axis, degrees=8)
    )
    print(f"{result.reason.value}, {math.degrees(result.errors[-1]):.2f} deg off", result.stop.message)
