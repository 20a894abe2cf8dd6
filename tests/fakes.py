"""Plants with nothing behind them, for tests of what is put around a plant or drives one."""

from __future__ import annotations

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


class ScriptedPlant(FakePlant):
    """Gives the observations of a script one after another, whatever it is asked."""

    def __init__(self, script: Iterable[Observation]) -> None:
        super().__init__()
        self.script = iter(script)

    def observe(self) -> Observation:
        return next(self.script)
