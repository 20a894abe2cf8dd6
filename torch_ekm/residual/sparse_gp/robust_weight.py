"""A sample that cannot be believed moves the learner less."""

from __future__ import annotations

from ...typing import Float, Tensor
from ..checks import check_positive
from .part import Part


class RobustWeight(Part):
    """Weight ``min(1, c^2/z2)`` on a sample's gain, z2 its normalised innovation squared.

    After Altamirano et al., ICML 2024, centred on the prediction. The gain itself is weighted,
    ``v/(s2 + v)``: where v is large, a larger s2 alone would let outliers in.

    Args:
        threshold: c [standard deviations], 2 to 3.

    Raises:
        ParameterError: not positive.
    """

    def __init__(self, threshold: float) -> None:
        super().__init__()
        self.threshold = check_positive("threshold", threshold)

    def weigh(self, nis: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """``min(1, c^2/z2)``."""
        return (self.threshold**2 / nis).clamp_max(1.0)
