"""A whole turn, foreseen before it begins, against rigid-body physics without mismatch."""

from __future__ import annotations

import math

import pytest
import torch

pytest.importorskip("sapien")
pytest.importorskip("coal")

from turning import turning

from torch_ekm.foresight import Rollout
from torch_ekm.model import KinematicModel
from torch_ekm.simulation import SimulatedHand

DEG = math.pi / 180


@pytest.mark.parametrize(("name", "seed"), [("box", 1), ("can", 0)])
def test_a_turn_of_twenty_degrees_is_foreseen_until_the_first_slip(name, seed):
    plant = SimulatedHand("icub_right", name)
    try:
        seen = plant.reset(seed)
        model = KinematicModel(plant.hand, plant.object)
        rollout, axis, start = Rollout(model), plant.rotation_axis, seen.truth.state
        lin = model.linearize(start, fingertip_force=seen.truth.fingertip_force)
        lower, upper = (torch.as_tensor(x) for x in (plant.hand.actuator_lower, plant.hand.actuator_upper))
        a, moved, truth, now = seen.a, [], [seen.truth], lin
        for _ in range(12):  # along the foreseen way, before anything moves
            w = torch.clamp(a + turning(now, axis, 20 / 12 * DEG), lower, upper) - a
            a, moved = a + w, [*moved, w]
            foreseen = rollout.predict(start, torch.stack(moved), start=lin)
            end = foreseen.at(-1)
            now = model.linearize(end.state, end.contacts, forces=end.forces, on_unstable="flag")
        moved = []
        for w in torch.diff(torch.stack([seen.a, *(seen.a + torch.cumsum(foreseen.actions, 0))]), dim=0):
            after = plant.command(w)
            moved.append(after.a - seen.a)
            seen = after
            truth.append(seen.truth)
        foreseen = rollout.predict(start, torch.stack(moved), start=lin)
        turned = [float(t.state.minus(start)[-3:] @ axis) for t in truth]
        assert turned[-1] > 19.5 * DEG
        errors = torch.stack([foreseen.at(k).state.minus(t.state)[-3:] @ axis for k, t in enumerate(truth)])
        assert errors.square().mean().sqrt() < 0.1 * DEG
        sticks = foreseen.first_slip
        assert sticks is not None
        end = foreseen.at(-1)
        found = model.contacts(end.state)
        assert found.finger == end.contacts.finger
        assert (found.point - end.contacts.point).norm(dim=-1).max() < 1e-4
        pads = plant.hand.pad_indices(foreseen.contacts.finger)
        felt = torch.stack([t.fingertip_force[pads] for t in truth])
        assert (foreseen.normal_force - felt)[:sticks].square().mean().sqrt() < 0.1  # at most .15
    finally:
        plant.close()
