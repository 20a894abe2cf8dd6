"""Tests of innovations: is the sample an outlier, is the noise right, has the system changed?"""

from __future__ import annotations

import torch
from torch import nn

from ..._checks import check_positive
from ...typing import Bool, Float, Tensor
from .part import Host, Part, Sample

CALIBRATION_RATE = 0.2  # of the logarithm of a factor on the noise
Z90_SQUARED = 1.6448536269514722**2
RATE = 1 / 8  #: of the shares of samples that do not fit
RING_SIZE = 24  # samples of which those since the change are learned again
NO_SAMPLE = 2.0  # in the place of a level, which is 1 at most
ALARM, LARGE, _ONSET, COOL = 0.6, 5.0, 0.12, -2.0
FACTOR_LEAST, FACTOR_MOST = -5.0, 10.0  # logarithms
DISTRUSTED, DISTRUSTED_MOST = 0.25, 0.6  #: shares of distrusted samples
WORSE = 16.0  #: squared errors that mislead, in squares of y
MISLED_RATE = 1 / 16


class Misled(nn.Module):
    """``a += ([|y - g|^2 > 16 |y|^2] - a)/16``, misled where ``a > 0.6``: the model alone is better by far.

    Where g is worth nothing an error is four times y in one of ten samples at most; ten of sixteen are
    another system. So a learner of y of size 1 lets go where y is of size 1e-3 from now on: its noise, which
    is of the old size, explains such innovations.

    Args:
        like: whose shape, that of the fleet, dtype and device a has.
    """

    def __init__(self, like: Tensor) -> None:
        super().__init__()
        self.level = nn.Buffer(torch.zeros_like(like))

    def observe(
        self, error: Float[Tensor, "*batch out"], y: Float[Tensor, "*batch out"], mask: Tensor | None
    ) -> None:
        """Take note of errors before the update."""
        worse = error.square().sum(-1) > WORSE * y.square().sum(-1)
        step = MISLED_RATE * (worse.to(self.level.dtype) - self.level)
        self.level += step if mask is None else step * mask

    def found(self) -> Bool[Tensor, "*batch"] | None:
        """Models that are misled, which begin to count again. None: none."""
        misled = self.level > ALARM
        if not misled.is_cuda and not bool(misled.any()):  # on a GPU looking would mean waiting
            return None
        self.level.masked_fill_(misled, 0.0)
        return misled


class RobustWeight(Part):
    """Weight ``w = min(1, c^2/z2)^t`` on a sample's gain, z2 its normalised innovation squared::

        a += ([z2 > c^2] - a)/8,   t = 1 up to a = 0.25, 0 from a = 0.6 on

    After Altamirano et al., ICML 2024, centred on the prediction. The gain itself is weighted,
    ``v/(s2 + v)``: where v is large, a larger s2 alone would let outliers in. Outliers come alone: samples
    that are distrusted in a row are a burst of motion, or another system, and t lets them in.

    Args:
        threshold: c [standard deviations], 2 to 3.

    Raises:
        ParameterError: not positive.
    """

    def __init__(self, threshold: float) -> None:
        super().__init__()
        self.threshold = check_positive("threshold", threshold)

    def bind(self, learner: Host) -> None:
        """No sample was distrusted yet: a = 0."""
        self.level = nn.Buffer(learner.posterior.basis.new_zeros(learner.posterior.batch_shape))

    def weigh(self, nis: Tensor, mask: Tensor | None) -> Float[Tensor, "*batch"]:
        """``min(1, c^2/z2)^t``; a takes the sample in."""
        most = self.threshold**2
        trust = ((DISTRUSTED_MOST - self.level) / (DISTRUSTED_MOST - DISTRUSTED)).clamp(0.0, 1.0)
        step = RATE * ((nis > most).to(nis.dtype) - self.level)
        self.level += step if mask is None else step * mask
        return (most / nis).clamp_max(1.0).pow(trust)

    def forget(self, models: Tensor) -> None:
        """What was distrusted belonged to the old system."""
        self.level.masked_fill_(models, 0.0)


class CalibrateNoise(Part):
    """Factors c_j on the observation noise that make 90 % intervals hold 90 % of the samples::

        log c_j += 0.2 ([|i_j| > 1.645 sqrt(v + c_j s2_j)] - 0.1)

    Adaptive conformal inference (Gibbs & Candes, NeurIPS 2021): the long-run share of misses is 10 %
    for any distribution of the noise, per output, without touching the mean or the gain.
    """

    def bind(self, learner: Host) -> None:
        """Factors c = 1 on the noise of all outputs."""
        self.log_factor = nn.Buffer(torch.zeros_like(learner.log_noise_variance))

    def after_update(self, learner: Host, sample: Sample) -> bool:
        """Move c by whether this innovation lay outside of its interval."""
        noise = learner.log_noise_variance.exp()
        variance = sample.variance.unsqueeze(-1) + noise * self.log_factor.exp()
        missed = sample.innovation.square() > Z90_SQUARED * variance
        step = CALIBRATION_RATE * (missed.to(noise.dtype) - 0.1)
        self.log_factor += step if sample.mask is None else step * sample.mask.unsqueeze(-1)
        self.log_factor.clamp_(FACTOR_LEAST, FACTOR_MOST)
        return False

    def noise(self, variance: Tensor) -> Tensor:
        """Observation noise as calibrated, ``c_j s2_j``, for each output."""
        return variance * self.log_factor.exp()


class DetectChanges(Part):
    """Start again when most of the last samples did not fit: not outliers, another system::

        a += ([z2 > 5] - a)/8,   alarm: a > 0.6

    A tenth of gross outliers never reaches it; an abrupt change does within eight samples or some more. So do
    predictions that err by four times y in most of sixteen samples: then the outputs' scales are those of
    what comes, too.
    The samples since ``a`` last lay below what a single one raises it to are the new system's: the learner
    forgets all and learns these. After an alarm it waits before the next.

    It looks at the result of every update, so on a GPU the host waits for it.
    """

    def bind(self, learner: Host) -> None:
        """Nothing was seen that does not fit."""
        zeros, fleet = learner.posterior.basis.new_zeros, learner.posterior.batch_shape
        self.level = nn.Buffer(zeros(fleet))
        self.levels = nn.Buffer(zeros(RING_SIZE, *fleet))
        self.misled = Misled(self.level)

    def after_update(self, learner: Host, sample: Sample) -> bool:
        """Take note of how well a sample fits."""
        mask = sample.mask
        large = (sample.report.nis > LARGE).to(self.level.dtype)
        self.level.lerp_(large, RATE) if mask is None else self.level.lerp_(large, RATE * mask)
        level = self.level if mask is None else self.level.where(mask > 0, NO_SAMPLE)
        self.levels.select(0, learner.n_samples % RING_SIZE).copy_(level)
        self.misled.observe(sample.innovation, learner.units.output(sample.y), mask)
        return False

    def act(self, learner: Host) -> None:
        """Models that face another system, as the notes of the last sample have it, start again."""
        n, misled = learner.n_samples + 1, self.misled.found()
        changed = self.level > ALARM
        if misled is not None:
            changed = changed | misled
            learner.units.output.forget(misled)
            learner.recent.on.masked_fill_(misled.unsqueeze(-1), 0.0)
        if bool(changed.any()):
            self.level.masked_fill_(changed, COOL)
            x, y, levels = *learner.recent.last(n, RING_SIZE)[:2], self.levels.roll(-n, 0)
            later = (levels >= _ONSET).to(torch.int64).flip(0).cumprod(0).flip(0) > 0
            learner.start_anew(changed, x.movedim(-2, 0), y.movedim(-2, 0), later & (levels < NO_SAMPLE))

    def reset(self) -> None:
        """No sample was seen."""
        super().reset()
        self.misled.level.zero_()
