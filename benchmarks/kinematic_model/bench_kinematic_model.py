"""Time of the kinematic model for the iCub hand: contacts, forces, D, J_m, a batch of 1024 states.

Run with ``pytest bench_kinematic_model.py`` (pytest-benchmark), one thread. The grasp is a pinch
of the box between thumb, index and middle finger: 20 joints, 9 actuators, 3 contacts.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

pytest.importorskip("pytest_benchmark")
sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "model"))

from model_icub import gripped

from torch_ekm.contact import ContactDetector, constraint_matrix
from torch_ekm.description import load_object
from torch_ekm.kinematics import GraspState
from torch_ekm.model import KinematicModel
from torch_ekm.model.stiffness.geometric import geometric_stiffness

BATCH = 1024


@pytest.fixture(scope="module", autouse=True)
def _one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def grasp():
    model, solver, at = gripped("box")
    return model, solver, at, solver.forces(at)


def with_detector(model):
    """The same hand and inertia, contacts by collision detection on the box of the catalogue."""
    box = load_object("box")
    detector = ContactDetector(model.hand, box, margin=0.02, kinematics=model.kinematics)
    full = KinematicModel(model.hand, box, model.options, kinematics=model.kinematics, detector=detector)
    full._detector_takes_poses = True
    return full


def test_linearize_contacts_and_forces_included(benchmark, grasp):
    model, _, at, _ = grasp
    full = with_detector(model)
    assert full.contacts(at.state).n_c == 3
    lin = benchmark(full.linearize, at.state)
    assert torch.isfinite(lin.manipulation_jacobian).all()


def test_contacts(benchmark, grasp):
    model, _, at, _ = grasp
    assert benchmark(with_detector(model).contacts, at.state).n_c == 3


def test_forces(benchmark, grasp):
    model, _, at, _ = grasp
    state = at.state
    kin = model.contact_kinematics(state, at.contacts)
    A = constraint_matrix(kin)
    V_s, _ = model.potential(state)
    assert benchmark(model.balance, state.q, kin, A, V_s).solved


def test_stiffness(benchmark, grasp):
    model, _, at, forces = grasp
    kin = model.contact_kinematics(at.state, at.contacts)
    benchmark(geometric_stiffness, kin, forces.force, forces.spin_moment, model.precedes)


def test_linearize_with_known_contacts_and_forces(benchmark, grasp):
    model, _, at, forces = grasp
    benchmark(model.linearize, at.state, at.contacts, forces=forces)


def test_batch_with_known_contacts_and_forces(benchmark, grasp):
    """Divide by 1024 for the time of a state."""
    import dataclasses

    model, _, at, forces = grasp

    def many(x):
        return x.expand(BATCH, *x.shape).contiguous()

    state = GraspState(many(at.state.q), many(at.state.position), many(at.state.rotation))
    names = ("point", "normal", "gap", "finger_curvature", "object_curvature")
    contacts = at.contacts.replace(**{name: many(getattr(at.contacts, name)) for name in names})
    fields = {
        f.name: many(getattr(forces, f.name))
        for f in dataclasses.fields(forces)
        if f.name != "status" and getattr(forces, f.name) is not None
    }
    batch = dataclasses.replace(forces, status=forces.status * BATCH, **fields)
    lin = benchmark.pedantic(
        model.linearize, args=(state, contacts), kwargs={"forces": batch}, rounds=5, warmup_rounds=1
    )
    single = model.linearize(at.state, at.contacts, forces=forces)
    assert torch.allclose(lin.manipulation_jacobian[7], single.manipulation_jacobian, atol=1e-12)
