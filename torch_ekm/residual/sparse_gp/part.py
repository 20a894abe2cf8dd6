"""What a sparse online GP can be given apart from its basis: one protocol for all of it."""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Iterable
from typing import Any, ClassVar, NamedTuple, TypeVar

import torch
from torch import nn

from ..._recorded import Recorded
from ...exceptions import ParameterError
from ...typing import Bool, Float, Tensor
from ..base import ResidualLearner
from ..kernels.kernel import Kernel
from ..recent import Recent
from ..report import UpdateReport
from ..running_scale import Units
from .posterior import SparsePosterior


class Sample(NamedTuple):
    """One sample per model after its update."""

    x: Float[Tensor, "*batch in"]  #: in its own units
    y: Float[Tensor, "*batch out"]
    mask: Float[Tensor, "*batch"] | None  #: 1 where a model has a sample; None: all have
    report: UpdateReport
    innovation: Float[Tensor, "*batch out"]  #: before it, in the learner's units, as the variance
    variance: Float[Tensor, "*batch"]


class Host(ResidualLearner):
    """What a part finds in its learner: the state, and how it is forgotten and learned again.

    The state is always float64: a change of dtype is one of the interface only.
    """

    kernel: Kernel
    log_noise_variance: Tensor
    posterior: SparsePosterior
    units: Units
    recent: Recent
    refresh_every: int
    refresh_offset: int
    engine: Any
    n_samples: int
    """Samples before the present one."""
    pending: Tensor
    """Samples of each model since the caches were made, ``(*batch_shape)``."""

    def _apply(self, fn, recurse=True):
        def keep_double(tensor):
            moved = fn(tensor)
            if tensor is self._like or not tensor.is_floating_point():
                return moved
            return tensor.to(moved.device)

        return super()._apply(keep_double, recurse)

    @property
    def _kept(self) -> torch.dtype:
        return torch.float64

    @property
    def noise_variance(self) -> Float[Tensor, "*batch out"]:
        """Observation noise variance, in the outputs' own squared units."""
        noise = self.units.value(self.log_noise_variance.exp(), 2)
        for part in self._parts:
            noise = part.noise(noise)
        return noise

    _parts: tuple[Part, ...]

    def part(self, kind: type[P]) -> P | None:
        """The part of that kind, e.g. ``learner.part(Standardize)``; None if it has none.

        In :meth:`Part.bind` it is looked for among those before.
        """
        return next((part for part in self._parts if isinstance(part, kind)), None)

    parts: nn.ModuleList
    """All of them, in the order in which they act."""

    @abstractmethod
    def project(self, x: Tensor, y: Tensor, on: Tensor | None) -> tuple[UpdateReport, Tensor, Tensor]:
        """Learn one sample per model where ``on`` is 1; the last three fields of a :class:`Sample`."""

    def count_sample(self, *, anew: bool = False) -> None:
        """After a sample and all notes of it: rebuild the caches when it is time, or at once."""
        n = self.n_samples + 1
        vars(self)["n_samples"] = n  # an assignment to a Module takes ten times as long
        if anew or self.is_due(n):
            self.refresh()

    def is_due(self, n: int) -> bool:
        """Whether parts may change the state, and the caches are rebuilt, after n samples."""
        return n >= self.refresh_every and (n - self.refresh_offset) % self.refresh_every == 0

    def shared_noise(self) -> Float[Tensor, "*batch"]:
        """Noise by which the gain is computed: geometric mean over the (standardised) outputs."""
        return self.log_noise_variance.mean(-1).exp()

    @torch.no_grad()
    def refresh(self) -> None:
        """Let the parts change the natural form, and rebuild the caches from it.

        Call it after a change of the kernel's or the noise's parameters.
        """
        for part in self._parts:
            part.on_rebuild(self)
        if self.engine is None or not self.engine.rebuild(self):
            self.posterior.rebuild(self.kernel, self.shared_noise())
        self.pending.zero_()
        for part in self._parts:
            part.after_rebuild(self)

    def learn_anew(
        self, x: Float[Tensor, "*batch n in"], y: Float[Tensor, "*batch n out"], on: Float[Tensor, "*batch n"]
    ) -> None:
        """Empty basis; then these samples, where ``on``."""
        if x.shape[-2]:
            self.posterior.reset()
            for x_t, y_t, on_t in zip(x.unbind(-2), y.unbind(-2), on.unbind(-1), strict=True):
                self.project(x_t, y_t, on_t)
            self.refresh()

    def start_anew(
        self,
        models: Bool[Tensor, "*batch"],
        x: Float[Tensor, "n *batch in"],
        y: Float[Tensor, "n *batch out"],
        used: Bool[Tensor, "*n_and_batch"],
    ) -> None:
        """These models forget all but units, kernel and noise, and learn the samples ``used``."""
        self.posterior.forget(models)
        self.recent.forget(models)
        for part in self._parts:
            part.forget(models)
        self.pending.masked_fill_(models, 0.0)
        for x_t, y_t, used_t in zip(x, y, used, strict=True):
            self.project(x_t, y_t, (used_t & models).to(x.dtype))


class Part(Recorded, nn.Module):
    """One thing that a :class:`SparseOnlineGP` does apart from projecting samples onto its basis.

    A part holds its few figures when it is made; the learner copies it and calls :meth:`bind` once, so one
    specification may serve several learners. From then on it has buffers, which travel with the learner.
    The learner calls all its parts in their order:

    1. :meth:`before_update` with each sample before it is learned;
    2. :meth:`weigh` within an update, on the gain;
    3. :meth:`after_update` after each sample, then :meth:`act`;
    4. :meth:`on_rebuild` every ``refresh_every`` samples, before the caches are made again from the natural
       form, and :meth:`after_rebuild` thereafter.

    A subclass implements what it needs; none of it may look at data on a GPU, or updates wait for it.
    """

    stands_last: ClassVar[bool] = False
    """Whether it asks the others what they do, and so must be the last of them."""

    def bind(self, learner: Host) -> None:
        """Make buffers for this learner; raises ParameterError if the parts before do not go with it."""

    def before_update(self, learner: Host, x: Tensor, y: Tensor, mask: Tensor | None) -> None:
        """Take note of a sample, in its own units, before it is learned; ``mask`` as in :class:`Sample`."""

    def weigh(
        self, nis: Float[Tensor, "*batch"], mask: Float[Tensor, "*batch"] | None
    ) -> Float[Tensor, "*batch"]:
        """Weight of a sample's gain by its normalised innovation squared; ``mask`` as in :class:`Sample`."""
        return torch.ones_like(nis)

    def after_update(self, learner: Host, sample: Sample) -> bool:
        """Take note of a sample; True if the caches must be made again at once."""
        return False

    def act(self, learner: Host) -> None:
        """Do what the notes of a sample ask for, once all parts have taken theirs."""

    def on_rebuild(self, learner: Host) -> None:
        """Change the natural form before the caches are made from it."""

    def after_rebuild(self, learner: Host) -> None:
        """Take note of a state whose caches are fresh."""

    def noise(self, variance: Float[Tensor, "*batch out"]) -> Float[Tensor, "*batch out"]:
        """What predictions take for the observation noise."""
        return variance

    def forget(self, models: Bool[Tensor, "*batch"]) -> None:
        """These models face another system: what was kept of the old one does not count."""

    def reset(self) -> None:
        """Back to what :meth:`bind` made; by default all buffers of its own to zero."""
        for buffer in self.buffers(recurse=False):
            buffer.zero_()

    def extra_repr(self) -> str:
        figures = {name: value for name, value in vars(self).items() if not name.startswith("_")}
        plain = {name: value for name, value in figures.items() if type(value) in (int, float)}
        return ", ".join(f"{name}={value}" for name, value in plain.items())


P = TypeVar("P", bound=Part)


def copy_parts(parts: Iterable[nn.Module]) -> list[Part]:
    """Copies of specifications, for one learner.

    Raises:
        ParameterError: not a list of parts, two of a kind, or the last one not last.
    """
    valid = "a list of parts such as [ForgettingFactor(0.99), RobustWeight(3.0)]"
    given = list(parts) if isinstance(parts, Iterable) else []
    found = [part for part in given if isinstance(part, Part)]
    if not isinstance(parts, Iterable) or len(found) < len(given):
        raise ParameterError("parts", parts, valid)
    kinds = [type(part) for part in found]
    names = [kind.__name__ for kind in kinds]
    for place, kind in enumerate(kinds):
        if kinds.count(kind) > 1:
            raise ParameterError("parts", names, f"with one {kind.__name__} at most")
        if kind.stands_last and place < len(kinds) - 1:
            raise ParameterError("parts", names, f"with {kind.__name__} last")
    return [copy.deepcopy(part) for part in found]
