"""A grasp whose moment arms change, with tendon springs and loops: against differences of equilibria."""

import copy
import dataclasses

import pytest
import torch
from made_hands import write_hand
from model_toys import batch_of, stacked

from torch_ekm.description import load_hand, load_object
from torch_ekm.kinematics.poses import GraspState
from torch_ekm.model import ContactMotion, KinematicModel
from torch_ekm.simulation import PlantConfig, PlantParameters
from torch_ekm.simulation.grasp_planning.pinch import PinchRequest, pinch_problem, plan_pinch


@pytest.fixture(scope="module", params=["round", "tendon_springs", "not_round", "four_bar"])
def motion(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> ContactMotion:
    """A planned pinch, settled in the model's own equilibrium."""
    hand = load_hand(write_hand(request.param, tmp_path_factory.mktemp("hands")))
    obj = load_object("can")
    plan = plan_pinch(
        pinch_problem(hand, obj, PlantConfig(), PlantParameters()), PinchRequest(hand.pinch_force)
    )
    state = GraspState(*(torch.from_numpy(x) for x in (plan.q, plan.position, plan.rotation)))
    model = KinematicModel(hand, obj)
    start = model.linearize(state, model.touching(state), on_unstable="flag")
    motion = ContactMotion(model, start, a=torch.from_numpy(plan.motor))
    motion.move(torch.zeros(hand.n_a, dtype=torch.float64))
    return motion


def moved(motion: ContactMotion, way: torch.Tensor) -> torch.Tensor:
    return copy.copy(motion).move(way).increment


def test_the_jacobian_is_that_of_differences_of_the_equilibrium(motion: ContactMotion) -> None:
    n_a, h = motion.model.hand.n_a, 1e-5
    eye = torch.eye(n_a, dtype=torch.float64)
    columns = [(moved(motion, h * one) - moved(motion, -h * one)) / (2 * h) for one in eye]
    differences = torch.stack(columns, dim=1)
    exact = copy.copy(motion).linearize(1e-9 * eye[0]).manipulation_jacobian
    torch.testing.assert_close(exact, differences, atol=2e-5 * float(differences.abs().max()), rtol=0)


def test_the_model_says_the_same_where_contacts_stick(motion: ContactMotion) -> None:
    """J_m with the forces of the equilibrium, from the stiffness and the moment arms there."""
    model, n_a = motion.model, motion.model.hand.n_a
    inside = copy.copy(motion).linearize(torch.zeros(n_a, dtype=torch.float64))
    lin = model.linearize(motion.state, inside.contacts, forces=inside.forces)
    scale = float(inside.manipulation_jacobian.abs().max())
    torch.testing.assert_close(
        lin.manipulation_jacobian, inside.manipulation_jacobian, atol=2e-4 * scale, rtol=0
    )


def test_a_batch_is_its_states(motion: ContactMotion) -> None:
    model, state = motion.model, motion.state
    contacts = model.contacts(state)
    states = [state, dataclasses.replace(state, q=state.q + 0.01)]
    found = model.linearize(batch_of(*states), stacked(contacts, contacts)).manipulation_jacobian
    for k, one in enumerate(states):
        alone = model.linearize(one, contacts).manipulation_jacobian
        torch.testing.assert_close(found[k], alone, atol=1e-9, rtol=0)


def test_figures_that_are_learned_are_factors_of_the_arms(motion: ContactMotion) -> None:
    """J_m by each entry of J_a, the arms being functions of the posture."""
    model = motion.model
    lin = model.linearize(motion.state, model.contacts(motion.state))
    drives, still = model.reduction.drives, torch.zeros(model.hand.n_q, dtype=torch.float64)
    way, rows = torch.linspace(0.01, 0.02, model.hand.n_a, dtype=torch.float64), list(range(lin.n_q + 6))
    now = lin.equations.solve(still, drives)
    torch.testing.assert_close(now.jacobian, lin.manipulation_jacobian, atol=1e-12, rtol=0)
    slopes, h = now.derivative(way, rows).moment_arms, 1e-6
    for i, j in drives.actuation.nonzero().tolist():
        ends = []
        for sign in (1, -1):
            arms = drives.actuation.clone()
            arms[i, j] += sign * h
            ends.append(lin.equations.solve(still, drives._replace(actuation=arms)).jacobian @ way)
        torch.testing.assert_close(slopes[:, i, j], (ends[0] - ends[1]) / (2 * h), atol=1e-6, rtol=1e-4)
