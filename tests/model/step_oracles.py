"""Two other forms of the quasi-static step, equal to ``two_stage`` in exact arithmetic."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ekm.kinematics.null_space import null_space


def kkt_form(D: Tensor, E: Tensor, R: Tensor, compliance: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """``[[D, E^T], [E, -compliance]] [J; dnu/da] = [0; R]``: motion and multipliers at once.

    ``compliance`` is 1/K of each row, 0 of rigid ones.
    """
    n, m = len(D), len(E)
    corner = D.new_zeros(m, m) if compliance is None else -torch.diag(compliance)
    matrix = torch.cat([torch.cat([D, E.mT], 1), torch.cat([E, corner], 1)])
    J, dnu = torch.linalg.solve(matrix, torch.cat([D.new_zeros(n, R.shape[1]), R])).split([n, m])
    return J, dnu


def null_space_form(D: Tensor, A: Tensor, B: Tensor) -> Tensor:
    """``J = R K^-1 R^T B^T (B R K^-1 R^T B^T)^-1``, ``R = null(A)``, ``K = R^T D R``: the paper's form.

    It needs K itself to be invertible, which a stable grasp does not promise, and it is silently wrong if
    there are more actuators than mobility.
    """
    R = null_space(A)
    X = R @ torch.linalg.solve(R.mT @ D @ R, R.mT @ B.mT)
    return X @ torch.linalg.inv(B @ X)
