"""What a learner with closed forms says about a query."""

from __future__ import annotations

from typing import NamedTuple

from ..typing import Float, Tensor


class Prediction(NamedTuple):
    """Mean, latent variance and their derivatives with respect to x."""

    mean: Float[Tensor, "*any out"]
    variance: Float[Tensor, "*any out"]
    mean_jacobian: Float[Tensor, "*any out in"]
    variance_jacobian: Float[Tensor, "*any out in"]
