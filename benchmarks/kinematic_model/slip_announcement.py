"""Are slips announced one motion ahead? The kinematic model's friction margins against the simulator.

    python benchmarks/kinematic_model/slip_announcement.py --seeds 1000:1010

A look-and-move controller turns objects by more than they bear. Before each motion da the model says the
friction margin that each contact will have after it, ``margins_after(da)``. A slip is announced where one of
them is below -0.1 N. A motion slips where a contact that bears force slides by more than 0.05 mm (relative
motion of the two materials at the contact point, tangential, summed over the simulator's frames; rolling is
none). Below 0.01 mm nothing slid; in between a contact creeps at its friction limit. True margins come from
the simulator's joint torques, normal forces and friction.

Plants: "sensed" is the mechanism as described with the sensors of "nominal"; "nominal" is a used hand whose
servos stop short of their commands by up to 1.3 deg, so its second rows take da as the encoders then read
it. Forces: "smallest" ones, or "estimated" from fingertips and from those expected after the step before.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from link_weights import LinkWeights

from torch_ekm.contact import constraint_matrix
from torch_ekm.control import (
    FocusedPose,
    LimitingFunction,
    LookAndMoveController,
    PoseTarget,
)
from torch_ekm.description import ObjectDescription, Shape, load_hand, load_object
from torch_ekm.exceptions import EKMError, GraspError
from torch_ekm.kinematics import GraspState
from torch_ekm.model import KinematicModel, ModelOptions
from torch_ekm.plant import Observation, PlantStatus
from torch_ekm.simulation import PlantParameters, SimulatedHand, preset

SLIP, STILL = 5e-5, 1e-5  # [m]
RELEASE = 0.1  # [N] lack of margin that is announced; chosen on seeds 0 to 6
TABLE_I = ("box", "can", "toothpaste", "applier", "weighted_box", "bottle")


def own_objects() -> dict[str, ObjectDescription]:
    """A wide, a thin and a heavy one that the package does not have."""
    box = load_object("box")

    def make(name: str, kind: str, size: tuple[float, ...], width: float, mass: float, friction: float):
        inertia = mass * 0.0017 * np.eye(3) * (1.0 if width > 0.03 else 0.5)
        shape = Shape(kind, size, np.eye(4))  # type: ignore[arg-type]
        return dataclasses.replace(
            box, name=name, shapes=(shape,), mass=mass, inertia=inertia, grasp_width=width, friction=friction,
            com=np.zeros(3),
        )  # fmt: skip

    return {
        "wide": make("wide", "box", (0.09, 0.05, 0.05), 0.05, 0.15, 0.9),
        "thin": make("thin", "box", (0.10, 0.018, 0.03), 0.018, 0.05, 0.8),
        "heavy": make("heavy", "box", (0.09, 0.035, 0.045), 0.035, 0.3, 0.9),
    }


@dataclass(frozen=True)
class Motion:
    """One motion: what was seen before, what was commanded, what truly happened; contacts by pad."""

    seen: Observation
    delta_a: torch.Tensor
    """Commanded [rad]."""
    moved: torch.Tensor
    """By the encoders [rad]."""
    margin_before: dict[str, float]
    """True friction margin before [N]."""
    margin_after: dict[str, float]
    slip: dict[str, float]
    """[m]"""

    @property
    def slid(self) -> float:
        """Farthest slide of a contact that bore force [m]."""
        return max((way for pad, way in self.slip.items() if pad in self.margin_before), default=0.0)

    @property
    def slips(self) -> bool:
        return self.slid > SLIP


class Witness:
    """The simulator's truth about contacts: sliding and friction margins."""

    def __init__(self, plant: SimulatedHand) -> None:
        self.plant = plant
        p = plant.parameters
        hand, obj = plant.true_descriptions()
        self.model = KinematicModel(hand, obj, ModelOptions(on_unstable="flag", max_overlap=0.02))
        self.link_weights = LinkWeights(hand, self.model.kinematics) if p.link_weight else None
        self._rig: Any = plant._rig
        self.frames: list[GraspState] = []
        self._scene = self._rig.scene
        self._step, self._count = self._scene.step, 0
        self._scene.step = self._stepped

    def _stepped(self, *arguments) -> None:
        """A physics step; every tenth state is kept."""
        self._step(*arguments)
        self._count += 1
        if self._count % 10 == 0:
            seen = (self._scene.q, *self._scene.object_pose)
            self.frames.append(GraspState(*(torch.from_numpy(np.asarray(x)) for x in seen)))

    def _free(self, q: np.ndarray) -> np.ndarray:
        """Joints away from their stops."""
        hand, near = self.model.hand, np.radians(0.2)
        return np.flatnonzero((q > hand.joint_lower + near) & (q < hand.joint_upper - near))

    def slips(self) -> dict[str, float]:
        """How far each contact point slid since the last call [m]."""
        total: dict[str, torch.Tensor] = {}
        before = None
        for state in self.frames:
            poses = self.model.kinematics(state.q)
            contacts = self.model.detector(poses, state.position, state.rotation)
            now = (state, poses, contacts)
            if before is not None:
                for name, way in sliding(before, now):
                    total[name] = total.get(name, 0.0) + way
            before = now
        self.frames = self.frames[-1:]
        return {name: float(torch.linalg.vector_norm(way)) for name, way in total.items()}

    def margins(self) -> dict[str, float]:
        """``mu_s f_n - |f_t|`` [N]: forces that explain joint torques, object balance and normal forces."""
        rig = self._rig
        q, (position, rotation) = rig.scene.q, rig.scene.object_pose
        state = GraspState(*(torch.from_numpy(np.asarray(x)) for x in (q, position, rotation)))
        torque = rig.transmission.drive_stiffness * (rig.transmission.drive_targets(q, rig.servo.output) - q)
        poses = self.model.kinematics(state.q)
        contacts = self.model.detector(poses, state.position, state.rotation)
        if contacts.n_c == 0:
            return {}
        kin = self.model.contact_kinematics(state, contacts, poses=poses)
        A = constraint_matrix(kin).numpy()
        n_q = self.model.hand.n_q
        torque = torch.from_numpy(torque)
        if self.link_weights is not None:
            torque = torque - self.link_weights(poses)[0]
        weight = self.model.potential(state)[0][n_q:].numpy()
        pads = [pad.name for pad in self.model.hand.pads]
        normal = np.array([rig.normal[pads.index(name)] for name in contacts.finger])
        scale = np.array([1, 1, 1, 30, 30, 30]) / 0.01
        free = self._free(q)  # a stop's torque is not known
        rows = [
            A[:, :n_q].T[free] / 2e-3,
            -scale[:, None] * A[:, n_q:].T,
            np.eye(A.shape[0])[kin.normal_rows] / 0.02,
        ]
        rhs = [torque.numpy()[free] / 2e-3, scale * weight, normal / 0.02]
        mu = np.linalg.lstsq(np.concatenate(rows), np.concatenate(rhs))[0].reshape(contacts.n_c, -1)
        friction = contacts.friction.numpy()
        margin = friction * mu[:, 0] - np.linalg.norm(mu[:, 1:3], axis=-1)
        self.misfit = float(np.abs(np.concatenate(rows) @ mu.ravel() - np.concatenate(rhs)).max())
        return {name: float(m) for name, m, f in zip(contacts.finger, margin, normal, strict=True) if f > 0}


def plant_parameters(name: str, seed: int) -> PlantParameters:
    """A preset; "sensed" is the mechanism as described with the sensors of "nominal"."""
    nominal = preset("nominal")
    if name != "sensed":
        return preset(name).replace(hardware_seed=seed)
    names = [field.name for field in dataclasses.fields(nominal)]
    sensors = [n for n in names if n.endswith("_noise") or n.startswith("force_")]
    return preset("none").replace(hardware_seed=seed, **{n: getattr(nominal, n) for n in sensors})


def sliding(before, now) -> Iterator[tuple[str, torch.Tensor]]:
    """Tangential motion of finger relative to object at the contact point of each pad, in hand axes [m]."""
    (s1, poses1, c1), (s2, poses2, c2) = before, now
    for name in c1.finger:
        if name not in c2.finger:
            continue
        i, j = c1.finger.index(name), c2.finger.index(name)
        x, n = 0.5 * (c1.point[i] + c2.point[j]), c1.normal[i] + c2.normal[j]
        n = n / torch.linalg.vector_norm(n)
        T1, T2 = poses1.of(c1.link[i]), poses2.of(c1.link[i])
        finger = T2[:3, :3] @ T1[:3, :3].mT @ (x - T1[:3, 3]) + T2[:3, 3] - x
        obj = s2.rotation @ s1.rotation.mT @ (x - s1.position) + s2.position - x
        way = finger - obj
        yield name, way - n * (n @ way)


def record(obj: ObjectDescription, seed: int, name: str, motions: int = 25) -> list[Motion]:
    """The motions of one grasp, turned by up to 40 deg either way in steps of 1.5 to 4 deg, until four
    motions slipped, the object is lost or given up, or three motions turned it by less than 0.1 deg."""
    plant = SimulatedHand("icub_right", obj, parameters=plant_parameters(name, seed))
    try:
        seen = plant.reset(seed)
    except EKMError:
        plant.close()
        return []
    witness = Witness(plant)
    model = KinematicModel(plant.hand, plant.object)
    draw = np.random.default_rng(seed)
    degrees, step = 40.0 * draw.choice([-1.0, 1.0]), np.radians(draw.uniform(1.5, 4.0))
    focus = FocusedPose.rotation_about(plant.rotation_axis)
    controller = LookAndMoveController(model, focus, limiting=LimitingFunction(step=step))
    target = PoseTarget.turned(seen.state, plant.rotation_axis, np.radians(degrees))
    done: list[Motion] = []
    slipped, still, before = 0, 0, witness.margins()
    while len(done) < motions and seen.status is PlantStatus.HELD and slipped < 4 and still < 3:
        decision = controller.decide(seen.state, seen.a, target, seen.fingertip_force)
        if decision.message:
            break
        witness.slips()
        after = plant.command(decision.delta_a)
        slip = witness.slips()
        margins = witness.margins()
        done.append(Motion(seen, decision.delta_a, after.a - seen.a, before, margins, slip))
        slipped += done[-1].slips
        assert seen.truth is not None
        assert after.truth is not None
        turned = torch.linalg.vector_norm(after.truth.state.minus(seen.truth.state)[-3:])
        still = still + 1 if float(turned) < np.radians(0.1) else 0
        seen, before = after, margins
    plant.close()
    return done


@dataclass
class Score:
    """What was said and what came, over motions."""

    slips: list[bool] = dataclasses.field(default_factory=list)
    first: list[bool] = dataclasses.field(default_factory=list)
    """The first slip of its grasp."""
    still: list[bool] = dataclasses.field(default_factory=list)
    alarms: list[bool] = dataclasses.field(default_factory=list)
    now: list[tuple[float, float]] = dataclasses.field(default_factory=list)
    """Error of the margin before a motion and its standard deviation (NaN: unknown) [N]."""
    after: list[float] = dataclasses.field(default_factory=list)
    """Error of the margin after a motion without slip [N]."""

    def add(self, motions: list[Motion], model: KinematicModel, estimate: bool, executed: bool) -> None:
        previous, slipped = None, False
        for motion in motions:
            seen = motion.seen
            known = {}
            if estimate:
                known["fingertip_force"] = seen.fingertip_force
                if previous is not None:
                    known["expected"] = previous[0].forces_after(seen.a - previous[1])
            try:
                lin = model.linearize(seen.state, previous=None if previous is None else previous[0], **known)
            except GraspError:  # says so itself: an alarm
                alarm, previous = True, None
            else:
                previous = (lin, seen.a) if lin.forces.solved else None
                expected = lin.forces_after(motion.moved if executed else motion.delta_a)
                alarm = float(expected.margin.min()) < -RELEASE
                std = lin.forces.margin_std
                for i, pad in enumerate(lin.contacts.finger):
                    if pad in motion.margin_before:
                        s = float("nan") if std is None else float(std[i])
                        self.now.append((float(lin.margins[i]) - motion.margin_before[pad], s))
                    if pad in motion.margin_after and not motion.slips:
                        self.after.append(float(expected.margin[i]) - motion.margin_after[pad])
            self.slips.append(motion.slips)
            self.first.append(motion.slips and not slipped)
            self.still.append(motion.slid < STILL)
            self.alarms.append(alarm)
            slipped |= motion.slips

    def row(self) -> str:
        slips, first, still, alarms = (
            np.array(x, bool) for x in (self.slips, self.first, self.still, self.alarms)
        )
        now, after = np.array(self.now).reshape(-1, 2), np.array(self.after)

        def share(of: np.ndarray) -> str:
            return f"{100 * alarms[of].mean():.0f} % of {of.sum()}" if of.any() else "-"

        def rms(x: np.ndarray) -> float:
            return float(np.sqrt(np.nanmean(np.square(x)))) if np.isfinite(x).any() else float("nan")

        cells = [share(slips), share(first), share(~slips), share(still)]
        cells += [f"{rms(now[:, 0]):.2f}", f"{rms(now[:, 0] / now[:, 1]):.1f}", f"{rms(after):.2f}"]
        return " | ".join(f"{cell:>12}" for cell in cells)


HEADER = " | ".join(
    f"{name:>12}"
    for name in (
        "announced",
        "first slips",
        "no slip",
        "nothing slid",
        "rms now [N]",
        "in its sd",
        "rms after",
    )
)


def report(
    grasps: dict[tuple[str, str], list[list[Motion]]], objects: dict[str, ObjectDescription]
) -> list[str]:
    """Lines of the table; ``grasps`` by plant and object."""
    hand = load_hand("icub_right")
    models = {
        name: KinematicModel(hand, obj, ModelOptions(on_unstable="flag")) for name, obj in objects.items()
    }
    lines = [
        f"{'plant, da, forces':34} | {HEADER}",
        "alarms raised in motions of which (announced, first slips: right; the others: false)",
    ]
    for plant, executed in (("sensed", False), ("nominal", False), ("nominal", True)):
        for estimate in (False, True):
            score = Score()
            for (where, name), runs in grasps.items():
                for run in runs if where == plant else []:
                    score.add(run, models[name], estimate, executed)
            da, forces = "executed" if executed else "commanded", "estimated" if estimate else "smallest"
            lines.append(f"{f'{plant}, {da}, {forces}':34} | {score.row()}")
    lines.append("each object, forces estimated, sensed (commanded) and nominal (executed) together")
    for name in objects:
        score = Score()
        for plant in ("sensed", "nominal"):
            for run in grasps.get((plant, name), []):
                score.add(run, models[name], True, plant == "nominal")
        lines.append(f"{name:34} | {score.row()}")
    return lines


def main(arguments: list[str] | None = None) -> list[str]:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", default="1000:1010", help="FIRST:END")
    parser.add_argument("--quick", action="store_true", help="one grasp of one object, three motions")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    first, end = (int(part) for part in options.seeds.split(":"))
    objects = {name: load_object(name) for name in TABLE_I} | own_objects()
    if options.quick:
        objects, end = {"wide": objects["wide"]}, first + 1
    grasps = {
        (plant, name): [record(obj, seed, plant, 3 if options.quick else 25) for seed in range(first, end)]
        for plant in ("sensed", "nominal")
        for name, obj in objects.items()
    }
    lines = report(grasps, objects)
    print("\n".join(lines))
    return lines


if __name__ == "__main__":
    main()
