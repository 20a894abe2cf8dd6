from __future__ import annotations

from typing import Any

from .._arrays import namespace
from ..typing import AnyArray, Float


def null_space(rows: Float[AnyArray, "m n"]) -> Float[Any, "n n_free"]:
    """Orthonormal basis N of ``rows N = 0`` (SVD); all of space where there are no rows.

    Args:
        rows: constraints whose entries compare with 1: angles, or lengths divided by a typical one. Singular
            values up to 1e-9 count as 0.
    """
    _, sigma, Vh = namespace(rows).linalg.svd(rows, full_matrices=True)
    return Vh[int((sigma > 1e-9).sum()) :].mT
