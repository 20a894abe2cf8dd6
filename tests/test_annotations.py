"""A wrong shape raises while the tests run, in each package whose annotations are checked."""

import os
from collections.abc import Callable

import annotations as shapes  # beside this file
import jaxtyping
import pytest
import torch

from torch_ekm.contact import ContactSet
from torch_ekm.control.tasks import contact_travel
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.kinematics.se3 import hat
from torch_ekm.model.reduction import planar_pose_basis
from torch_ekm.residual import UpdateReport, ZeroResidual


def two_contacts_with_a_gap_too_many() -> ContactSet:
    return ContactSet(
        finger=("left", "right"),
        link=("left_1", "right_1"),
        point=torch.zeros(2, 3),
        normal=torch.eye(3)[:2],
        gap=torch.zeros(3),
        finger_curvature=torch.zeros(2, 3, 3),
        object_curvature=torch.zeros(2, 3, 3),
        friction=torch.ones(2),
        torsional_friction=torch.zeros(2),
    )


def increments_of_a_model_that_invents_a_batch() -> torch.Tensor:
    model = EnhancedModel(lambda state, action: torch.zeros(4, 3), ZeroResidual(5, 3))
    return model.nominal(torch.zeros(3), torch.zeros(2))


#: A call with a wrong shape in each package. Without the hook it passes, or raises an error of its own.
WRONG: dict[str, Callable[[], object]] = {
    "kinematics": lambda: hat(torch.zeros(4)),
    "contact": two_contacts_with_a_gap_too_many,
    "model": lambda: planar_pose_basis(torch.ones(2)),
    "residual": lambda: UpdateReport(torch.zeros(3, dtype=torch.int64), *torch.zeros(3, 2)),
    "enhanced": increments_of_a_model_that_invents_a_batch,
    "control": lambda: contact_travel(torch.zeros(6), torch.zeros(2, 2)),
}


@pytest.mark.skipif("CHECK_SHAPES" in os.environ, reason="the environment names what is checked")
@pytest.mark.parametrize("package", WRONG)
def test_a_wrong_shape_raises(package: str) -> None:
    with pytest.raises(jaxtyping.TypeCheckError):
        WRONG[package]()


def test_each_package_that_is_checked_has_its_call() -> None:
    assert set(shapes.CHECKED) == set(WRONG)


@pytest.mark.usefixtures("unchecked")
def test_the_fixture_lets_wrong_shapes_through_to_the_package_s_own_error() -> None:
    with pytest.raises(RuntimeError):
        hat(torch.zeros(4))
