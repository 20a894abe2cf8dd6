"""Noisy states are put into contact: half of the raw ones cannot be modelled, all projected ones can."""

import functools
import math

import numpy as np
import pytest
import torch
from recorded_hand.projection import project_onto_contacts

from torch_ekm._arrays import null_space
from torch_ekm.contact import constraint_matrix
from torch_ekm.description import load_hand, load_object
from torch_ekm.exceptions import EKMError, UnknownNameError
from torch_ekm.kinematics import GraspState
from torch_ekm.model import KinematicModel

pytestmark = pytest.mark.usefixtures("unchecked")  # states of lists
F64, DEG = torch.float64, math.pi / 180
NOISE = {"q_std": 2 * DEG, "position_std": 1e-3, "rotation_std": 2 * DEG}
PINCH = {  # [deg]
    "icub_right": [
        51.2, 19.2, 13.0, 50.2, 4.2, 12.2, 20.2, 39.8, 0, 19.1, 19.9, 38.8, 4.2, 0, 0, 0, 4.2, 0, 0, 0
    ],
    "planar_two_finger": [-18.8, 73.2, -17.4, 56.4],
}  # fmt: skip
POSE = {
    "icub_right": (
        [0.0479, -0.0253, 0.0376],
        [[-0.029, 0.828, -0.56], [0.995, 0.079, 0.064], [0.098, -0.556, -0.826]],
    ),
    "planar_two_finger": ([0.0024, 0.0578, 0.0], [[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
}
PADS = {"icub_right": ("thumb", "index", "middle"), "planar_two_finger": ("left", "right")}


@functools.lru_cache
def grasp(hand):
    """A model of the hand with the box, and a state in contact."""
    model = KinematicModel(load_hand(hand), load_object("box"))
    position, rotation = POSE[hand]
    U, _, Vh = torch.linalg.svd(torch.tensor(rotation, dtype=F64))
    rough = GraspState(torch.tensor(PINCH[hand], dtype=F64) * DEG, position, U @ Vh)
    return model, project_onto_contacts(model, rough, **NOISE, touching=PADS[hand]).state


def noisy(hand, draws, seed):
    model, true = grasp(hand)
    Z = model.reduction.basis  # couplings and the plane hold
    generator = torch.Generator().manual_seed(seed)
    std = torch.tensor([2 * DEG] * model.hand.n_q + [1e-3] * 3 + [2 * DEG] * 3, dtype=F64)
    for _ in range(draws):
        noise = std * torch.randn(len(std), dtype=F64, generator=generator)
        yield true.plus(Z @ (torch.linalg.pinv(Z) @ noise))


def fails(call):
    try:
        call()
    except EKMError:
        return True
    return False


@pytest.mark.parametrize("hand", list(PINCH))
def test_half_of_the_noisy_states_cannot_be_modelled_but_all_that_are_projected(hand):
    model, true = grasp(hand)
    raw, chi2, before, after = 0, [], [], []
    for state in noisy(hand, 30, 0):
        raw += fails(lambda state=state: model.linearize(state))
        projection = project_onto_contacts(model, state, **NOISE, touching=PADS[hand])
        assert projection.contacts.finger == PADS[hand]
        assert float(projection.contacts.gap.abs().max()) < 1e-6
        model.linearize(projection.state)
        model.linearize(projection.state, projection.contacts)
        chi2.append(projection.chi2)
        before.append(state.minus(true)[: model.hand.n_q].norm())
        after.append(projection.state.minus(true)[: model.hand.n_q].norm())
    assert 10 <= raw <= 22
    assert 0.5 * len(PADS[hand]) < np.mean(chi2) < 1.5 * len(PADS[hand])
    assert np.mean(after) < 0.95 * np.mean(before)  # the contacts say something about the joints


def test_it_is_the_nearest_state_in_contact():
    """No other motion that keeps the gaps closed leads nearer to the measurement."""
    model, _ = grasp("icub_right")
    std = torch.tensor([2 * DEG] * 20 + [1e-3] * 3 + [2 * DEG] * 3, dtype=F64)
    state = next(noisy("icub_right", 1, 3))
    projection = project_onto_contacts(model, state, **NOISE, touching=PADS["icub_right"])
    change = projection.state.minus(state)
    kin = model.contact_kinematics(projection.state, projection.contacts)
    Z = model.reduction.basis
    A_n = constraint_matrix(kin)[kin.normal_rows]
    keep = Z @ null_space(A_n @ Z)
    slope = keep.mT @ (change / std**2)
    assert slope.abs().max() < 0.02 * (keep.mT.abs() @ (change.abs() / std**2)).max()
    with pytest.raises(UnknownNameError, match="thumbs"):
        project_onto_contacts(model, state, **NOISE, touching=["thumbs"])
