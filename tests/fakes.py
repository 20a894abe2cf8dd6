"""Plants with nothing behind them, for tests of what is put around a plant or drives one."""

import dataclasses
from collections.abc import Iterable

import torch

from torch_ekm.plant import Observation


class FakePlant:
    """The plant contract: a subclass says what is observed, and what a command moves."""

    def __init__(self) -> None:
        self.closed = False

    def reset(self, seed: int) -> Observation:
        return self.observe()

    def observe(self) -> Observation:
        raise NotImplementedError

    def command(self, delta_a: torch.Tensor) -> Observation:
        self.move(delta_a)
        return self.observe()

    def move(self, delta_a: torch.Tensor) -> None:
        """Nothing moves unless a subclass says so."""

    def close(self) -> None:
        self.closed = True


class HoldingPlant(FakePlant):
    """Encoders obey; joints and object stay, but for a hair in each reading: no sensor is frozen."""

    def __init__(self, seen: Observation) -> None:
        super().__init__()
        self.seen = seen
        self.commands: list[torch.Tensor] = []
        self.looks = 0

    def reading(self, **changes: torch.Tensor) -> Observation:
        """The next one, with what a subclass changes."""
        self.looks += 1
        hair, time = 1e-9 * self.looks, self.seen.time + len(self.commands)
        still = {"q": self.seen.q + hair, "position": self.seen.position + hair}
        return dataclasses.replace(self.seen, **still, **changes, time=time, stamps=None)

    def move(self, delta_a: torch.Tensor) -> None:
        self.commands.append(delta_a)
        self.seen = dataclasses.replace(self.seen, a=self.seen.a + delta_a)


class ScriptedPlant(FakePlant):
    """Gives the observations of a script one after another, whatever it is asked."""

    def __init__(self, script: Iterable[Observation]) -> None:
        super().__init__()
        self.script = iter(script)

    def observe(self) -> Observation:
        return next(self.script)
