from __future__ import annotations

import torch

from ..typing import Float, Tensor


def null_space(rows: Float[Tensor, "m n"]) -> Float[Tensor, "n n_free"]:
    """Orthonormal basis N of ``rows N = 0`` (SVD); all of space where there are no rows.

    Args:
        rows: constraints whose entries compare with 1: angles, or lengths divided by a typical one. Singular
            values up to 1e-9 count as 0.
    """
    _, sigma, Vh = torch.linalg.svd(rows, full_matrices=True)
    return Vh[int((sigma > 1e-9).sum()) :].mT
