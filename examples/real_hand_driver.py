"""A driver skeleton: python examples/real_hand_driver.py. Replace FakeBus by your hardware, keep RealHand."""

import math

import torch

from torch_ekm.control import ClosedLoop, Guards, LookAndMoveController, PoseTarget, Safety
from torch_ekm.description import load_hand, load_object
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.model import KinematicModel
from torch_ekm.plant import Observation, PlantStatus, Stamps
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
        self.bus, self.pose, self.dated = bus, None, 0.0

    def reset(self, seed: int) -> Observation:  # a person puts the object between the fingers, in view
        return self.observe()

    def observe(self) -> Observation:  # SI units, hand frame, dated by one clock
        seen = self.bus.read()
        now, status = seen["t"], PlantStatus.HELD if seen["pose"] else PlantStatus.NOT_SEEN
        if seen["pose"]:  # else the old one with its old stamp
            self.pose, self.dated = seen["pose"], now
        q, a, stamps = seen["q"], seen["ticks"] * TICK, Stamps(now, now, self.dated, now)
        return Observation(q, a, *self.pose, time=now, status=status, stamps=stamps)

    def command(self, delta_a: torch.Tensor) -> Observation:  # [rad], relative to the encoders
        self.bus.move(self.bus.read()["ticks"] + torch.as_tensor(delta_a) / TICK)
        return self.observe()

    def close(self) -> None:
        self.bus.move(self.bus.read()["ticks"])  # hold


if __name__ == "__main__":
    bus = FakeBus("planar_two_finger", "can", preset="nominal")
    bus.reset(seed=0)
    plant, axis = RealHand(bus), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    seen = plant.reset(seed=0)
    model = KinematicModel(load_hand("planar_two_finger"), load_object("can"))
    controller = LookAndMoveController(EnhancedModel.for_grasp(model, seen.state), focus=axis)
    target = PoseTarget.turned(seen.state, axis, degrees=8)
    result = ClosedLoop(plant, controller, safety=Safety(guards=Guards())).run(target)
    print(f"{result.reason.value}, {math.degrees(result.errors[-1]):.2f} deg off", result.stop.message)
