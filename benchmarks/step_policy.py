"""A policy that chooses how long the next step of a closed loop is, and its training on the KM alone."""

from __future__ import annotations

import json
import math
import queue
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
import numpy as np
import torch
from model_rig import ModelBench, drawn_plant

from torch_ekm._extras import require
from torch_ekm.control import LimitingFunction, Pace, PaceOptions, StepBound
from torch_ekm.experiments.config import Setting
from torch_ekm.experiments.records import Trial, TrialRecord
from torch_ekm.experiments.runner import Bench
from torch_ekm.kinematics import GraspState

if TYPE_CHECKING:
    from torch_ekm.control.situation import Situation
    from torch_ekm.model import Linearization
    from torch_ekm.typing import Array, Tensor

_DEG = math.pi / 180
LONGEST = 6.0  # [deg] that one step can ask for
SHORTEST = 0.05  # of it
TURNS = 6  # with one hand, its E-KM empty before the first
SIZES = (5.0, 30.0)  # [deg] of a turn for training
LOST, MISSED = 50.0, 20.0  # motions that such an end is worth
DECISIONS = 20_000  # of the training
_FEATURES = 14
POLICY_FILE = "policy.zip"


class Choice(NamedTuple):
    """A step that the policy chose."""

    error: float
    """Focused error before it [deg]."""
    asked: float
    """[deg]"""
    rho: float


class ChosenPace(Pace):
    """``|dx_d| = phi min(|e|, 6 deg)``, phi chosen by a policy from what the controller has at hand.

    Grips that are too weak still wait, as with every :class:`Pace`.

    Args:
        choose: features -> action in [-1, 1].
    """

    def __init__(self, choose: Callable[[Array], float]) -> None:
        limiting = LimitingFunction(gain=1.0, step=LONGEST * _DEG, contact_travel=None)
        super().__init__(PaceOptions(limiting, StepBound(least=math.inf)), adapts=False)
        self._choose = choose
        self.begin(0.0)

    def begin(self, last: float) -> None:
        """A new turn."""
        self._last: Choice | None = None
        self._error, self._motions, self._alarms = 0.0, 0, 0

    def ask(self, error: Tensor, travel: float = 0.0, measures: bool = True) -> tuple[Tensor, float]:
        self._error = float(torch.linalg.vector_norm(error)) / _DEG
        return super().ask(error, travel, measures)

    def cut(
        self, lin: Linearization, delta_a: Tensor, predicted: Tensor, seen: Situation, share: float
    ) -> float:
        whole = super().cut(lin, delta_a, predicted, seen, share)
        if self._error < 1e-6:  # a motion that only grips
            return whole
        features = self.features(lin, delta_a, predicted, seen)
        phi = share_of(self._choose(features))
        self._last = Choice(self._error, phi * min(self._error, LONGEST), math.nan)
        return min(phi, whole)

    def judge(self, disagreement: float, share: float = 1.0) -> None:
        self.count += 1
        self._motions += 1
        if self._last is not None:
            self._last = self._last._replace(rho=disagreement)

    def restart(self) -> None:
        self._alarms += 1

    def features(self, lin: Linearization, delta_a: Tensor, predicted: Tensor, seen: Situation) -> Array:
        """What the policy sees ``(14,)``, each about 1, cut at 5.

        Error and what a whole step asks for, both of 10 deg; the last step in 6 deg, what came of it over
        what was asked, and rho; least friction margin now and after a whole step [N]; rotation off the axis
        now and by a whole step, of 5 deg; grip over the wanted one, and of the finger that bears least;
        motions of this turn and of all, in tens; signs of a loss.
        """
        last = self._last
        came = 1.0 if last is None else (last.error - self._error) / max(last.asked, 0.2)
        rho = 1.0 if last is None or math.isnan(last.rho) else last.rho
        off = seen.focus.off_rotation(predicted) / (5 * _DEG)
        force, margins = seen.normal_force(lin), (lin.margins, lin.margins_after(delta_a))
        solved = lin.forces.solved and force is not None
        grip = float(force.max()) / seen.grip if solved and seen.grip else 1.0
        weakest = float(force.min() * (len(force) - 1)) / seen.grip if solved and seen.grip else 1.0
        found = [
            self._error / 10, min(self._error, LONGEST) / 10, 0.0 if last is None else last.asked / LONGEST,
            came, rho, *(float(margin.min()) if solved else 0.0 for margin in margins),
            seen.focus.off_rotation(seen.error) / (5 * _DEG), off, grip, weakest,
            self._motions / 10, int(self.count) / 10, float(self._alarms),
        ]  # fmt: skip
        return np.clip(np.nan_to_num(np.array(found, np.float32)), -5, 5)


def share_of(action: float) -> float:
    """phi, from 0.05 to 1, of an action in [-1, 1]."""
    return SHORTEST + (1 - SHORTEST) * (min(max(action, -1.0), 1.0) + 1) / 2


class AbandonedError(Exception):
    """A turn that nobody goes on with."""


class TargetSteps(gymnasium.Env):
    """Turn an object by choosing how long each step shall be; the hand is a :class:`ModelRig`.

    The closed loop of the E-KM runs in a thread of its own and waits in each decision for the action. An
    episode is one turn; TURNS of them are made with one drawn hand, object and grasp, its E-KM empty before
    the first.

    **Action** ``(1,)`` in [-1, 1]: see :func:`share_of`. **Observation** ``(14,)``: see
    :meth:`ChosenPace.features`. **Reward**: -0.1 for each motion, those that grip or go back included; at the
    end -5 for a lost object, -2 and a tenth of the error [deg] for another end than the target.
    """

    def __init__(self, objects: Sequence[str]) -> None:
        self.observation_space = gymnasium.spaces.Box(-5.0, 5.0, (_FEATURES,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self._objects, self._turns = objects, 0
        self._bench: ModelBench | None = None
        self._actions: queue.Queue[float | None] = queue.Queue()
        self._found: queue.Queue[Any] = queue.Queue()
        self._thread: threading.Thread | None = None
        self._moved = 0  # commands until the last decision

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict]:
        super().reset(seed=seed)
        self.close()
        if seed is not None:  # the same seed, the same hands
            self._bench = None
        while True:
            bench, start = self._grasped()
            size, number = float(self.np_random.uniform(*SIZES)), int(self.np_random.integers(2**31))
            self._thread = threading.Thread(target=self._turn, args=(bench, start, size, number), daemon=True)
            self._moved = bench.disturbed.count
            self._thread.start()
            found = self._found.get()
            if isinstance(found, np.ndarray):
                return found, {}
            self._ended(found)  # before any decision

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        assert self._bench is not None
        self._actions.put(float(action[0]))
        found = self._found.get()
        moved, self._moved = self._moved, self._bench.disturbed.count
        reward = moved - self._moved
        if isinstance(found, np.ndarray):
            return found, 0.1 * reward, False, False, {}
        done = self._ended(found)
        reward -= LOST * done.lost + done.not_reached * (MISSED + done.true_error_deg)
        info = {"motions": done.steps, "lost": done.lost, "reached": not (done.lost or done.not_reached)}
        return np.zeros(_FEATURES, np.float32), 0.1 * reward, True, False, info

    def close(self) -> None:
        """Abandon the turn."""
        if self._thread is not None:
            self._actions.put(None)
            self._thread.join()
            self._thread, self._actions, self._found = None, queue.Queue(), queue.Queue()

    def _grasped(self) -> tuple[Bench, GraspState]:
        """The grasp of this session once more, or one of a new hand."""
        if self._bench is not None and self._turns < TURNS:
            self._turns += 1
            return self._bench, self._bench.grasp_again()
        while True:
            draw, self._turns = self.np_random, 1
            plant, item = drawn_plant(draw), str(draw.choice(self._objects))
            self._bench = ModelBench(Setting(plant=plant), item, "E-KM")
            self._bench.pace = ChosenPace(self._choose)
            if (start := self._bench.grasp(int(draw.integers(2**31)), 0)) is not None:
                return self._bench, start

    def _ended(self, found: TrialRecord | Exception) -> TrialRecord:
        """The thread is over."""
        assert self._thread is not None
        self._thread.join()
        self._thread = None
        if isinstance(found, Exception):
            raise found
        return found

    def _choose(self, features: Array) -> float:
        self._found.put(features)
        action = self._actions.get()
        if action is None:
            raise AbandonedError
        return action

    def _turn(self, bench: Bench, start: GraspState, size: float, number: int) -> None:
        try:
            self._found.put(bench.turn(Trial(bench.name, "training", "E-KM", 0, number, size), start))
        except AbandonedError:
            pass
        except Exception as failed:
            self._found.put(failed)


def train(folder: Path, objects: Sequence[str], decisions: int, seed: int = 0) -> dict[str, Any]:
    """A policy, kept in ``folder``, and how each turn of its training ended."""
    kept, policy = folder / "training.json", folder / POLICY_FILE
    if kept.exists() and policy.exists():
        return json.loads(kept.read_text(encoding="utf-8"))
    baselines = require("stable_baselines3", "rl")
    torch.manual_seed(seed)
    env, began, ended = TargetSteps(objects), time.monotonic(), []

    def note(known: dict[str, Any], unused: Any) -> bool:
        """After each decision: go on."""
        ended.extend(
            {
                "decision": learner.num_timesteps,
                **{name: info[name] for name in ("motions", "lost", "reached")},
            }
            for info in known["infos"]
            if "motions" in info
        )
        return True

    learner = baselines.PPO(
        "MlpPolicy", env, n_steps=min(256, decisions), batch_size=64, learning_rate=1e-3, gamma=1.0,
        policy_kwargs={"net_arch": [32, 32], "log_std_init": -0.5}, device="cpu", seed=seed,
    )  # fmt: skip
    learner.learn(decisions, callback=note)
    env.close()
    folder.mkdir(parents=True, exist_ok=True)
    learner.save(policy)
    figures = {"decisions": learner.num_timesteps, "minutes": (time.monotonic() - began) / 60, "turns": ended}
    kept.write_text(json.dumps(figures) + "\n", encoding="utf-8")
    return figures


def policy_in(path: Path) -> Callable[[Array], float]:
    """The mean action of a trained policy."""
    learner = require("stable_baselines3", "rl").PPO.load(path, device="cpu")
    return lambda features: float(learner.predict(features, deterministic=True)[0][0])


def asked_of(policy: Callable[[Array], float], error: float, margin: float, after: float) -> float:
    """The step [deg] that a policy asks for in a grip as it is wanted, when the last step went as asked.

    Args:
        error: [deg].
        margin, after: least friction margin now and after a whole step [N].
    """
    most = min(error, LONGEST)
    features = [error / 10, most / 10, 0.6, 1.0, 0.7, margin, after, 0.1, 0.1, 1.0, 0.85, 0.5, 3.0, 0.0]
    return share_of(policy(np.array(features, np.float32))) * most
