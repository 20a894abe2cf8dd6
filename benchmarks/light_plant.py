"""A plant that obeys a kinematic model, with a clock, noise, and faults on demand."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable

import torch

from torch_ekm.control.program import of_pads
from torch_ekm.exceptions import GraspError
from torch_ekm.model import KinematicModel
from torch_ekm.plant import Observation

Fault = Callable[["Obedient", Observation], Observation]


class Obedient:
    """``ds = gain J_m da, df_n = (df_n/da) da``; encoders obey but for ``dead`` actuators;
    a motion takes 1 s. Implements :class:`~torch_ekm.plant.Plant`.

    From command ``since`` on each reading is what ``fault`` makes of it. ``given`` are the commands, and
    ``true`` the encoders from which they went. ``noise`` is that of angles [rad], and of positions [0.1 m].
    A command beyond the range goes to its end.
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
        dead_zone: float = 0.0,
    ) -> None:
        self.model, self.start, self.fault, self.since, self.gain = model, seen, fault, since, gain
        self.dead, self.takes, self.noise, self.dead_zone = list(dead), takes, noise, dead_zone
        self.given: list[torch.Tensor] = []
        self.true: list[torch.Tensor] = []
        self.last: list[Observation] = []
        """As passed on."""
        self.looks = 0
        """Since the last command."""
        self.closed = False
        self.state, self.a, self.force = seen.state, seen.a, seen.fingertip_force
        self.range = [torch.from_numpy(x) for x in (model.hand.actuator_lower, model.hand.actuator_upper)]
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
        self.looks += 1
        if self.fault is not None and len(self.given) >= self.since:
            seen = self.fault(self, seen)
        self.last.append(seen)
        return seen

    def command(self, delta_a: torch.Tensor) -> Observation:
        self.given.append(delta_a)
        self.true.append(self.a)
        self.looks = 0
        moved = (self.a + delta_a).clamp(*self.range) - self.a
        moved = moved.sign() * (moved.abs() - self.dead_zone).clamp(min=0.0)
        moved[self.dead] = 0.0
        if bool(moved.any()):
            with contextlib.suppress(GraspError):  # the object has left the hand: motors move alone
                lin = self.model.linearize(self.state)
                self.state = self.state.plus(self.gain * lin.step(moved))
                if self.force is not None:
                    change = of_pads(
                        self.model.hand, lin.contacts.finger, lin.normal_force_sensitivity @ moved
                    )
                    self.force = (self.force + change).clamp(min=0.0)
        self.a = self.a + moved
        return self.observe()

    def close(self) -> None:
        self.closed = True
