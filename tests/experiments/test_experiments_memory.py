"""Object memory: what a grasp feels like without its label, and how memories are compared."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from experiments_records import frame, memory_turn

from torch_ekm.exceptions import ParameterError
from torch_ekm.experiments.config import Setting
from torch_ekm.experiments.learners import make_learner
from torch_ekm.experiments.protocols.object_memory import (
    Memories,
    MemoryTurn,
    ObjectMemory,
    comparison_table,
    recognition,
)
from torch_ekm.experiments.reporting.statistics import LEAST_SEEDS
from torch_ekm.experiments.runner import Bench

NAMES = ("none", "bank", "labelled", "one model", "fresh")


def made_up_session(seed: int, share: dict[str, float], wrong: int = 0) -> list[MemoryTurn]:
    """Two objects, eight turns each; errors are the share of a common draw."""
    draw = np.random.default_rng(seed)
    records = []
    for k in range(16):
        base = draw.uniform(0.5, 1.5, 8)
        errors = {name: (share.get(name, 1.0) * base).tolist() for name in NAMES}
        model = k % 2 if k < 16 - wrong else 5
        about = {"object": "ab"[k % 2], "seed": seed, "model": model}
        records.append(memory_turn(**about, memory_errors_deg=errors))
    return records


def test_comparison_is_paired() -> None:
    sessions = (made_up_session(seed, {"bank": 0.5, "labelled": 0.8}) for seed in range(LEAST_SEEDS))
    turns = frame(turn for session in sessions for turn in session)
    table = comparison_table(turns)
    rows = {row[0]: row for row in table.rows}
    ratio = rows["bank : labelled"][1]
    assert ratio.mean == pytest.approx(0.625)
    assert ratio.high - ratio.low < 1e-9  # the draws are common
    assert rows["bank : fresh"][1].mean == pytest.approx(0.5)
    assert rows["one model : labelled"][1].mean == pytest.approx(1.25)
    assert rows["bank : fresh"][2] < 1e-4
    assert all(len(row) == len(table.header) for row in table.rows)
    few = comparison_table(turns[turns["seed"] > 0])
    assert all(row[2] is None for row in few.rows)  # no p-value


def test_share_of_recognised_turns() -> None:
    turns = frame([*made_up_session(0, {}), *made_up_session(1, {}, wrong=2)])
    # five judged turns of each object in each sequence, two of them wrong
    assert recognition(turns).startswith("18 of 20 turns, 90")
    assert "at most 3" in recognition(turns)


def test_bench_feels_the_width_of_what_it_holds() -> None:
    """Through images and Hall counts, without the label; joints that no sensor reads come from encoders."""
    setting = Setting(sensing=True)
    seen = {}
    for item in ("applier", "can"):
        bench = Bench(setting, item, "KM")
        assert bench.grasp(0, 0) is not None
        signature = ObjectMemory(setting).make_signature(bench)
        o = bench.plant.observe()
        seen[item] = signature(o.q, o.a, o.fingertip_force)
        # the estimate of a joint without a sensor was made with the label's shape: it has no say
        blind = bench.model.hand.joint_names.index("thumb_0")
        other = o.q.clone()
        other[blind] += 0.2
        torch.testing.assert_close(signature(other, o.a, o.fingertip_force), seen[item])
        bench.close()
    apart = 0.3e-3 * float(seen["can"][0] - seen["applier"][0])  # in units of 0.3 mm
    assert 8e-3 < apart < 20e-3  # 14 mm, seen through wrong pulleys


def test_memory_passes_its_signature_on_and_answers_for_its_leader() -> None:
    protocol = ObjectMemory(objects=("box",), turns_each=1)
    assert protocol.session(0)[0].model == 0
    silent = dataclasses.replace(protocol, readings=0).session(0)
    assert silent[0].steps > 0
    with pytest.raises(ParameterError, match="readings"):
        ObjectMemory(readings=-1)


def test_memories_speak_with_the_bank() -> None:
    from torch_ekm.object_memory import ModelBank

    bank, memories = (
        kind(lambda: make_learner("action-linear", 3, 2, 10), 2) for kind in (ModelBank, Memories)
    )
    bank.begin()
    memories.grasp("box")
    x, y = torch.ones(5, dtype=torch.float64), torch.ones(6, dtype=torch.float64)
    for one in (bank, memories):
        one.update(x, y)
    assert torch.equal(memories(x), bank(x))
    assert set(memories.errors) == set(NAMES)
