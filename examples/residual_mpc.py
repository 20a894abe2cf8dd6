"""Model predictive control of a planar quadrotor that weighs more than its model says.

    python examples/residual_mpc.py            # prints the cost with and without the learner
    python examples/residual_mpc.py --quick    # a shorter flight

The model's mass is 1 kg; the real one carries 0.5 kg more, off its centre, and there is drag. At each step
the learner sees what the model left over of the accelerations, and the optimiser, built once, gets its basis
and coefficients as parameters: nothing is compiled again. The optimiser is CasADi's own IPOPT.
"""

from __future__ import annotations

import argparse
import time
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import torch

from torch_ekm import LearnHyperparameters, RobustWeight, SparseOnlineGP, Standardize
from torch_ekm.interop import to_casadi

GRAVITY, STEP, HORIZON = 9.81, 0.05, 12  # [m/s^2], [s], steps
MASS, INERTIA, ARM = 1.0, 0.02, 0.2  # of the model [kg], [kg m^2], [m]
LOAD, OFFSET, DRAG = 0.5, 0.03, 0.25  # of the real one: load [kg], its place [m], drag [1/s]
MOST = 12.0  # thrust of a rotor [N]
WEIGHTS = np.diag([20.0, 20.0, 1.0, 1.0, 1.0, 0.1])
EFFORT = 0.02


def accelerations(state: Any, thrust: Any, mass: float, inertia: float, twist: float, drag: float) -> Any:
    """Of x, z [m/s^2] and the angle [rad/s^2]; ``state = (x, z, angle, vx, vz, rate)``."""
    total, angle = thrust[0] + thrust[1], state[2]
    return ca.vertcat(
        -total * ca.sin(angle) / mass - drag * state[3],
        total * ca.cos(angle) / mass - GRAVITY - drag * state[4],
        (ARM * (thrust[1] - thrust[0]) - twist) / inertia,
    )


def model(state: Any, thrust: Any) -> Any:
    """What the controller believes."""
    return accelerations(state, thrust, MASS, INERTIA, 0.0, 0.0)


def reality(state: Any, thrust: Any) -> Any:
    """What happens."""
    twist = LOAD * GRAVITY * OFFSET * np.cos(float(state[2]))
    return accelerations(state, thrust, MASS + LOAD, INERTIA + LOAD * OFFSET**2, twist, DRAG)


def moved(state: Any, acceleration: Any) -> Any:
    """One step with constant acceleration."""
    speed = state[3:]
    return ca.vertcat(state[:3] + STEP * speed + 0.5 * STEP**2 * acceleration, speed + STEP * acceleration)


def reference(t: float) -> np.ndarray:
    """A figure of eight of 8 s: where to be at time t [s]."""
    w = 2 * np.pi / 8.0
    place = [np.sin(w * t), 0.5 * np.sin(2 * w * t), 0.0]
    speed = [w * np.cos(w * t), w * np.cos(2 * w * t), 0.0]
    return np.array(place + speed)


def features(state: Any, thrust: Any) -> Any:
    """What the learner sees: angle, speeds, thrusts."""
    return ca.vertcat(state[2], state[3], state[4], thrust)


class Controller:
    """Multiple shooting with ``f + g``; without a learner, with f alone."""

    def __init__(self, learner: SparseOnlineGP | None) -> None:
        self.g = None if learner is None else to_casadi(learner)
        n = 0 if self.g is None else self.g.n_parameters
        x, u = ca.SX.sym("x", 6, HORIZON + 1), ca.SX.sym("u", 2, HORIZON)
        start, path, p = ca.SX.sym("start", 6), ca.SX.sym("path", 6, HORIZON + 1), ca.SX.sym("p", n)
        cost, gaps = ca.SX(0), [x[:, 0] - start]
        for k in range(HORIZON):
            a = model(x[:, k], u[:, k])
            if self.g is not None:
                a = a + self.g.function(features(x[:, k], u[:, k]), p)[0]
            gaps.append(x[:, k + 1] - moved(x[:, k], a))
            away, effort = x[:, k + 1] - path[:, k + 1], u[:, k] - 0.5 * MASS * GRAVITY
            cost += ca.mtimes([away.T, WEIGHTS, away]) + EFFORT * ca.sumsqr(effort)
        unknown = ca.vertcat(ca.vec(x), ca.vec(u))
        given = ca.vertcat(start, ca.vec(path), p)
        problem = {"x": unknown, "p": given, "f": cost, "g": ca.vertcat(*gaps)}
        options = {"ipopt.print_level": 0, "print_time": 0, "ipopt.sb": "yes", "ipopt.max_iter": 50}
        self.solver = ca.nlpsol("mpc", "ipopt", problem, options)
        free = np.full(6 * (HORIZON + 1), np.inf)
        self.low = np.concatenate([-free, np.zeros(2 * HORIZON)])
        self.high = np.concatenate([free, np.full(2 * HORIZON, MOST)])
        hover = np.full(2 * HORIZON, 0.5 * MASS * GRAVITY)
        self.guess = np.concatenate([np.tile(reference(0.0), HORIZON + 1), hover])

    def __call__(self, state: np.ndarray, t: float) -> np.ndarray:
        """The next thrusts [N]."""
        path = np.stack([reference(t + k * STEP) for k in range(HORIZON + 1)])
        p = np.empty(0) if self.g is None else self.g.parameters()
        given = np.concatenate([state, path.ravel(), p])
        found = self.solver(x0=self.guess, p=given, lbx=self.low, ubx=self.high, lbg=0, ubg=0)
        self.guess = np.array(found["x"]).ravel()
        return self.guess[6 * (HORIZON + 1) :][:2]


class Flight(NamedTuple):
    """What a flight cost: the controller's own cost of what happened, and the rms distance from the path."""

    cost: float
    distance: float
    milliseconds: float
    learner: SparseOnlineGP | None


def fly(steps: int, learner: SparseOnlineGP | None) -> Flight:
    """One flight; the learner, if there is one, learns from each step before the next."""
    control, state, cost, distance = Controller(learner), reference(0.0), 0.0, 0.0
    begin = time.perf_counter()
    for k in range(steps):
        thrust = control(state, k * STEP)
        happened = reality(state, thrust)
        if learner is not None:
            seen = np.array(features(state, thrust)).ravel()
            left_over = np.array(happened - model(state, thrust)).ravel()
            learner.update(torch.from_numpy(seen), torch.from_numpy(left_over))
        state = np.array(moved(state, happened)).ravel()
        away = state - reference((k + 1) * STEP)
        cost += float(away @ WEIGHTS @ away) + EFFORT * float(np.sum((thrust - 0.5 * MASS * GRAVITY) ** 2))
        distance += float(np.sum(away[:2] ** 2))
    milliseconds = 1e3 * (time.perf_counter() - begin) / steps
    return Flight(cost, float(np.sqrt(distance / steps)), milliseconds, learner)


def make_learner() -> SparseOnlineGP:
    """Five inputs, three accelerations."""
    parts = [RobustWeight(3.0), Standardize(), LearnHyperparameters()]
    return SparseOnlineGP(5, 3, capacity=25, noise_variance=1e-3, parts=parts)


def main(arguments: list[str] | None = None) -> tuple[Flight, Flight]:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="30 steps instead of 160")
    steps = 30 if parser.parse_args(arguments).quick else 160
    torch.set_num_threads(1)
    alone, corrected = fly(steps, None), fly(steps, make_learner())
    for name, flight in (("model alone", alone), ("with the learner", corrected)):
        print(
            f"{name:17s} cost {flight.cost:8.2f}   rms distance {100 * flight.distance:6.2f} cm"
            f"   {flight.milliseconds:.0f} ms a step"
        )
    return alone, corrected


if __name__ == "__main__":
    main()
