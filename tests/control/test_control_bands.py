"""How sure a model is of where a movement leads, and how far motions end from that."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from obedient_plant import untaught

from torch_ekm.control import Bands, HandFigures, HandKnowledge, PoseTarget
from torch_ekm.control.rehearsal import lets_go, servo_std
from torch_ekm.estimation.knowledge import STEADY, ModelError

DEG = math.pi / 180
F64 = torch.float64


@pytest.fixture(scope="module")
def path(held):
    """A controller, its knowledge, where it begins, its target, and the first four pieces."""
    (seen, axis, _), loop = held, untaught(held)
    target = PoseTarget.turned(seen.state, axis, degrees=9)
    return loop.controller, loop.knowledge, seen, target, loop.plan(target).waypoints[:4]


def slopes(figures: HandFigures, lin, action) -> np.ndarray:
    """``d(J_m w)/d theta`` of the object's rows, by central differences."""
    columns, h = [], 1e-5
    for i in range(len(figures)):
        ends = []
        for sign in (1, -1):
            figures.mean[i] += sign * h
            ends.append((figures.solve(lin.equations).jacobian @ action)[-6:].numpy())
            figures.mean[i] -= sign * h
        columns.append((ends[0] - ends[1]) / (2 * h))
    return np.stack(columns, -1)


def test_deviations_of_figures_and_of_g_add_up_along_a_path(path) -> None:
    controller, knowledge, seen, target, waypoints = path
    bands, error = Bands(controller, knowledge, seen, target), knowledge.error
    G, g, way = 0.0, 0.0, np.zeros(3)
    P = knowledge.figures.covariance.numpy()
    for one in waypoints[:2]:
        lin, w = one.piece.linearization, one.piece.action
        G = G + slopes(knowledge.figures, lin, w)
        g = g + controller.enhanced.correction(lin.state, w, lin.state.n_s)[1][-6:].sqrt().numpy()
        way = way + one.piece.increment[-3:].numpy()
        band = bands.add(one.piece, one.state)
        axis, size = way / np.linalg.norm(way), np.linalg.norm(way)
        rest = np.concatenate([np.full(3, 0.03**2), np.ones(3)]) * ((error.across * size) ** 2 + STEADY**2)
        rest[3:] += (error.along**2 - error.across**2) * (size * axis) ** 2
        expected = np.diag(G @ P @ G.T) + g**2 + rest
        np.testing.assert_allclose(band.twist_std.numpy() ** 2, expected, rtol=1e-5)
        assert (np.diag(G @ P @ G.T) > 0.02 * expected).any()  # it counts
    assert band.off == pytest.approx(controller.focus.off_rotation(target.error(one.state)))
    assert 0 < band.off_std <= float(band.twist_std[3:].square().sum().sqrt())


def test_what_forces_may_be_grows_with_the_way_and_shrinks_with_evidence(held, path) -> None:
    controller, _, seen, target, waypoints = path
    spreads = []
    for evidence in (0.0, 10.0, 1e4):
        knowledge = HandKnowledge.of(held[2].hand)
        knowledge.forces.evidence[:] = evidence * torch.eye(knowledge.forces.evidence.shape[-1])
        bands = Bands(controller, knowledge, seen, target)
        found = [bands.add(one.piece, one.state) for one in waypoints]
        spreads.append(torch.stack([one.force_std[:3] for one in found]))
    for std in spreads:
        assert bool((std.diff(dim=0) >= 0).all())
        assert bool((std[-1] > std[0]).all())
    assert bool((spreads[0] > spreads[1]).all())
    assert bool((spreads[1][-1] > spreads[2][-1]).all())
    assert "+-" in str(found[-1])
    assert found[-1].force[:3].isfinite().all()
    assert found[-1].force[3:].isnan().all()  # pads that did not touch


def test_only_servos_of_a_stiff_hand_let_a_finger_go(held, path, monkeypatch) -> None:
    hand, piece = held[2].hand, path[4][0].piece
    rows, pads = hand.pad_rows(piece.linearization.contacts.finger)
    errs = servo_std(piece.linearization, piece.action, rows)
    assert 0 < float(errs.max()) < 0.1  # the iCub's springs are soft [N]
    opens = piece.force.clone()
    opens[pads] = 0.0
    assert not lets_go(hand, dataclasses.replace(piece, force=opens))  # the next look finds it
    monkeypatch.setattr("torch_ekm.control.rehearsal.servo_std", lambda *_: 20 * errs)
    for share, loose in ((2.1, False), (1.9, True)):
        force = piece.force.clone()
        force[pads] = share * 20 * errs
        assert bool(lets_go(hand, dataclasses.replace(piece, force=force))) is loose


def test_errors_along_the_way_and_across_it_are_learned_apart() -> None:
    error, way = ModelError(), torch.tensor([10 * DEG, 0.0, 0.0], dtype=F64)
    for _ in range(40):
        error.see(torch.tensor([-3 * DEG, 0.0, 0.0], dtype=F64), way)
    noise = STEADY / (10 * DEG)
    assert error.along == pytest.approx(math.sqrt(0.3**2 - noise**2), rel=1e-3)
    assert error.across < 1e-2
    for _ in range(40):
        error.see(torch.tensor([0.0, 3 * DEG, 4 * DEG], dtype=F64), way)
    assert error.across == pytest.approx(math.sqrt(0.5**2 / 2 - noise**2), rel=1e-3)  # each of two directions
    assert error.along < 1e-2


def test_shares_stay_within_bounds_and_short_motions_say_little() -> None:
    error, none = ModelError(), torch.zeros(3, dtype=F64)
    before = error.square.clone()
    error.see(none + 0.1, none)  # no way, no share of it
    assert torch.equal(error.square, before)
    error.see(none + 1.0, torch.tensor([0.05 * DEG, 0.0, 0.0], dtype=F64))
    assert float((error.square - before).abs().max()) < 1e-3
    for _ in range(60):
        error.see(none + 2.0, torch.tensor([10 * DEG, 0.0, 0.0], dtype=F64))
    assert error.square.tolist() == pytest.approx([1.0, 1.0], abs=1e-6)
    assert error.state_problems(error.state_dict()) == []
    error.begin()  # a new turn knows no more than nothing
    assert torch.equal(error.square, ModelError().square)
    error.square.fill_(1e-4)
    error.begin()
    assert error.square.tolist() == [1e-4, 1e-4]
