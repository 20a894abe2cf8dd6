"""What a set of linear constraints leaves free."""

from __future__ import annotations

import torch

from ..typing import Float, Tensor


def null_space(rows: Float[Tensor, "m n"], tolerance: float = 1e-9) -> Float[Tensor, "n n_free"]:
    """Orthonormal basis N of ``rows N = 0`` (SVD); all of space where there are no rows.

    Args:
        rows: constraints whose entries compare with 1: angles, or lengths divided by a typical one.
        tolerance: singular values up to this count as 0.
    """
    _, sigma, Vh = torch.linalg.svd(rows, full_matrices=True)
    return Vh[int((sigma > tolerance).sum()) :].mT
