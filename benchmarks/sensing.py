"""The paper's sensing in simulation: Hall fit, camera calibration, position controller, blind turns.

    python benchmarks/sensing.py --objects box,can --seeds 1000:1010 --out FOLDER

Every hand (seed) has Hall channels, a lens and motors of its own. The lens is calibrated by OpenCV from
pictures of a ChArUco board. An E-KM makes three turns with each object, then those that are counted: with
everything sensed, and with one reading at a time replaced by the truth, or by a worse camera. Blind: the
camera is off from the first picture on, for forty motions to and fro. Finished sessions stay in ``--out``: an
interrupted run goes on where it stopped.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import torch
from any_hand import ANGLES
from command_line import study_parser
from simulated_hand.lens import LENSES, DistortingCamera, calibrated, lens_of
from simulated_hand.sensing_report import BLIND, BLIND_BY, READINGS, Outcome, Turn
from simulated_hand.tracking_accuracy import measure_tracking

from torch_ekm._extras import require
from torch_ekm._terminal import progress
from torch_ekm.control import PoseTarget
from torch_ekm.description import load_hand
from torch_ekm.experiments.config import Setting, digest, object_name
from torch_ekm.experiments.jobs import run_jobs
from torch_ekm.experiments.records import TrialRecord, true_state
from torch_ekm.experiments.runner import Bench
from torch_ekm.foresight import BlindPose
from torch_ekm.plant import Observation
from torch_ekm.sensing import ContactAligned, HallCalibration, MarkerTracker
from torch_ekm.simulation import HallSensors, SensedPlant

_DEG = math.pi / 180
WARM_UP = (15.0, 15.0, 15.0)  # [deg]
MOTIONS = 40  # without the camera
FRAMES = 100  # in which boards are found
_LEAST_ASKED = 0.01 * _DEG  # of a motor that is to move
_FIRST_WARM_UP, _BLIND = 1000, 4000  # numbers of the grasps


def bench_of(setting: Setting, item: str, controller: str, readings: str, seed: int) -> Bench:
    """A bench whose plant is read as ``readings`` says; lens and Hall channels are those of the seed."""
    lens, hall = READINGS[readings]
    plant = setting.hardware_instance(seed).parameters
    if not hall:
        plant = plant.replace(joint_noise=0.0)
    if lens is None:
        plant = plant.replace(position_noise=0.0, rotation_noise=0.0)
    bench = Bench(setting.replace(plant=plant), item, controller)
    if lens is not None:
        hand, held = bench.hand.hand, bench.hand.object
        sensed = SensedPlant(bench.plant, hand, held, HallSensors(hand, seed) if hall else None)
        sensed.camera = DistortingCamera(lens_of(seed))
        sensed.tracker = MarkerTracker(LENSES[lens](seed), *sensed.boards)
        bench.plant = ContactAligned(sensed, hand, held) if hall else sensed
    for k, angle in enumerate(WARM_UP if bench.learns else ()):
        bench.trial(seed, _FIRST_WARM_UP + k, angle, "warm-up")
    return bench


def hall_session(setting: Setting, seed: int) -> list[dict[str, Any]]:
    """Errors of the calibrated channels of one hand over a second sweep."""
    hand = load_hand(setting.hand)
    sensors, draw = HallSensors(hand, seed), torch.Generator().manual_seed(0)
    calibration = HallCalibration.fit(*sensors.sweep(181, draw), sensors.joints)
    counts, angles = sensors.sweep(1000, draw)
    found, rows = calibration.estimate(counts), []
    for k, channel in enumerate(calibration.channels):
        valid = found.valid[:, k]
        wrong = (found.q - angles)[:, k] / _DEG
        rows.append(
            {
                "joint": channel.joint,
                "rms": float(wrong[valid].square().mean().sqrt()),
                "largest": float(wrong[valid].abs().max()),
                "blind": float((~valid).double().mean()),
                "stated": float(found.std[valid, k].square().mean().sqrt()) / _DEG,
                "misfit": channel.misfit / _DEG,
            }
        )
    return rows


def lens_session(seed: int, frames: int) -> dict[str, Any]:
    """What calibration leaves of one lens, and what that does to the depth of a board."""
    true, camera, found = lens_of(seed), DistortingCamera(lens_of(seed)), {}
    for name, known_as in LENSES.items():
        known = known_as(seed)
        seen = measure_tracking(frames, seed, camera, known)
        found[name] = {
            "focal": 100 * abs(known.fx / true.fx - 1),
            "axis": math.hypot(known.cx - true.cx, known.cy - true.cy),
            "depth": seen.depth_mm,
            "position": seen.object_position_mm,
            "rotation": seen.object_rotation_deg,
        }
    return {"known": found, "reprojection": calibrated(seed).reprojection}


def turn_session(
    setting: Setting, item: str, controller: str, readings: str, seed: int
) -> list[dict[str, Any]]:
    """Warm-up (E-KM only), then the turns."""
    bench, turns = bench_of(setting, item, controller, readings, seed), []
    for k, angle in enumerate(ANGLES):
        done = bench.trial(seed, k, angle)
        if isinstance(done, TrialRecord):
            turns.append(asdict(_turn(bench, done, readings)))
    bench.close()
    return turns


def _turn(bench: Bench, done: TrialRecord, readings: str) -> Turn:
    assert bench.last is not None
    steps, axis = bench.last.steps, bench.hand.rotation_axis
    asked = [(step.decision.delta_a, step.after.a - step.before.a) for step in steps]
    missed = [(done - wish)[wish.abs() > _LEAST_ASKED] / _DEG for wish, done in asked]
    seen = [*(step.before for step in steps), *(step.after for step in steps[-1:])]
    start = seen[0] if seen else bench.last.stop.final

    def turned(at: Observation) -> float:
        measured, real = (f(at).minus(f(start)) for f in (lambda o: o.state, true_state))
        return float(axis @ (measured - real)[-3:]) / _DEG

    held = [] if done.lost else seen
    return Turn(
        *(readings, done.controller, done.object, done.seed, done.angle_deg),
        lost=done.lost,
        reached=not (done.lost or done.not_reached),
        motions=done.steps,
        error=done.true_error_deg,
        one_step=list(done.true_prediction_ekm_deg if bench.learns else done.true_prediction_km_deg),
        one_step_km=list(done.true_prediction_km_deg),
        motors=torch.cat(missed).tolist() if missed else [],
        joints=[((at.q - true_state(at).q) / _DEG).tolist() for at in held],
        rotation=[turned(at) for at in held[1:]],
        position=[1e3 * float((at.position - true_state(at).position).norm()) for at in held],
    )


def blind_session(setting: Setting, item: str, seed: int, most: int) -> list[dict[str, Any]]:
    """One grasp turned there and back, with the camera off and on, by an E-KM that does not train then."""
    bench, series = bench_of(setting, item, "E-KM", "all sensed", seed), []
    for name, touch in BLIND_BY.items():
        start = bench.grasp(seed, _BLIND)
        if start is None:
            continue
        axis, plant = bench.hand.rotation_axis, bench.plant
        if touch is not None:
            plant = BlindPose(
                plant, bench.model if bench.enhanced is None else bench.enhanced, axis, touch=touch
            )
        first, motions, turns = bench.hand.observe(), [], []
        while len(motions) < most and len(turns) < most and not any(turn["lost"] for turn in turns):
            angle = 0.0 if len(turns) % 2 else BLIND
            target = PoseTarget.turned(start, axis, angle * _DEG)
            done = bench.closed_loop(plant, learn=False).run(target)
            for step in done.steps:
                at, stated = step.after, step.after.info.get("estimate", {})
                off = float(axis @ at.state.minus(true_state(at))[-3:]) / _DEG
                sd = stated.get("axis_std")
                motions.append(
                    {"s": at.time - first.time, "error": off, "sd": None if sd is None else sd / _DEG}
                )
            end = true_state(done.stop.final)
            lost = done.lost or float(done.focus.off_rotation(end.minus(true_state(first)))) > 30 * _DEG
            turns.append(
                {
                    "error": float(done.focus.error(target, end)) / _DEG,
                    "motions": len(done.steps),
                    "lost": lost,
                    "reason": done.reason.value,
                }
            )
        series.append(
            {"by": name, "object": bench.name, "seed": seed, "motions": motions[:most], "turns": turns}
        )
    bench.close()
    return series


def session(part: str, *arguments: Any) -> Any:
    """What one job measures."""
    parts = {"hall": hall_session, "lens": lens_session, "turns": turn_session, "blind": blind_session}
    return parts[part](*arguments)


def jobs(setting: Setting, objects: Sequence[str], seeds: Sequence[int], quick: bool) -> dict[str, Any]:
    """Hall channels and lens of each hand; then turns and blind turns with each object."""
    frames, most = (10, 4) if quick else (FRAMES, MOTIONS)
    ways = [("E-KM", name) for name in READINGS] + [("KM", "all sensed")]
    todo: dict[str, Any] = {}
    for seed in seeds:
        lens = tuple(vars(lens_of(seed)).items())
        todo[f"hall_{digest(setting, ())}_{seed}"] = "hall", setting, seed
        todo[f"lens_{digest(setting, (), lens, frames)}_{seed}"] = "lens", seed, frames
        for item in objects:
            mark, name = digest(setting, (item,), lens, WARM_UP, ANGLES), object_name(item)
            for controller, readings in ways[:1] if quick else ways:
                key = f"turns_{mark}_{name}_{controller}_{readings.replace(' ', '_')}_{seed}"
                todo[key] = "turns", setting, item, controller, readings, seed
            todo[f"blind_{digest(setting, (item,), lens, WARM_UP, BLIND, most)}_{name}_{seed}"] = (
                *("blind", setting, item, seed, most),
            )
    return todo


def main(arguments: Sequence[str] | None = None) -> None:
    parser = study_parser(
        __doc__, "sensing", objects="box,can", seeds="1000:1010", engine="mujoco",
        quick="one object, one seed, everything sensed, four blind motions",
    )  # fmt: skip
    parser.set_defaults(jobs=1)
    given = parser.parse_args(arguments)
    require("cv2").setNumThreads(1)
    objects, seeds = given.objects.split(","), given.seeds
    if given.quick:
        objects, seeds = objects[:1], seeds[:1]
    todo = jobs(Setting(engine=given.engine), objects, seeds, given.quick)
    with progress("running", len(todo)) as advance:
        results = run_jobs(session, todo, given.out, given.jobs, advance)
    found: dict[str, list[Any]] = {part: [] for part in ("hall", "lens", "turns", "blind")}
    for name, result in results.items():
        part = todo[name][0]
        found[part] += [result] if part == "lens" else result
    joints = load_hand(Setting().hand).joint_names
    turns = [Turn(**turn) for turn in found["turns"]]
    outcome = Outcome(found["hall"], found["lens"], turns, found["blind"], joints)
    print(outcome.report(given.out).markdown())
    print(outcome.verdict)


if __name__ == "__main__":
    main()
