"""The contract of a learner: how every residual model learns, and what it is made of."""

from __future__ import annotations

import copy
import math
import pickle
import threading
from abc import ABC, abstractmethod
from typing import Any, Literal

import numpy as np
import torch
from torch import nn
from torch.distributions import Distribution, Normal

from .._checks import check_count, check_counts, check_finite, check_share
from .._recorded import Recorded, check_state, describe
from ..exceptions import ParameterError, ShapeError, StateError
from ..typing import Bool, Float, Tensor
from . import processes
from .derivatives import recordable, value_and_jacobian
from .report import Expected, UpdateReport

#: times the largest |y| that was learned, beyond which no prediction goes
FARTHEST = 2.0


class ResidualLearner(Recorded, nn.Module, ABC):
    """g(x), learned from a stream: ``y ~ N(g(x), R)``, and ``g = 0`` before the first sample.

    Shapes: a learner is a fleet of independent models of shape ``batch_shape`` (one model: ``()``).
    Queries are ``(*any, *batch_shape, in_features)``; the fleet's axes may be left out to ask all models, and
    are there in the results, ``*all``. An update takes one sample per model,
    ``(*batch_shape, in_features)``, or a time-ordered block with the time first,
    ``(n, *batch_shape, in_features)``.

    A subclass implements ``forward``, ``predict``, ``absorb`` and, unless all its buffers start at 0,
    ``reset``. It keeps all it has learned in buffers of fixed size, so that ``state_dict``, ``deepcopy``,
    ``.to()`` move all of it. It passes means and slopes through :meth:`bounded`: ``|g|`` is at most twice the
    largest ``|y|`` that was learned, whatever the stream.

    Threads: updates of one learner come one after the other. A query does not wait for them; where another
    thread updates, query ``with learner.lock:`` to see the state before an update or after it. Processes: a
    learner that is pickled or inherited is a copy; one that is forked computes with one thread.

    Args:
        in_features: width of x.
        out_features: width of y.
        batch_shape: shape of the fleet.
        on_invalid: what to do with a sample that is not finite: ``"raise"`` a NonFiniteError, or
            ``"skip"`` it and count it in ``n_refused``. ``"skip"`` never waits for a GPU.

    Raises:
        ParameterError: a size is not a positive integer, or ``on_invalid`` is unknown.
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        batch_shape: tuple[int, ...] = (),
        on_invalid: Literal["raise", "skip"] = "raise",
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        self.in_features = check_count("in_features", in_features)
        self.out_features = check_count("out_features", out_features)
        self.batch_shape = torch.Size(check_counts("batch_shape", batch_shape))
        if not isinstance(dtype, torch.dtype) or not dtype.is_floating_point:
            raise ParameterError("dtype", dtype, "a floating-point dtype such as torch.float64")
        if on_invalid not in ("raise", "skip"):
            raise ParameterError("on_invalid", on_invalid, "'raise' or 'skip'")
        self.on_invalid = on_invalid
        self.n_refused = nn.Buffer(torch.zeros(self.batch_shape, dtype=torch.int64, device=device))
        self.lock = threading.RLock()
        processes.track(self)
        # An empty float tensor follows .to() and so remembers dtype and device for all subclasses.
        self._like = nn.Buffer(torch.empty(0, dtype=dtype, device=device), persistent=False)
        shape = (*self.batch_shape, self.out_features)
        self.largest = nn.Buffer(torch.zeros(shape, dtype=self._kept, device=device))
        """Largest ``|y|`` that was learned, ``(*batch, out)``."""

    def reset(self) -> None:
        """Forget all samples; hyperparameters stay as they are."""
        for buffer in self.buffers(recurse=False):
            buffer.zero_()

    def new_sequence(self) -> None:
        """The next sample does not follow on the last one: nothing that was carried over holds."""

    @abstractmethod
    def absorb(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        """Take in one checked sample per model; models outside ``mask`` must not change.

        :meth:`update` calls it, under the lock and without autograd. Report with :meth:`UpdateReport.of`.
        """

    # -- what it says ---------------------------------------------------------------------------

    @abstractmethod
    def forward(self, x: Float[Tensor, "*any in_features"]) -> Float[Tensor, "*all out_features"]:
        """Posterior mean E[g(x)] in the units of y, differentiable in x."""

    @abstractmethod
    def predict(self, x: Float[Tensor, "*any in_features"], *, observation: bool = False) -> Normal:
        """N(E[g(x)], Var[g(x)]), or the law of y = g(x) + noise with ``observation=True``."""

    def predictive(self, x: Float[Tensor, "*any in_features"]) -> Distribution:
        """Law of y, for log densities: ``predict`` with noise, unless a learner has a better one.

        ``log_prob(y)``, ``cdf(y)`` and ``icdf(p)`` have the shape of y. Learners of heavy-tailed noise
        override it.
        """
        return self.predict(x, observation=True)

    def quantile(self, x: Float[Tensor, "*any in_features"], p: float) -> Float[Tensor, "*all out_features"]:
        """What y stays below with probability p, of each output.

        Raises:
            ParameterError: p is not in (0, 1).
        """
        share = torch.as_tensor(check_share("p", p), dtype=self.dtype, device=self.device)
        return self.predictive(x).icdf(share)

    def interval(
        self, x: Float[Tensor, "*any in_features"], level: float = 0.9
    ) -> tuple[Float[Tensor, "*all out_features"], Float[Tensor, "*all out_features"]]:
        """Lower and upper end of what y lies in with probability ``level``, with equal tails, of each output.

        Raises:
            ParameterError: the level is not in (0, 1).
        """
        out = 0.5 - 0.5 * check_share("level", level)
        return self.quantile(x, out), self.quantile(x, 1.0 - out)

    def moments(
        self, x: Float[Tensor, "*any in_features"], *, observation: bool = False
    ) -> tuple[Float[Tensor, "*all out_features"], Float[Tensor, "*all out_features"]]:
        """Mean and variance of :meth:`predict`."""
        law = self.predict(x, observation=observation)
        return law.mean, law.variance

    @torch.no_grad()
    def sample(
        self,
        x: Float[Tensor, "*any in_features"],
        n: int = 1,
        *,
        observation: bool = False,
        generator: torch.Generator | None = None,
    ) -> Float[Tensor, "n *all out_features"]:
        """n draws of g, or of y with ``observation=True``, at all queries together.

        A draw is one function: two queries vary together as far as the learner knows how g does. Each query
        alone has the law of :meth:`predict`, or of :meth:`predictive`.

        Raises:
            ParameterError: n is no positive integer.
        """
        x = self.check_query(x)
        z = self.unit_draws(x, check_count("n", n), generator)
        mean, latent = self.moments(x)
        if not observation:
            return mean + latent.sqrt() * z
        share = (latent / self.moments(x, observation=True)[1]).clamp(0.0, 1.0)
        own = torch.randn(z.shape, generator=generator, dtype=z.dtype, device=z.device)
        return self._placed(x, share.sqrt() * z + (1.0 - share).sqrt() * own, generator)

    def unit_draws(
        self, x: Float[Tensor, "*all in_features"], n: int, generator: torch.Generator | None
    ) -> Float[Tensor, "n *all out_features"]:
        """n draws of ``(g(x) - mean) / deviation``; of a learner that knows no more, of each query alone."""
        shape = n, *x.shape[:-1], self.out_features
        return torch.randn(shape, generator=generator, dtype=x.dtype, device=x.device)

    def _placed(self, x: Tensor, z: Tensor, generator: torch.Generator | None) -> Tensor:
        """Draws of y, from normal ones of unit variance."""
        law = self.predict(x, observation=True)
        return law.mean + law.stddev * z

    def linearize(
        self, x: Float[Tensor, "*any in_features"]
    ) -> tuple[Float[Tensor, "*all out_features"], Float[Tensor, "*all out_features in_features"]]:
        """``(g(x), dg/dx)``. Learners with a closed form override this autograd version."""
        x = self.check_query(x)
        mean, J = value_and_jacobian(self, x)
        return mean, x.new_zeros(*mean.shape, x.shape[-1]) if J is None else J

    def slope_deviation(
        self, x: Float[Tensor, "*any in_features"]
    ) -> Float[Tensor, "*all out_features in_features"]:
        """Standard deviation of each entry of ``dg/dx``: what the slope of :meth:`linearize` is worth.

        That of an input which never moved is large: nothing was seen of its slope. NaN: the learner states
        none.
        """
        x = self.check_query(x)
        return x.new_full((*x.shape[:-1], self.out_features, self.in_features), math.nan)

    # -- learning -----------------------------------------------------------------------------

    @torch.no_grad()
    def expect(self, x: Float[Tensor, "*batch in_features"]) -> Expected:
        """An input per model whose target comes some samples late, for :meth:`update` in place of x.

        ``sooner = g.expect(x)``, other updates, ``g.update(sooner, y)``: a learner that judges itself by how
        well it predicts is judged by what it says of y now, not by what later samples have taught it.

        Raises:
            ShapeError: x is not ``(*batch_shape, in)``.
        """
        x = self._cast(x).detach()
        if x.shape != (*self.batch_shape, self.in_features):
            raise ShapeError("x", str((*self.batch_shape, self.in_features)), x.shape, "one sample per model")
        return Expected(x.clone(), None)

    @torch.no_grad()
    def update(
        self,
        x: Float[Tensor, "*time_and_batch in_features"] | Expected,
        y: Float[Tensor, "*time_and_batch out_features"],
        mask: Bool[Tensor, "*time_and_batch"] | None = None,
    ) -> UpdateReport:
        """Take in one sample per model, or a time-ordered block of them, in place.

        A step in which no model has a sample leaves no trace. In a fleet what a learner does every so many
        samples (rebuild, forget, adapt) comes at the same step for all its models, and so for one that has
        none at that step. (On a GPU, where looking would mean waiting, a step without samples counts too.)

        Args:
            x: inputs ``(*batch_shape, in)`` or ``(n, *batch_shape, in)``; or what :meth:`expect` gave.
            y: targets, the same with ``out``; the axis of a single output may be left out.
            mask: models that have a sample, ``(*batch_shape)`` or ``(n, *batch_shape)``; all if None.

        Raises:
            ShapeError: a shape does not fit. The state is untouched.
            ParameterError: x, y or mask are no numbers.
            StateError: the learner was made within inference mode.
            NonFiniteError: NaN, infinity or a number whose square is infinite in an unmasked sample,
                under ``on_invalid="raise"``; a block is refused as a whole. The state is untouched.
        """
        x, said = x if isinstance(x, Expected) else (x, None)
        with self.lock:
            report = self.at_once(x, y, None) if mask is None and said is None else None
            if report is None:
                with torch.inference_mode(False):  # some learn by autograd
                    report = self._update(x, y, mask, said)
            return report

    def _update(self, x: Tensor, y: Tensor, mask: Tensor | None, said: Any) -> UpdateReport:
        if self._like.is_inference():  # torch refuses to change these later on
            raise StateError("the learner was made within torch.inference_mode(); make it outside")
        x, y = self._cast(x).detach(), self._cast(y, "y").detach()
        if self.out_features == 1 and y.shape == x.shape[:-1]:
            y = y.unsqueeze(-1)
        if mask is not None and not isinstance(mask, Tensor):
            try:
                mask = torch.as_tensor(mask, device=self.device)
            except (TypeError, ValueError, RuntimeError) as error:
                raise ParameterError("mask", mask, f"a tensor of torch.bool ({error})") from None
        time = self._check_pair(x, y, mask)
        mask = self._refuse(x, y, mask, len(time))
        if mask is not None:  # a NaN times zero is a NaN: clear what must not be used
            x, y = x.where(mask[..., None], 0.0), y.where(mask[..., None], 0.0)
        if not time:
            return self.step(x, y, mask) if said is None else self.step(x, y, mask, said)
        masks = [None] * len(x) if mask is None else mask.unbind()
        return UpdateReport.stack([self.step(*sample) for sample in zip(x, y, masks, strict=True)])

    def step(self, x: Tensor, y: Tensor, mask: Tensor | None, *said: Any) -> UpdateReport:
        """Take in one checked sample per model of ``mask``, as :meth:`update` does after its checks.

        ``said`` is that of :class:`~torch_ekm.residual.Expected`, where there is any.
        """
        x, y = x.to(self._kept), y.to(self._kept)
        if mask is not None and not mask.is_cuda and not bool(mask.any()):
            return UpdateReport.of_nothing(mask, self.dtype)
        size = y.abs() if mask is None else y.abs() * mask.unsqueeze(-1)
        torch.maximum(self.largest, size, out=self.largest)
        report = None if said else self.at_once(x, y, mask)
        return self.absorb(x, y, mask, *said) if report is None else report

    def at_once(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport | None:
        """All that an update does, checks included, by compiled loops; None: they do not take it."""
        return None

    def bounded(self, mean: Float[Tensor, "*all out"]) -> Float[Tensor, "*all out"]:
        """A mean, cut at ``2 largest``: what is linear in x extrapolates to anything."""
        most = (FARTHEST * self.largest).to(mean.dtype)
        return mean.clamp(-most, most)

    def bounded_slope(
        self, mean: Float[Tensor, "*all out"], slope: Float[Tensor, "*all out in"]
    ) -> tuple[Float[Tensor, "*all out"], Float[Tensor, "*all out in"]]:
        """The same with its derivative, which is 0 where the mean is cut, and NaN where that is."""
        cut = self.bounded(mean)
        return cut, slope * torch.where(mean.isnan(), mean, cut == mean).unsqueeze(-1)

    # -- state ----------------------------------------------------------------------------------

    def __getstate__(self) -> dict[str, Any]:
        """A copy has a lock of its own, and a pickled learner a new one."""
        return {name: value for name, value in vars(self).items() if name != "lock"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self.lock = threading.RLock()
        processes.track(self)

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy in another process, too: torch would share a tensor's memory with it."""
        with self.lock:
            return processes.unpickled, (type(self), pickle.dumps(self.__getstate__()))

    def __deepcopy__(self, memo: dict[int, Any]) -> ResidualLearner:
        made = memo[id(self)] = type(self).__new__(type(self))
        with self.lock:
            made.__setstate__(copy.deepcopy(self.__getstate__(), memo))
        return made

    def get_extra_state(self) -> dict[str, Any]:
        """What it was made with, so that no other learner takes its state. Subclasses add to it."""
        return {"made_with": describe(self)}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """See :meth:`get_extra_state`; what it was made with has been compared already."""

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **options: Any):
        """All or nothing, wherever in a tree of modules this learner stands.

        Raises:
            StateMismatchError: the state is one of a learner made otherwise, or damaged. Nothing was changed.
        """
        own = {name[len(prefix) :]: value for name, value in state_dict.items() if name.startswith(prefix)}
        check_state(self, own)
        with self.lock:
            super()._load_from_state_dict(state_dict, prefix, *args, **options)

    # -- checks ---------------------------------------------------------------------------------

    @property
    def dtype(self) -> torch.dtype:
        return self._like.dtype

    @property
    def device(self) -> torch.device:
        return self._like.device

    @property
    def _kept(self) -> torch.dtype:
        """Of what is learned."""
        return self.dtype

    def _cast(self, x: Tensor, name: str = "x") -> Tensor:
        try:
            if not (x.is_complex() if isinstance(x, Tensor) else np.iscomplexobj(x)):
                return recordable(torch.as_tensor(x, dtype=self._kept, device=self._like.device))
        except (TypeError, ValueError) as error:
            raise ParameterError(name, x, f"real numbers ({error})") from None
        raise ParameterError(name, getattr(x, "dtype", complex), "of real numbers")

    def check_query(self, x: Float[Tensor, "*any in_features"]) -> Float[Tensor, "*all in_features"]:
        """x in the learner's dtype, with all the fleet's axes.

        Raises:
            ShapeError: another width, or axes that are not the fleet's.
        """
        x = self._cast(x)
        n = len(self.batch_shape) + 1
        if x.shape[-1:] != (self.in_features,) or (n > 1 and not self._fits(x.shape[-n:-1])):
            raise ShapeError("x", self._expected("*any", "in"), x.shape)
        if x.shape[-n:-1] != self.batch_shape:
            x = x.expand(*x.shape[:-n], *self.batch_shape, self.in_features)
        return x

    def _fits(self, shape: torch.Size) -> bool:
        """A query may leave out the fleet's axes, or have them with size 1, to ask all models."""
        pairs = zip(reversed(shape), reversed(self.batch_shape), strict=False)
        return all(a == b or a == 1 for a, b in pairs)

    def _check_pair(self, x: Tensor, y: Tensor, mask: Tensor | None) -> torch.Size:
        n = len(self.batch_shape) + 1
        if x.dim() not in (n, n + 1) or x.shape[x.dim() - n :] != (*self.batch_shape, self.in_features):
            raise ShapeError("x", self._expected("[n]", "in"), x.shape)
        if y.shape != (*x.shape[:-1], self.out_features):
            expected = ", ".join(map(str, (*x.shape[:-1], self.out_features)))
            raise ShapeError("y", f"({expected})", y.shape, "one target for each input")
        if mask is not None and (mask.shape != x.shape[:-1] or mask.dtype != torch.bool):
            hint = f"of {mask.dtype}"
            raise ShapeError("mask", f"{tuple(x.shape[:-1])} of torch.bool", mask.shape, hint)
        if x.numel() == 0:
            raise ShapeError("x", self._expected("[n >= 1]", "in"), x.shape, "the batch is empty")
        return x.shape[: x.dim() - n]

    def _expected(self, lead: str, end: str) -> str:
        width = self.in_features if end == "in" else self.out_features
        return "(" + ", ".join([lead, *map(str, self.batch_shape), str(width)]) + ")"

    def _refuse(self, x: Tensor, y: Tensor, mask: Tensor | None, n_time: int) -> Tensor | None:
        if self.on_invalid == "skip":
            finite = x.square().isfinite().all(-1) & y.square().isfinite().all(-1)
            refused = ~finite if mask is None else mask & ~finite
            self.n_refused += refused.sum(0) if n_time else refused
            return finite if mask is None else mask & finite
        if mask is not None:
            x, y = x.where(mask[..., None], 0.0), y.where(mask[..., None], 0.0)
        # A norm is cheap and finite unless a square is not (or their sum overflows: then look closely).
        if not math.isfinite(torch.linalg.vector_norm(x) + torch.linalg.vector_norm(y)):
            check_finite("x", x)
            check_finite("y", y)
        return mask

    def extra_repr(self) -> str:
        fleet = f", batch_shape={tuple(self.batch_shape)}" if self.batch_shape else ""
        return f"in_features={self.in_features}, out_features={self.out_features}{fleet}"


class SingleLearner(ResidualLearner):
    """A learner that is one model: ``batch_shape`` must be ``()``.

    Its ``absorb`` gets samples only, never a mask.
    """

    def __init__(self, in_features: int, out_features: int, **options) -> None:
        super().__init__(in_features, out_features, **options)
        if self.batch_shape:
            valid = "() for this learner; make one for each model"
            raise ParameterError("batch_shape", tuple(self.batch_shape), valid)

    def step(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        if mask is not None and not bool(mask):
            return UpdateReport.of_nothing(mask, self.dtype)
        return super().step(x, y, None)


def joint_draws(
    covariance: Float[Tensor, "*batch q q"], n: int, out: int, generator: torch.Generator | None
) -> Float[Tensor, "n q *batch out"]:
    """n normal draws with these correlations and unit variance, for each of ``out`` outputs."""
    d = covariance.diagonal(dim1=-2, dim2=-1).clamp_min(torch.finfo(covariance.dtype).tiny).rsqrt()
    values, vectors = torch.linalg.eigh(d.unsqueeze(-1) * covariance * d.unsqueeze(-2))
    root = vectors * values.clamp_min(0.0).sqrt().unsqueeze(-2)
    root = torch.nn.functional.normalize(root, dim=-1)  # what rounding took from the variance
    shape = n, *root.shape[:-1], out
    draws = root @ torch.randn(shape, generator=generator, dtype=root.dtype, device=root.device)
    return draws.movedim(-2, 1)
