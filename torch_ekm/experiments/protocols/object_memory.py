"""Familiar objects and new ones: a bank of models against labelled, single and fresh models."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch.distributions import Normal

from ...description import list_objects
from ...enhanced import GraspEncoding
from ...exceptions import ParameterError
from ...object_memory import GraspSignature, ModelBank
from ...residual import ResidualLearner, UpdateReport
from ...typing import Tensor
from ..config import Setting, digest
from ..learners import make_learner
from ..runner import Bench, Record
from .demo import TABLE_I
from .turning import OTHER_ANGLES, object_name

#: How the knowledge of several objects may be kept.
MEMORIES = ("bank", "labelled", "one model", "fresh")
#: The residuals of one grasp are far from independent, and they speak for whichever model has seen most:
#: beside a signature they count for little.
_TEMPERATURE = 0.1


@dataclass(frozen=True)
class AdaptConfig:
    """A random sequence of objects, one grasp and one turn each; nobody tells which object it is.

    Raises:
        ParameterError: no object, or fewer than one turn each.
    """

    setting: Setting = field(default_factory=lambda: Setting())
    objects: tuple[str, ...] = field(default_factory=list_objects)
    turns_each: int = 8
    models: int = 8
    """Largest number of models that the bank may keep."""
    readings: int = 8
    """Sensor readings at rest that make up a grasp's signature; 0: residuals alone tell objects apart."""
    bank: dict[str, float] = field(default_factory=dict)
    """Changes of :class:`ModelBank`'s figures."""

    def __post_init__(self) -> None:
        if not self.objects or self.turns_each < 1:
            raise ParameterError("objects", self.objects, "at least one object and one turn each")
        if self.readings < 0:
            raise ParameterError("readings", self.readings, "0 or more")


class Memories(ResidualLearner):
    """The bank drives; the other memories see the same motions, each predicting before it learns.

    To :class:`~torch_ekm.enhanced.EnhancedModel` it is the bank. Labels go to "labelled" only.
    """

    def __init__(self, bank: ModelBank) -> None:
        super().__init__(bank.in_features, bank.out_features)
        self.bank = bank
        self.empty = copy.deepcopy(bank.common)
        self.one: ResidualLearner = copy.deepcopy(self.empty)
        self.fresh: ResidualLearner = copy.deepcopy(self.empty)
        self.labelled: dict[str, ResidualLearner] = {}
        self.label = ""
        self.axis = torch.zeros(3, dtype=torch.float64)
        self.errors: dict[str, list[float]] = {}

    def begin(self, label: str, signature: Tensor | None = None) -> int | None:
        """A new grasp; returns where the bank put the last one."""
        kept = self.bank.begin(signature)
        self.label = label
        self.labelled.setdefault(label, copy.deepcopy(self.empty))
        self.fresh.reset()
        self.errors = {name: [] for name in (*MEMORIES, "none")}
        return kept

    def forward(self, x: Tensor) -> Tensor:
        """The bank's."""
        return self.bank(x)

    @property
    def working(self) -> ResidualLearner:
        """The hypothesis of the bank that leads."""
        return self.bank.working

    def predict(self, x: Tensor, *, observation: bool = False) -> Normal:
        """The bank's."""
        return self.bank.predict(x, observation=observation)

    def linearize(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The bank's."""
        return self.bank.linearize(x)

    def reset(self) -> None:
        """Forget everything."""
        for learner in (self.bank, self.one, self.fresh, *self.labelled.values()):
            learner.reset()

    def _absorb(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        """One motion: note every memory's one-step error about the axis [deg], then train all."""
        learners = {"labelled": self.labelled[self.label], "one model": self.one, "fresh": self.fresh}
        self.errors["none"].append(abs(float(self.axis @ y[3:6])))
        for name, learner in (("bank", self.bank), *learners.items()):
            self.errors[name].append(abs(float(self.axis @ (y - learner(x))[3:6])))
        for learner in learners.values():
            learner.update(x, y, mask)
        return self.bank.update(x, y, mask)


def adapt_session(config: AdaptConfig, seed: int) -> list[Record]:
    """All turns of one seed; each record says which model the bank chose, and everybody's errors."""
    generator = np.random.default_rng(seed)
    sequence = generator.permutation(np.repeat(np.arange(len(config.objects)), config.turns_each))
    benches: dict[str, Bench] = {}
    memories: Memories | None = None
    encoding: GraspEncoding | None = None
    signature: GraspSignature | None = None
    records: list[Record] = []
    for trial, index in enumerate(sequence.tolist()):
        item = config.objects[index]
        if item not in benches:
            benches[item] = Bench(config.setting.hardware_instance(seed), item, "E-KM", memories, encoding)
        bench = benches[item]
        if memories is None or encoding is None:  # the first grasp decides what is seen of a state
            if bench.grasp(seed, trial) is None or bench.encoding is None:
                del benches[item]
                continue
            encoding = bench.encoding
            signature = _make_signature(config, bench) if config.readings else None
            memories = Memories(_make_bank(config, encoding.n_features, bench.model.hand.n_a, signature))
            bench.adopt(memories, encoding)

        def begin(
            axis: Tensor,
            item: str = item,
            bench: Bench = bench,
            memories: Memories = memories,
            signature: GraspSignature | None = signature,
        ) -> None:
            """The object is grasped and at rest: feel it, and ask the bank what it is."""
            felt = None if signature is None else _feel(bench, signature, config.readings)
            slot = memories.begin(item, felt)
            if records:
                records[-1]["model"] = slot
            memories.axis.copy_(axis)

        bench.on_grasp = begin
        angles = TABLE_I.get(item, OTHER_ANGLES)
        angle = float(generator.uniform(0.4, 1.0) * max(angles))
        record = bench.trial(seed, trial, angle)
        if not record["grasped"]:
            continue
        record |= {"object": object_name(item), "kind": "turn", "model": None}
        record["posterior"] = memories.bank.posterior.tolist()
        record["n_models"] = memories.bank.n_models
        record["memory_errors_deg"] = {name: list(errors) for name, errors in memories.errors.items()}
        records.append(record)
    if memories is not None and records:
        records[-1]["model"] = memories.bank.end()
        records[-1]["n_models"] = memories.bank.n_models
    for bench in benches.values():
        bench.close()
    return records


def adapt_jobs(config: AdaptConfig, seeds: tuple[int, ...]) -> dict[str, tuple[Any, ...]]:
    """One job for each seed."""
    stem = f"adapt_{digest(config.setting, config.objects, config)}"
    return {f"{stem}_{seed}": (config, seed) for seed in seeds}


@dataclass(frozen=True)
class Assignment:
    """How well a bank told objects apart, over one sequence."""

    right: int
    """Turns, after the first three of their object, that went to the model that is their object's."""
    judged: int
    n_models: int


def judge_assignment(records: list[Record], learning_turns: int = 3) -> Assignment:
    """A model belongs to the object that most of its turns were of; each object owns one model at most."""
    placed = [(r["object"], r["model"]) for r in records if r.get("model") is not None]
    counts: dict[tuple[str, int], int] = {}
    for pair in placed:
        counts[pair] = counts.get(pair, 0) + 1
    owner: dict[int, str] = {}
    home: dict[str, int] = {}
    for (item, model), _ in sorted(counts.items(), key=lambda entry: -entry[1]):
        if model not in owner and item not in home:  # most turns first
            owner[model], home[item] = item, model
    seen: dict[str, int] = {}
    right = judged = 0
    for item, model in placed:
        seen[item] = seen.get(item, 0) + 1
        if seen[item] > learning_turns:
            judged += 1
            right += home.get(item) == model
    return Assignment(right, judged, len({model for _, model in placed}))


def _make_signature(config: AdaptConfig, bench: Bench) -> GraspSignature:
    hand = bench.model.hand
    thumb, *fingers = bench.hand.plan.pads  # the pads that the hand closes
    blind: list[str] = []
    if config.setting.sensing and hand.hall_sensors:
        # what the sensed plant says of these joints was made with the shape of the labelled object
        sensed = {sensor.joint for sensor in hand.hall_sensors}
        movable = hand.joint_upper > hand.joint_lower
        blind = [name for name, moves in zip(hand.joint_names, movable, strict=True) if moves]
        blind = [name for name in blind if name not in sensed]
    return GraspSignature(hand, thumb, fingers, from_encoders=blind)


def _feel(bench: Bench, signature: GraspSignature, readings: int) -> Tensor:
    """Mean signature of several readings at rest."""
    seen = [bench.plant.observe() for _ in range(readings)]
    return torch.stack([signature(o.q, o.a, o.fingertip_force) for o in seen]).mean(0)


def _make_bank(config: AdaptConfig, n_s: int, n_a: int, signature: GraspSignature | None) -> ModelBank:
    setting = config.setting

    def factory() -> ResidualLearner:
        return make_learner(setting.learner, n_s, n_a, setting.capacity, **setting.learner_options)

    options: dict[str, Any] = {}
    if signature is not None:
        options = {"temperature": _TEMPERATURE, "signature_features": signature.n_features}
    return ModelBank(factory, config.models, **{**options, **config.bank})
