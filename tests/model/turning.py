"""The actions of the tests."""

from __future__ import annotations

import torch

F64 = torch.float64


def turning(lin, axis, step):
    """Least squares: turn about the axis, hardly about others, keep the normal forces, small effort."""
    J = lin.object_jacobian[3:]
    across = torch.eye(3, dtype=F64) - torch.outer(axis, axis)
    eye = torch.eye(J.shape[1], dtype=F64)
    rows = torch.cat([100 * (axis @ J)[None], 3 * across @ J, 0.3 * lin.normal_force_sensitivity, 0.3 * eye])
    wish = torch.zeros(len(rows), dtype=F64)
    wish[0] = 100 * step
    return torch.linalg.lstsq(rows, wish).solution
