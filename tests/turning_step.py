"""A controller of few lines that turns a held object, for tests of what a model predicts."""

import torch

from torch_ekm.kinematics import GraspState

F64 = torch.float64


def true_state(observation) -> GraspState:
    return observation.truth.state


def turning_step(lin, axis, step, grip, keep=0.02):
    """Least squares: turn about the axis, hardly about others, keep the grip, small effort."""
    J = lin.object_jacobian[3:]
    across = torch.eye(3, dtype=F64) - torch.outer(axis, axis)
    eye = torch.eye(J.shape[1], dtype=F64)
    rows = [100 * (axis @ J)[None], 3 * across @ J, keep * lin.normal_force_sensitivity, 0.3 * eye]
    wish = [
        torch.tensor([100 * step], dtype=F64),
        torch.zeros(3, dtype=F64),
        keep * (grip - lin.forces.normal),
    ]
    return torch.linalg.lstsq(torch.cat(rows), torch.cat([*wish, torch.zeros(len(eye), dtype=F64)])).solution
