"""Familiar objects and new ones: a bank of models against labelled, single and fresh models."""

from __future__ import annotations

import copy
import dataclasses
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
import torch

from ...description import list_objects
from ...enhanced import GraspEncoding
from ...exceptions import ParameterError
from ...object_memory import GraspSignature, ModelBank
from ...residual import ResidualLearner, UpdateReport
from ...typing import Array, Tensor
from ..config import Setting, digest
from ..learners import make_learner
from ..records import Trial, TrialRecord
from ..reporting.plots import plot_bank, save_figure
from ..reporting.report import Cell, Column, Report, Table
from ..reporting.statistics import DataFrame, Series, bootstrap_mean, bootstrap_ratio, rate
from ..reporting.tables import ratio_and_p, which_seeds
from ..reporting.trials import select
from ..runner import Bench
from .generalize import OTHER_ANGLES, TABLE_I
from .protocol import Protocol

#: How the knowledge of several objects may be kept.
MEMORIES = ("bank", "labelled", "one model", "fresh")
_WORDS = {
    "bank": "the bank",
    "labelled": "labelled models",
    "one model": "one model",
    "fresh": "fresh models",
    "none": "the KM",
}
_LEGEND = {
    "bank": "several models; evidence decides which one a grasp belongs to",
    "labelled": "one model for each object, with the label of the object",
    "one model": "one for all objects",
    "fresh": "an empty one for each grasp",
    "none": "the kinematic model alone",
}
#: The residuals of one grasp are far from independent, and they speak for whichever model has seen most:
#: next to a signature they count for little.
_TEMPERATURE = 0.1
#: Motions of a turn before the learner of a wrong object could have been corrected.
_FIRST = 5
#: Turns of each object before its assignment is judged.
_LEARNING_TURNS = 3
#: Largest number of models that the bank may keep.
_MODELS = 8


@dataclass(frozen=True)
class MemoryTurn(TrialRecord):
    """A turn, and what every memory predicted of its motions."""

    model: int | None = None
    """Of the bank, that the turn went to; None: to none."""
    posterior: tuple[float, ...] = ()
    """Probabilities of the models at the end of the turn."""
    n_models: int = 0
    memory_errors_deg: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """One-step prediction error about the axis for each motion, of each memory and of "none", the KM."""


@dataclass(frozen=True)
class ObjectMemory(Protocol):
    """A random sequence of objects, one grasp and one turn each; the object is not given.

    Raises:
        ParameterError: no object, or fewer than one turn each.
    """

    setting: Setting = field(default_factory=Setting)
    objects: tuple[str, ...] = field(default_factory=lambda: list_objects()[:6])
    turns_each: int = 8
    readings: int = 8
    """Sensor readings at rest that make up a grasp's signature; 0: residuals alone distinguish objects."""

    record: ClassVar[type[TrialRecord]] = MemoryTurn
    quick_seeds: ClassVar[int] = 1

    def __post_init__(self) -> None:
        if not self.objects or self.turns_each < 1:
            raise ParameterError("objects", self.objects, "at least one object and one turn each")
        if self.readings < 0:
            raise ParameterError("readings", self.readings, "0 or more")

    def quick(self) -> Self:
        """The same with three objects, two turns each."""
        return dataclasses.replace(self, objects=("box", "can", "applier"), turns_each=2)

    def jobs(self, seeds: Sequence[int]) -> dict[str, tuple[int]]:
        """One for each seed: its whole sequence of turns."""
        stem = f"adapt_{digest(self.setting, self.objects, self)}"
        return {f"{stem}_{seed}": (seed,) for seed in seeds}

    def session(self, seed: int) -> list[MemoryTurn]:
        """All turns of one seed, those of objects that could not be grasped left out."""
        generator = np.random.default_rng(seed)
        sequence = generator.permutation(np.repeat(np.arange(len(self.objects)), self.turns_each))
        benches: dict[str, Bench] = {}
        memories: Memories | None = None
        encoding: GraspEncoding | None = None
        signature: GraspSignature | None = None
        records: list[MemoryTurn] = []
        for trial, index in enumerate(sequence.tolist()):
            item = self.objects[index]
            if item not in benches:
                benches[item] = Bench(self.setting.hardware_instance(seed), item, "E-KM")
                if memories is not None and encoding is not None:
                    benches[item].adopt(memories, encoding)
            bench = benches[item]
            if memories is None:  # the first grasp decides what is seen of a state
                if bench.grasp(seed, trial) is None or bench.encoding is None:
                    del benches[item]
                    continue
                encoding = bench.encoding
                signature = self.make_signature(bench) if self.readings else None
                memories = self._make_memories(encoding.n_features, bench.model.hand.n_a, signature)
                bench.adopt(memories, encoding)
            angle = float(generator.uniform(0.4, 1.0) * max(TABLE_I.get(item, OTHER_ANGLES)))
            start = bench.grasp(seed, trial)
            if start is None:
                continue
            # the object is at rest: measure its signature, and ask the bank which it is
            measured = None if signature is None else _measure(bench, signature, self.readings)
            slot = memories.grasp(item, measured)
            if records:
                records[-1] = dataclasses.replace(records[-1], model=slot)
            memories.axis.copy_(bench.hand.rotation_axis)
            turn = bench.turn(Trial(bench.name, "turn", "E-KM", seed, trial, angle), start)
            records.append(
                MemoryTurn(
                    **vars(turn),
                    posterior=tuple(memories.posterior.tolist()),
                    n_models=memories.n_models,
                    memory_errors_deg={name: tuple(errors) for name, errors in memories.errors.items()},
                )
            )
        if memories is not None and records:
            slot = memories.end()
            records[-1] = dataclasses.replace(records[-1], model=slot, n_models=memories.n_models)
        for bench in benches.values():
            bench.close()
        return records

    def report(self, seeds: Sequence[int], trials: DataFrame, folder: Path) -> Report:
        """Who is recognised, and what it is worth."""
        turns, figures = select(trials), []
        first = select(turns, seed=seeds[0])
        if len(first):
            caption = f"Which model of the bank took each turn of seed {seeds[0]}; pale: it was unsure."
            figures.append(save_figure(plot_bank(first), folder, "bank", caption))
        tables = [_memory_table(turns), comparison_table(turns), _assignment_table(turns)]
        lost, missed = rate(turns["lost"]), rate(turns["not_reached"])
        errors = [f"{_WORDS[name]} {bootstrap_mean(_means(turns, name)):.3f} deg" for name in _WORDS]
        summary = (
            f"Turns that went to the right model without labels: {recognition(turns)}. One-step "
            f"prediction error: {', '.join(errors)}. Objects lost: {lost}; turns that did not "
            f"reach the target: {missed}. {len(self.objects)} objects in random order, {self.turns_each} "
            f"turns each. {which_seeds(seeds)}"
        )
        title = "Object memory: familiar objects and new ones"
        return Report(title, summary, tables, figures, legend=_LEGEND)

    def make_signature(self, bench: Bench) -> GraspSignature:
        """What distinguishes grasps, without the object's label."""
        hand = bench.model.hand
        thumb, *fingers = bench.hand.plan.pads  # the pads that the hand closes
        blind: list[str] = []
        if self.setting.sensing and hand.hall_sensors:
            # what the sensed plant says of these joints was made with the shape of the labelled object
            sensed = {sensor.joint for sensor in hand.hall_sensors}
            movable = zip(hand.joint_names, hand.joint_upper > hand.joint_lower, strict=True)
            blind = [name for name, moves in movable if moves and name not in sensed]
        return GraspSignature(hand, thumb, fingers, from_encoders=blind)

    def _make_memories(self, n_s: int, n_a: int, signature: GraspSignature | None) -> Memories:
        setting, options = self.setting, {}
        if signature is not None:
            options = {"temperature": _TEMPERATURE, "signature_features": signature.n_features}
        sizes = n_s, n_a, setting.capacity
        factory = partial(make_learner, setting.learner, *sizes, **setting.learner_options)
        return Memories(factory, _MODELS, **options)


class Memories(ModelBank):
    """A bank that drives; the other memories see the same motions, each predicting before it learns.

    Labels go to "labelled" only.
    """

    def __init__(self, factory: Callable[[], ResidualLearner], models: int, **options: Any) -> None:
        super().__init__(factory, models, **options)
        self.empty: ResidualLearner = copy.deepcopy(self.common)
        self.one: ResidualLearner = copy.deepcopy(self.empty)
        self.fresh: ResidualLearner = copy.deepcopy(self.empty)
        self.labelled: dict[str, ResidualLearner] = {}
        self.label = ""
        self.axis = torch.zeros(3, dtype=torch.float64)
        self.errors: dict[str, list[float]] = {}

    def grasp(self, label: str, signature: Tensor | None = None) -> int | None:
        """A new grasp; returns where the bank put the last one."""
        self.label = label
        self.labelled.setdefault(label, copy.deepcopy(self.empty))
        self.fresh.reset()
        self.errors = {name: [] for name in (*MEMORIES, "none")}
        return self.begin(signature)

    def absorb(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        """One motion: note every memory's one-step error about the axis [deg], then train all."""
        others = {"labelled": self.labelled[self.label], "one model": self.one, "fresh": self.fresh}
        self.errors["none"].append(abs(float(self.axis @ y[3:6])))
        for name, learner in {"bank": self, **others}.items():
            self.errors[name].append(abs(float(self.axis @ (y - learner(x))[3:6])))
        for learner in others.values():
            learner.update(x, y, mask)
        return super().absorb(x, y, mask)


class Assignment(NamedTuple):
    """How well a bank distinguished objects, over one sequence."""

    right: int
    """Turns, after the first three of their object, that went to the model that is their object's."""
    judged: int
    n_models: int


def judge_assignment(turns: DataFrame) -> Assignment:
    """A model belongs to the object that most of its turns were of; each object owns one model at most."""
    placed = turns[["object", "model"]].dropna()
    owner: dict[str, int] = {}
    for (item, model), _ in Counter(placed.itertuples(index=False, name=None)).most_common():
        if item not in owner and model not in owner.values():
            owner[item] = model
    judged = placed[placed.groupby("object").cumcount() >= _LEARNING_TURNS]
    right = judged["model"] == judged["object"].map(owner)
    return Assignment(int(right.sum()), len(judged), placed["model"].nunique())


def _measure(bench: Bench, signature: GraspSignature, readings: int) -> Tensor:
    """Mean signature of several readings at rest."""
    seen = [bench.plant.observe() for _ in range(readings)]
    return torch.stack([signature(o.q, o.a, o.fingertip_force) for o in seen]).mean(0)


def _memory_table(turns: DataFrame) -> Table:
    columns: dict[Column, Callable[[str], Cell]] = {
        Column("all motions [deg]", ".3f"): lambda name: bootstrap_mean(_means(turns, name)),
        Column("first motions [deg]", ".3f"): lambda name: float(_errors(turns, name, _FIRST).mean()),
    }
    note = (
        "Mean over all motions, 95 % bootstrap interval over sequences; and over the first five "
        "motions of each turn. All memories see the same motions, those that the bank's E-KM chose; "
        "'none' is the KM."
    )
    items = {name: name for name in ("none", *MEMORIES)}
    return Table.of("memories", "One-step prediction error", "memory", items, columns, note)


def comparison_table(turns: DataFrame) -> Table:
    """Ratios of mean prediction errors, paired by sequence: the sequence is the independent unit."""
    rows: list[list[Cell]] = []
    pairs = [("bank", other) for other in ("labelled", "one model", "fresh", "none")]
    for ours, theirs in [*pairs, ("one model", "labelled")]:
        row: list[Cell] = [f"{ours} : {theirs}"]
        for first in (None, _FIRST):
            means = _means(turns, ours, first), _means(turns, theirs, first)
            row += ratio_and_p(*means, len(means[0]))
        rows.append(row)
    columns: list[Column | str] = ["memories"]
    for what in ("all motions", f"first {_FIRST} of a turn"):
        columns += [Column(f"{what} [%]", ".0f", percent=True), Column(f"p paired, {what}", ".1g")]
    note = (
        "Ratio of mean one-step prediction errors with 95 % bootstrap interval over sequences "
        f"({turns['seed'].nunique()}); p of the paired t-test. Right model: {recognition(turns)}."
    )
    return Table("memory_comparison", "The same motions, other memories", columns, rows, note)


def recognition(turns: DataFrame) -> str:
    """Share of judged turns that went to the right model, with its interval over sequences."""
    right, of, models = np.array(list(_assignments(turns).values()), dtype=float).T
    if not of.sum():
        return "none judged"
    share = f"{right.sum():.0f} of {of.sum():.0f} turns, {100 * bootstrap_ratio(right, of):.0f} %"
    return f"{share}; models {bootstrap_mean(models):.1f}, at most {models.max():.0f}"


def _assignment_table(turns: DataFrame) -> Table:
    rows = [[str(seed), *found] for seed, found in _assignments(turns).items()]
    note = "Turns after the first three of their object; a model belongs to the object of most of its turns."
    columns = ["seed", "right [turns]", "of [turns]", "models"]
    return Table("assignments", "Recognised objects", columns, rows, note)


def _assignments(turns: DataFrame) -> dict[int, Assignment]:
    """How well objects were distinguished with each seed."""
    return {seed: judge_assignment(mine) for seed, mine in turns.groupby("seed", sort=False)}


def _errors(turns: DataFrame, memory: str, first: int | None = None) -> Series:
    """Prediction errors of all motions, or of the first few of each turn [deg]; index: the seed."""
    errors = turns["memory_errors_deg"].map(lambda found: found[memory][:first])
    return errors.set_axis(turns["seed"]).explode().dropna().astype(float)


def _means(turns: DataFrame, memory: str, first: int | None = None) -> Array:
    """The same, mean over each seed's sequence."""
    return _errors(turns, memory, first).groupby(level=0, sort=False).mean().to_numpy()
