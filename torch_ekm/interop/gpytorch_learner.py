"""What the adapters of GPyTorch's models share."""

from __future__ import annotations

import copy
import pickle
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import nn
from torch.distributions import Normal

from .._recorded import ill_formed, in_bounds
from ..residual.base import SingleLearner
from ..residual.report import UpdateReport
from ..typing import Float, Tensor


class GPyTorchLearner(SingleLearner):
    """A model of GPyTorch and the last samples.

    GPyTorch's state lies partly outside of state dicts, so the model is no submodule: a copy is made again
    and loads its state. A subclass names its own arguments in ``_options`` and calls :meth:`_start` last.
    """

    _options: ClassVar[tuple[str, ...]]
    _peer: tuple[Any, ...]  # what _build made

    def _start(self, memory: int) -> None:
        """Room for the last ``memory`` samples, and a new model."""
        self.inputs = nn.Buffer(self._like.new_zeros(memory, self.in_features))
        self.targets = nn.Buffer(self._like.new_zeros(memory, self.out_features))
        self.reset()

    @abstractmethod
    def _build(self) -> tuple[Any, ...]:
        """All that has a state dict, the model first."""

    @abstractmethod
    def _moments(self, x: Float[Tensor, "n in"]) -> tuple[Float[Tensor, "n out"], Float[Tensor, "n out"]]:
        """Mean and variance of g."""

    @abstractmethod
    def _noise(self) -> Tensor:
        """Variance of the observation noise."""

    @abstractmethod
    def _learn(self, place: int) -> None:
        """The sample at this place of the memory is new."""

    @abstractmethod
    def _settle(self) -> None:
        """Memory, model or their dtype changed."""

    def reset(self) -> None:
        """An empty memory and a new model."""
        super().reset()
        self._count = 0
        self._peer = self._build()
        self._settle()

    def _law(self, x: Tensor) -> tuple[Tensor, Tensor]:
        x = self.check_query(x)
        mean, variance = self._moments(x.reshape(-1, self.in_features))
        shape = (*x.shape[:-1], self.out_features)
        return mean.reshape(shape), variance.clamp_min(1e-12).reshape(shape)

    def forward(self, x: Tensor) -> Tensor:
        """The posterior mean; 0 before the first sample."""
        return self._law(x)[0]

    def predict(self, x: Tensor, *, observation: bool = False) -> Normal:
        """The posterior law, plus the likelihood's noise on request."""
        with torch.no_grad():
            mean, variance = self._law(x)
            variance = variance + self._noise() if observation else variance
        return Normal(mean, variance.sqrt(), validate_args=False)

    def absorb(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        law = self.predict(x, observation=True)
        nis = ((y - law.mean) / law.stddev).square().mean(-1)
        place = self._count % len(self.inputs)
        self.inputs[place], self.targets[place] = x, y
        self._count += 1
        self._learn(place)
        return UpdateReport.of(nis, mask)

    def get_extra_state(self) -> dict[str, Any]:
        """Sample count, and the state dicts of what GPyTorch made."""
        peer = {type(part).__name__: part.state_dict() for part in self._peer}
        return {**super().get_extra_state(), "count": self._count, **peer}

    def state_problems(self, state: dict[str, Any]) -> list[str]:
        """What GPyTorch refuses is tried on another model: it would leave this one half loaded."""
        extra = state["_extra_state"]
        try:
            for part in self._build():
                given = extra[type(part).__name__]
                if isinstance(part, nn.Module):
                    own = part.state_dict()
                    wrong = ill_formed(own, given)
                    wrong += [name for name in own if not wrong and not in_bounds(given[name], own[name])]
                    if wrong:
                        return wrong
                part.load_state_dict(copy.deepcopy(given))
                if isinstance(part, torch.optim.Optimizer) and (wrong := _optimizer_problems(part, given)):
                    return wrong
        except Exception as error:
            return [f"not a state of GPyTorch's model: {type(error).__name__}: {error}"]
        return []

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self._count = int(state["count"])
        self._peer = self._build()
        for part in self._peer:
            part.load_state_dict(copy.deepcopy(state[type(part).__name__]))
        self._settle()

    def _apply(self, fn, recurse=True):
        super()._apply(fn, recurse)
        for part in self._peer:
            if isinstance(part, nn.Module):
                part._apply(fn)
        self._settle()
        return self

    def __deepcopy__(self, memo: dict) -> GPyTorchLearner:
        return pickle.loads(pickle.dumps(self))

    def __reduce__(self):
        options = {name: getattr(self, name) for name in (*self._options, "on_invalid", "dtype")}
        return _rebuild, (type(self), self.in_features, self.out_features, options, self.state_dict())


def _rebuild(kind: type[SingleLearner], n_in: int, n_out: int, options: dict[str, Any], state: dict) -> Any:
    learner = kind(n_in, n_out, **options)
    learner.load_state_dict(state)
    return learner


def _optimizer_problems(optimizer: torch.optim.Optimizer, given: Mapping[str, Any]) -> list[str]:
    """An optimizer takes whatever it is given, and fails at its next step."""
    if given["param_groups"] != optimizer.state_dict()["param_groups"]:
        return ["the optimizer's options are others"]
    parameters = [one for group in optimizer.param_groups for one in group["params"]]
    for place, averages in given["state"].items():
        for name, value in averages.items():
            shape, dtype = parameters[place].shape, parameters[place].dtype
            if name == "step":
                shape, dtype = torch.Size(), torch.float32
            if value.shape != shape or value.dtype != dtype or not bool(value.isfinite().all()):
                return [f"the optimizer's {name} of parameter {place} is not a {tuple(shape)} of {dtype}"]
    return []
