"""The grasp worked by hand in the docs: the model gives every number printed there."""

import math
from pathlib import Path

import pytest
import torch

from torch_ekm.contact import ContactSet, constraint_matrix
from torch_ekm.description import load_hand, load_object
from torch_ekm.kinematics import GraspState
from torch_ekm.model import KinematicModel
from torch_ekm.model.stiffness import geometric_stiffness

PAGE = Path(__file__).parents[2] / "docs" / "explanation" / "quasi_static_model.md"
F64 = torch.float64
H = 0.04 + 0.03 * math.cos(math.pi / 6)  # [m] height of the tips


@pytest.fixture(scope="module")
def grasp():
    ball, flat = torch.diag(torch.tensor([0, 1, 1], dtype=F64) / 0.006), torch.zeros(2, 3, 3, dtype=F64)
    state = GraspState(
        q=torch.tensor([0, math.pi / 6] * 2, dtype=F64),
        position=torch.tensor([0, H, 0], dtype=F64),
        rotation=torch.eye(3, dtype=F64),
    )
    contacts = ContactSet(
        finger=("left", "right"),
        link=("left_1", "right_1"),
        gap=torch.zeros(2, dtype=F64),
        point=torch.tensor([[-0.009, H, 0], [0.009, H, 0]], dtype=F64),
        normal=torch.tensor([[-1, 0, 0], [1, 0, 0]], dtype=F64),
        finger_curvature=ball.expand(2, 3, 3),
        object_curvature=flat,
        friction=torch.full((2,), 0.9, dtype=F64),
        torsional_friction=torch.zeros(2, dtype=F64),
    )
    model = KinematicModel(load_hand("planar_two_finger"), load_object("box"))
    return model, model.linearize(state, contacts)


def printed(text: str) -> bool:
    return text in PAGE.read_text(encoding="utf-8")


def test_forces_and_stiffness_of_the_example_by_hand(grasp):
    model, lin = grasp
    assert printed(f"$f={lin.forces.normal[0]:.3f}$ N")
    assert printed(f"$t={-lin.forces.lam[0]:.3f}$ N m")
    kin = model.contact_kinematics(lin.state, lin.contacts)
    row = constraint_matrix(kin)[kin.normal_rows[0]]
    assert printed(f"${1e3 * row[0]:.1f}\\,\\delta q_0+{1e3 * row[1]:.1f}\\,\\delta q_1=0$")
    force = lin.forces.force
    spring = model.potential(lin.state)[1]
    still = model.contact_kinematics(lin.state, lin.contacts, rolling=False)
    bent = geometric_stiffness(still, force, lin.forces.spin_moment, model.precedes)
    rolled = geometric_stiffness(kin, force, lin.forces.spin_moment, model.precedes)
    assert printed(f"$S=-0.021f={bent[0, 0]:.4f}$ and rolling $+0.006f={(rolled - bent)[0, 0]:+.4f}$")
    D = spring + rolled
    assert printed(f"$D_{{00}}={D[0, 0]:.4f}$, $D_{{01}}={D[0, 1]:.4f}$, $D_{{11}}={D[1, 1]:.4f}$ N m/rad")


def test_motion_of_the_example_by_hand(grasp):
    _, lin = grasp
    both = lin.manipulation_jacobian.sum(-1)  # both tendons pull alike
    assert printed(f"$\\sigma={-both[0]:.3f}\\,\\delta a$: the box moves down by {-1e3 * both[5]:.0f} mm/rad")
    assert float(both[1] / -both[0]) == pytest.approx(2.54, abs=0.005)
    assert float(1e3 * both[5] / -both[0]) == pytest.approx(-32.3, abs=0.05)
    torch.testing.assert_close(both[[4, 9]], torch.zeros(2, dtype=both.dtype), atol=1e-8, rtol=0)
