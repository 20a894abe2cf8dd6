"""What linear constraints leave free."""

from __future__ import annotations

import pytest
import torch

from torch_ekm.kinematics.tensors import null_space

F64 = torch.float64


@pytest.mark.parametrize(("m", "n", "repeated"), [(3, 7, 0), (3, 7, 2), (5, 5, 0), (0, 4, 0), (4, 0, 0)])
def test_it_is_orthonormal_and_complete(m, n, repeated):
    rows = torch.randn(m, n, dtype=F64, generator=torch.Generator().manual_seed(m))
    N = null_space(torch.cat([rows, rows[:repeated] + rows[1 : repeated + 1]]))
    assert N.shape == (n, max(n - m, 0))
    assert torch.allclose(N.mT @ N, torch.eye(N.shape[1], dtype=F64))
    assert (rows @ N).abs().amax() < 1e-14 if rows.numel() and N.numel() else True


def test_a_row_of_rounding_errors_takes_nothing():
    assert null_space(torch.full((1, 3), 1e-17, dtype=F64)).shape == (3, 3)
