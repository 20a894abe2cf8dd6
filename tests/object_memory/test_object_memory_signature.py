"""Grasps sorted by what they feel like: the mixture against brute force, the bank, a hand's features."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch
from torch.distributions import MultivariateNormal, StudentT

from torch_ekm.description import load_hand
from torch_ekm.exceptions import NonFiniteError, ParameterError, ShapeError, UnknownNameError
from torch_ekm.kinematics import HandKinematics
from torch_ekm.object_memory import GraspSignature, ModelBank, SignatureModel, model_bank
from torch_ekm.residual import ActionLinearKernel, SparseOnlineGP, SquaredExponential

N_A, D = 2, 3


def signatures(per_group: int, seed: int, apart: float = 10.0) -> tuple[torch.Tensor, torch.Tensor]:
    """Four objects, three of them apart along one feature only; correlated scatter, in random order."""
    generator = torch.Generator().manual_seed(seed)
    centre = apart * torch.tensor(
        [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [2.0, 0.0, 0.0]], dtype=torch.float64
    )
    label = torch.arange(4).repeat(per_group)[torch.randperm(4 * per_group, generator=generator)]
    root = torch.tensor([[1.0, 0.0, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.2]], dtype=torch.float64)
    noise = torch.randn(4 * per_group, D, generator=generator, dtype=torch.float64)
    return centre[label] + noise @ root.mT, label


def same_partition(a: torch.Tensor, b: torch.Tensor) -> bool:
    return bool(((a[:, None] == a) == (b[:, None] == b)).all())


# -- the mixture ---------------------------------------------------------------------------------------


def test_predictive_density_in_a_group_is_students() -> None:
    """One feature, one group: p(z_n+1 | z_1..n, same group) is Student's t, scatter integrated out."""
    generator = torch.Generator().manual_seed(0)
    z = torch.randn(5, 1, generator=generator, dtype=torch.float64)
    model = SignatureModel()
    model.spread, model.strength = 1e6, 7.0  # so wide that the mean is known from the data alone

    def log_density(value: float) -> float:
        more = torch.cat([z, torch.tensor([[value]], dtype=torch.float64)])
        return float(model.log_joint(more, torch.zeros(6, dtype=torch.int64), 1))

    S = float((z - z.mean()).square().sum())
    nu = 7.0 + 4
    scale = math.sqrt((7.0 + S) / nu * (1 + 1 / 5))
    exact = StudentT(torch.tensor(nu), torch.tensor(float(z.mean())), torch.tensor(scale))
    # the plugged-in B depends a little on the new value: a difference of densities, not exact
    for value in (-2.0, 0.5, 4.0):
        expected = float(exact.log_prob(torch.tensor(value)) - exact.log_prob(torch.tensor(0.0)))
        assert log_density(value) - log_density(0.0) == pytest.approx(expected, abs=1e-6)


def test_log_joint_agrees_with_its_formula_written_out() -> None:
    z, _ = signatures(2, seed=1)
    label = torch.tensor([0, 2, 2, 0, 3, 3, 3, 0])
    model = SignatureModel()
    model.spread, model.strength, model.concentration = 5.0, 9.0, 0.7
    groups = [z[label == k] for k in (0, 2, 3)]
    n, K = len(z), len(groups)
    means = torch.stack([group.mean(0) for group in groups])
    S = sum(((g - g.mean(0)).mT @ (g - g.mean(0)) for g in groups), torch.zeros(D, D, dtype=torch.float64))
    eye = torch.eye(D, dtype=torch.float64)
    W = (9.0 * eye + S) / (9.0 + n - K)
    off = means - means.mean(0)
    B = (3 * 25.0 * eye + off.mT @ off) / (3 + K - 1)
    h = (9.0 + D - 1 + n - K) / 2
    expected = K * math.log(0.7) - h * float(torch.logdet(9.0 * eye + S))
    expected += sum(math.lgamma(h - j / 2) for j in range(D)) + D * (D - 1) / 4 * math.log(math.pi)
    expected -= (n - K) * D / 2 * math.log(math.pi)
    for group, mean in zip(groups, means, strict=True):
        N = len(group)
        law = MultivariateNormal(means.mean(0), B + W / N)
        expected += math.lgamma(N) - D / 2 * math.log(N) + float(law.log_prob(mean))
    assert float(model.log_joint(z, label, 5)) == pytest.approx(expected, rel=1e-12)


def test_sorting_finds_the_best_of_all_partitions() -> None:
    model = SignatureModel()
    for seed in range(5):
        z = signatures(2, seed)[0][:6]
        every = torch.tensor(list(itertools.product(range(4), repeat=6)))
        best = model.log_joint(z, every, 4).max()
        found = model.sort(z, torch.zeros(6, dtype=torch.int64), 4)
        assert float(model.log_joint(z, found, 4)) == pytest.approx(float(best), abs=1e-9)


@pytest.mark.parametrize("start", ["one group", "each its own", "shuffled"])
def test_objects_are_found_from_any_beginning(start: str) -> None:
    z, truth = signatures(6, seed=4)
    begin = {
        "one group": torch.zeros(24, dtype=torch.int64),
        "each its own": torch.arange(24) % 8,
        "shuffled": truth.roll(7),
    }[start]
    found = SignatureModel().sort(z, begin, 8)
    assert same_partition(found, truth)


def test_evidence_from_elsewhere_decides_between_objects_that_feel_alike() -> None:
    z = torch.zeros(6, D, dtype=torch.float64)
    truth = torch.tensor([0, 1, 0, 1, 0, 1])
    evidence = torch.full((6, 2), -30.0, dtype=torch.float64)
    evidence[torch.arange(6), truth] = 0.0
    model = SignatureModel()
    assert same_partition(model.sort(z, torch.zeros(6, dtype=torch.int64), 2, evidence), truth)
    assert same_partition(model.sort(z, truth, 2), torch.zeros(6, dtype=torch.int64))


def test_posterior_of_a_new_signature() -> None:
    z, truth = signatures(5, seed=4)
    model = SignatureModel()
    for k in range(4):
        mean = z[truth == k].mean(0)
        assert float(model.log_posterior(mean, z, truth, 6).exp()[k]) > 0.99
    far = torch.tensor([0.0, -20.0, 0.0], dtype=torch.float64)
    p = model.log_posterior(far, z, truth, 6).exp()
    assert float(p[4]) > 0.9  # the first free group is the new one
    assert float(p[5]) == 0.0
    assert float(model.log_posterior(far, z, truth, 4).exp().sum()) == pytest.approx(1.0)  # full: an old one


# -- the bank ------------------------------------------------------------------------------------------


def learner(**options: Any) -> SparseOnlineGP:
    kernel = ActionLinearKernel(1 + N_A, N_A, state_kernel=SquaredExponential(1, lengthscale=10.0))
    chosen = {"capacity": 12, "kernel": kernel, "noise_variance": 0.01, "parts": (), "standardize": False}
    return SparseOnlineGP(1 + N_A, 2, **{**chosen, **options})


def samples(k: int, n: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Objects 0 and 1 answer alike, as do 2 and 3: residuals cannot tell them apart."""
    x = torch.randn(n, 1 + N_A, generator=generator, dtype=torch.float64)
    slope = torch.tensor([[1.0, 0.2], [0.3, -1.0]], dtype=torch.float64) * (1 + k // 2)
    return x, x[:, 1:] @ slope + 0.1 * torch.randn(n, 2, generator=generator, dtype=torch.float64)


def session(bank: ModelBank, z: torch.Tensor, truth: torch.Tensor, signed: bool = True) -> list[int | None]:
    generator = torch.Generator().manual_seed(9)
    placed = []
    for i, k in enumerate(truth.tolist()):
        if i:
            placed.append(bank.begin(z[i] if signed else None))
        else:
            bank.begin(z[i] if signed else None)
        bank.update(*samples(k, 6, generator))
    return [*placed, bank.end()]


def bank(models: int = 6, **options: Any) -> ModelBank:
    return ModelBank(learner, models, signature_features=D, temperature=0.1, **options)


def test_objects_that_answer_alike_are_told_apart_by_what_they_feel_like() -> None:
    z, truth = signatures(6, seed=4)
    signed, blind = bank(), ModelBank(learner, 6)
    placed = session(signed, z, truth)
    assert signed.n_models == 4
    late = slice(12, None)
    assert same_partition(torch.tensor(placed)[late], truth[late])
    session(blind, z, truth, signed=False)
    assert blind.n_models <= 2


def test_leader_is_known_before_the_first_motion() -> None:
    z, truth = signatures(6, seed=4)
    signed = bank()
    placed = session(signed, z, truth)
    for k in range(4):
        signed.begin(z[truth == k].mean(0))
        assert int(signed.leader) == placed[-1 - truth.flip(0).tolist().index(k)]
        assert float(signed.posterior[signed.leader]) > 0.95


def test_confused_grasps_are_learned_again_where_they_belong(monkeypatch) -> None:
    """Confused until the last grasp, the models then hold what labelled ones hold, in the order of time."""
    z, truth = signatures(6, seed=4)
    monkeypatch.setattr(model_bank, "_COMMON_WEIGHTS", (0.0,))
    signed = bank()
    signed.signatures.concentration = 1e-30
    session(signed, z, truth)
    assert signed.memory is not None
    assert signed.n_models < 4
    signed.signatures = SignatureModel()
    signed._sort_memory(signed.memory)
    rows = signed.memory.known
    assert same_partition(signed.memory.label[rows], truth)
    generator = torch.Generator().manual_seed(9)
    data = [samples(k, 6, generator) for k in truth.tolist()]
    probe = torch.randn(5, 1 + N_A, generator=generator, dtype=torch.float64)
    for k in range(4):
        labelled = learner()
        for (x, y), own in zip(data, truth.tolist(), strict=True):
            if own == k:
                labelled.update(x, y)
        slot = int(signed.memory.label[rows][truth == k][0])
        kept = signed.kept[slot]
        torch.testing.assert_close(kept(probe), labelled(probe), atol=1e-8, rtol=0)
        assert int(signed.episodes[slot]) == 6


def test_full_memory_gives_up_the_oldest_of_the_most_frequent(monkeypatch) -> None:
    z, _ = signatures(6, seed=4)
    order = torch.tensor([3, 0, 0, 0, 0, 0, 0, 0])
    monkeypatch.setattr(model_bank, "_REMEMBERED", 4)
    small = bank(models=3)
    centre = torch.stack([z[0], z[0] + 40.0])
    session(small, torch.stack([centre[int(k == 3)] for k in order]), order)
    assert small.memory is not None
    kept = small.memory.label[small.memory.known].tolist()
    assert len(kept) == 4
    assert len(set(kept)) == 2  # the rare one is still there
    assert int(small.episodes.sum()) == 8


def test_state_survives_a_reload() -> None:
    z, truth = signatures(4, seed=5)
    one, other = bank(), bank()
    session(one, z, truth)
    one.begin(z[0])
    other.load_state_dict(one.state_dict())
    x, y = samples(0, 6, torch.Generator().manual_seed(1))
    for each in (one, other):
        each.update(x, y)
    assert one.end() == other.end()
    torch.testing.assert_close(one(x), other(x), rtol=0, atol=0)


def test_wrong_signatures_are_refused_and_nothing_changes() -> None:
    z, truth = signatures(2, seed=0)
    signed = bank()
    session(signed, z, truth)
    signed.begin(z[0])
    signed.update(*samples(0, 4, torch.Generator().manual_seed(0)))
    before = {name: value.clone() for name, value in signed.state_dict().items() if torch.is_tensor(value)}
    for wrong, error in (
        (None, ParameterError),
        (torch.zeros(D + 1), ShapeError),
        (torch.full((D,), math.nan), NonFiniteError),
    ):
        with pytest.raises(error, match="signature"):
            signed.begin(wrong)
    for name, value in before.items():
        assert torch.equal(signed.state_dict()[name], value), name
    with pytest.raises(ParameterError, match="signature_features"):
        ModelBank(learner, 2).begin(torch.zeros(D))


# -- the features of a hand ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def hand():
    return load_hand("icub_right")


def posture(hand, bend: float = 0.5) -> torch.Tensor:
    lower, upper = torch.from_numpy(hand.joint_lower.copy()), torch.from_numpy(hand.joint_upper.copy())
    return lower + bend * (upper - lower)


def test_width_is_the_distance_of_the_pads(hand) -> None:
    q, a, force = posture(hand), torch.zeros(hand.n_a).double(), torch.zeros(len(hand.pads)).double()
    names = [pad.name for pad in hand.pads]
    kinematics = HandKinematics(hand)

    def end(name: str) -> np.ndarray:
        pad = hand.pads[names.index(name)]
        pose = kinematics(q).of(pad.link).numpy()
        return (pose @ np.array([*pad.end, 1.0]))[:3]

    radius = [hand.pads[names.index(name)].radius for name in ("thumb", "index", "middle")]
    one = GraspSignature(hand, "thumb", ["index"], width_scatter=1.0)
    expected = np.linalg.norm(end("thumb") - end("index")) - radius[0] - radius[1]
    assert float(one(q, a, force)[0]) == pytest.approx(expected)
    two = GraspSignature(hand, "thumb", ["index", "middle"], width_scatter=1.0)
    line = end("middle") - end("index")
    area = np.linalg.norm(np.cross(end("thumb") - end("index"), line))
    expected = area / np.linalg.norm(line) - radius[0] - (radius[1] + radius[2]) / 2
    assert float(two(q, a, force)[0]) == pytest.approx(expected)


def test_load_is_what_the_contact_does_to_the_joints_of_a_tendon(hand) -> None:
    """Equilibrium: springs, any tendons and couplings, and contact forces; only the contact shows."""
    signature = GraspSignature(hand, "thumb", ["index", "middle"], load_scatter=1.0)
    generator = np.random.default_rng(0)
    contact = generator.normal(size=hand.n_q) * 0.01  # J_h^T f [N m]
    tension, locks = generator.normal(size=hand.n_a), generator.normal(size=len(hand.coupling))
    # K_s (q - q0) = J_a^T lam + C^T nu - J_h^T f
    torque = hand.actuation_jacobian.T @ tension + hand.coupling.T @ locks - contact
    q = torch.from_numpy(hand.spring_rest + torque / hand.spring_stiffness)
    a, force = torch.zeros(hand.n_a).double(), torch.zeros(len(hand.pads)).double()
    load = signature(q, a, force)[1 : 1 + 3]
    names = hand.joint_names
    expected = []
    for finger in ("thumb", "index", "middle"):  # the two joints of the distal tendon share its motion
        i, j = names.index(f"{finger}_2"), names.index(f"{finger}_3")
        expected.append((contact[i] - contact[j]) / math.sqrt(2))
    np.testing.assert_allclose(load.numpy(), expected, atol=1e-9)


def test_joints_without_a_sensor_are_read_from_the_encoders(hand) -> None:
    q = posture(hand)
    q = q - torch.linalg.pinv(torch.from_numpy(hand.coupling)) @ (torch.from_numpy(hand.coupling) @ q)
    a = torch.from_numpy(hand.actuator_offset + hand.actuation_jacobian @ q.numpy())
    force = torch.ones(len(hand.pads)).double()
    blind = ["thumb_0", "index_0", "ring_0", "little_0"]
    signature = GraspSignature(hand, "thumb", ["index", "middle"], from_encoders=blind)
    wrong = q.clone()
    wrong[[hand.joint_names.index(name) for name in blind]] += 0.3
    plain = GraspSignature(hand, "thumb", ["index", "middle"])
    torch.testing.assert_close(signature(wrong, a, force), plain(q, a, force))
    assert float((plain(wrong, a, force) - plain(q, a, force)).abs().max()) > 1.0
    batch = signature(q.expand(4, -1), a.expand(4, -1), force.expand(4, -1))
    torch.testing.assert_close(batch[2], signature(q, a, force))


def test_wrong_pads_and_readings_are_refused(hand) -> None:
    with pytest.raises(UnknownNameError, match="middle"):
        GraspSignature(hand, "thumb", ["nose"])
    with pytest.raises(ParameterError, match="oppose"):
        GraspSignature(hand, "thumb", [])
    with pytest.raises(UnknownNameError, match="thumb_0"):
        GraspSignature(hand, "thumb", ["index"], from_encoders=["elbow"])
    with pytest.raises(ParameterError, match="force_scatter"):
        GraspSignature(hand, "thumb", ["index"], force_scatter=0.0)
    signature = GraspSignature(hand, "thumb", ["index"])
    q, a, force = posture(hand), torch.zeros(hand.n_a).double(), torch.zeros(len(hand.pads)).double()
    with pytest.raises(ShapeError, match="fingertip_force"):
        signature(q, a, force[:2])
    with pytest.raises(ParameterError, match="fingertip_force"):
        signature(q, a, None)
    with pytest.raises(NonFiniteError, match="q"):
        signature(q * torch.nan, a, force)
