"""Which combinations of parameters the data cannot tell, in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..._extras import require
from ...typing import Array
from .parameters import Parameter

_TOLD = 1.0  # information, in units of the prior's: below, the answer is mostly the prior
_SEEN = 1e-3  # below, a parameter moves nothing at all
_PART = 0.3  # of the largest entry of a combination: smaller ones are not named


def unidentified(parameters: Sequence[Parameter], information: Array) -> tuple[str, ...]:
    """Eigenvectors of the Fisher information with less than a prior's worth, each as a sentence.

    Args:
        parameters: in the order of the matrix.
        information: of the data alone, in units of the priors ``(n, n)``.
    """
    seen = np.diag(information) > _SEEN
    sentences = []
    if not seen.all():
        names = ", ".join(p.label for p, one in zip(parameters, seen, strict=True) if not one)
        sentences.append(f"no motion depends on: {names}")
    kept = [p for p, one in zip(parameters, seen, strict=True) if one]
    values, vectors = np.linalg.eigh(information[np.ix_(seen, seen)])
    weak = vectors[:, values < _TOLD]
    if weak.shape[1]:
        # a basis of the weak directions in which each has a parameter of its own: short sentences
        _, _, pivots = require("scipy.linalg").qr(weak.T, pivoting=True)
        weak = weak @ np.linalg.inv(weak[pivots[: weak.shape[1]]])
        sentences += [_sentence(kept, direction) for direction in weak.T]
    return tuple(sentences)


def _sentence(parameters: Sequence[Parameter], direction: Array) -> str:
    direction = direction / np.abs(direction).max()
    parts = [(p, v) for p, v in zip(parameters, direction, strict=True) if abs(v) > _PART]
    parts.sort(key=lambda part: -abs(part[1]))
    names = " and ".join(p.label for p, _ in parts)
    if len(parts) == 1:
        return f"{names} cannot be told"
    if all(p.logarithmic for p, _ in parts):
        signs = {bool(v > 0) for _, v in parts}
        if len(parts) == 2:
            return f"{names} only as a {'ratio' if len(signs) == 1 else 'product'}"
        if len(signs) == 1:
            return f"{names} only up to a common factor"
    weights = ", ".join(f"{v:+.1f} {p.label}" for p, v in parts)
    return f"not told, in units of the priors: {weights}"
