"""A plant that obeys a kinematic model, with a clock, noise, and faults on demand."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable

import torch
from fakes import FakePlant

from torch_ekm.control import ClosedLoop, Manipulation, PoseTarget, Step
from torch_ekm.kinematics.se3 import exp
from torch_ekm.model import KinematicModel
from torch_ekm.plant import Observation

Fault = Callable[["Obedient", Observation], Observation]


class Obedient(FakePlant):
    """``ds = gain J_m da, df_n = (df_n/da) da``; encoders obey but for ``dead`` actuators;
    a motion takes 1 s.

    From command ``since`` on each reading is what ``fault`` makes of it. ``given`` are the commands.
    ``noise`` is that of angles [rad], and of positions [0.1 m].
    """

    def __init__(
        self,
        model: KinematicModel,
        seen: Observation,
        fault: Fault | None = None,
        *,
        since: int = 2,
        gain: float = 0.8,
        dead: tuple[int, ...] = (),
        takes: float = 1.0,
        noise: float = 1e-3,
    ) -> None:
        super().__init__()
        self.model, self.start, self.fault, self.since, self.gain = model, seen, fault, since, gain
        self.dead, self.takes, self.noise = list(dead), takes, noise
        self.given: list[torch.Tensor] = []
        self.last: list[Observation] = []
        """As passed on."""
        self.state, self.a, self.force = seen.state, seen.a, seen.fingertip_force
        self.draw = torch.Generator().manual_seed(3)

    def reset(self, seed: int) -> Observation:
        self.state, self.a, self.force = self.start.state, self.start.a, self.start.fingertip_force
        self.draw.manual_seed(seed)
        return self.observe()

    def observe(self) -> Observation:
        noise = torch.randn(len(self.start.q) + 6, generator=self.draw, dtype=torch.float64)
        state = self.state.plus(
            self.noise * noise * torch.tensor([1.0] * len(self.start.q) + [0.1] * 3 + [1.0] * 3)
        )
        force = self.force
        felt = None if force is None else force * (1 + 0.01 * noise[: len(force)])
        seen = dataclasses.replace(
            self.start,
            q=state.q,
            a=self.a,
            position=state.position,
            rotation=state.rotation,
            fingertip_force=felt,
            time=self.start.time + self.takes * len(self.given),
            stamps=None,
        )
        if self.fault is not None and len(self.given) >= self.since:
            seen = self.fault(self, seen)
        self.last.append(seen)
        return seen

    def move(self, delta_a: torch.Tensor) -> None:
        self.given.append(delta_a)
        moved = delta_a.clone()
        moved[self.dead] = 0.0
        if bool(moved.any()):
            lin = self.model.linearize(self.state)
            self.state = self.state.plus(self.gain * lin.step(moved))
            if self.force is not None:
                pads = torch.tensor(self.model.hand.pad_indices(lin.contacts.finger))
                change = lin.normal_force_sensitivity @ moved
                self.force = self.force.index_add(0, pads, change).clamp(min=0.0)
        self.a = self.a + moved


def turned(seen: Observation, axis: torch.Tensor, angle: float) -> Observation:
    """``seen`` with its object turned further by ``angle`` [rad]."""
    return dataclasses.replace(seen, rotation=exp(angle * axis) @ seen.rotation)


def watched(loop: ClosedLoop, target: PoseTarget, on_step: Callable[[Step], object]) -> Manipulation:
    """As ``loop.run(target)``, with a look at each motion when it is over."""
    steps = []
    with contextlib.closing(loop.steps(target)) as motions:
        while True:
            try:
                steps.append(next(motions))
            except StopIteration as end:
                return Manipulation(target, loop.controller.focus, tuple(steps), end.value)
            on_step(steps[-1])
