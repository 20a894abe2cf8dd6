"""Pictures of this package's hand and objects in place of the paper's Fig. 2b, 3e and 4.

Each is drawn by ``torch_ekm.rendering`` from what the package computes: joint angles of the actuation map and
of the simulated hand, shapes of the object files, true poses of one turn.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch

from torch_ekm.description import HandDescription, Shape, load_hand, load_object
from torch_ekm.experiments.config import Setting
from torch_ekm.experiments.records import TrialRecord
from torch_ekm.experiments.reporting.plots import new_figure
from torch_ekm.experiments.runner import Bench
from torch_ekm.kinematics import ActuationMap
from torch_ekm.kinematics.se3 import log
from torch_ekm.rendering import Picture, Scene, make_scene
from torch_ekm.rendering.visuals import visuals
from torch_ekm.simulation import PlantConfig, PlantParameters
from torch_ekm.simulation.physics.rig import Rig
from torch_ekm.typing import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: The paper's Fig. 3e, in its order.
OBJECTS = {
    "toothpaste": "toothpaste tube", "applier": "toy applier", "box": "rectangular box",
    "weighted_box": "box with counter-weight", "bottle": "plastic bottle", "can": "can",
}  # fmt: skip
_PATTERNS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7")  # Okabe and Ito: a motor each
_ALONE = "#b8bcc2"  # links that have a motor of their own, and the palm
_FAR = np.array([0.0, 0.0, 5.0])  # [m]: the object is out of the hand's way
_BEYOND = 60.0  # [deg]: farther than the applier goes
_FRAMES = 6
_SIZE = (560, 420)  # of a picture before it is cropped [pixel]
_WARM_UP = (8.0, 13.0, 18.0)  # [deg]
_FIRST_WARM_UP = 1000  # number of the first training grasp
_CENTRE = (0.15, 0.15, 0.15)  # colour of the centre of mass


@dataclass(frozen=True)
class Coupled:
    """How the joints of one motor move."""

    motor: Array
    """``(n,)`` positions [deg]."""
    model: dict[str, Array]
    """Joint -> its angles by the actuation map [deg]."""
    simulated: dict[str, Array]
    """The same in the simulated hand, which touches nothing."""


def coupled_joints(hand: HandDescription, points: int) -> dict[str, Coupled]:
    """Joints that share a motor, over its range, the other motors as in the open hand."""
    actuation, nothing = ActuationMap(hand), PlantParameters()
    rig = Rig(hand, load_object("box"), PlantConfig(), nothing, lambda _: None)
    rest = torch.from_numpy(hand.actuator_lower)
    found = {}
    for k, (name, arms) in enumerate(zip(hand.actuator_names, hand.actuation_jacobian, strict=True)):
        joints = np.flatnonzero(arms)
        if len(joints) < 2:
            continue
        a = rest.repeat(points, 1)
        a[:, k] = torch.linspace(float(hand.actuator_lower[k]), float(hand.actuator_upper[k]), points)
        q = actuation.joints(a).numpy()
        start = SimpleNamespace(q=q[0], position=_FAR, rotation=np.eye(3), motor=a[0].numpy())
        rig.grasp(cast(Any, start))  # of nothing: the object falls where no finger is
        simulated = []
        for motor in a.numpy():
            rig.move(motor)
            simulated.append(rig.scene.q.copy())
        named = [hand.joint_names[j] for j in joints]
        angles = (
            dict(zip(named, np.degrees(one)[:, joints].T, strict=True)) for one in (q, np.array(simulated))
        )
        found[name] = Coupled(np.degrees(a[:, k].numpy()), *angles)
    return found


def largest_difference(coupled: dict[str, Coupled]) -> float:
    """Between joints of one motor in the simulated hand, at any position [deg]."""
    return max(float(np.ptp(list(one.simulated.values()), axis=0).max()) for one in coupled.values())


def draw_coupled_joints(hand: HandDescription, coupled: dict[str, Coupled]) -> Figure:
    """The hand with the links of one motor in one colour, and their joints over the motor's position."""
    figure, axes = new_figure(9.5, 5.0, columns=3, rows=2)
    colours = dict(zip(coupled, _PATTERNS, strict=True))
    of_joint = {joint: colours[name] for name, one in coupled.items() for joint in one.model}
    axes[0].imshow(*_cropped([_draw(_open_hand(hand, of_joint))]), interpolation="none")
    axes[0].set_axis_off()
    for axis, (name, one) in zip(axes[1:], coupled.items(), strict=True):
        for k, joint in enumerate(one.model):
            style = {"color": colours[name], "alpha": 0.5}
            axis.plot(one.motor, one.model[joint], linewidth=1.5, linestyle=(2 * k, (6, 4)), **style)
            marker = "os^Dv<"[k]
            axis.plot(one.motor, one.simulated[joint], marker, color=colours[name], markersize=4, label=joint)
        axis.set_title(name, fontsize=10)
        axis.set(xlabel="motor [deg]", ylabel="joint [deg]")
        axis.legend(fontsize=7, ncols=1 + (len(one.model) > 3))
    return figure


def _open_hand(hand: HandDescription, colours: dict[str, str]) -> Scene:
    q = ActuationMap(hand).joints(torch.from_numpy(0.9 * hand.actuator_lower + 0.1 * hand.actuator_upper))
    scene = make_scene(hand, None, q.numpy()[None], None, None, np.array(hand.gravity))
    moved_by = {joint.child: joint.name for joint in hand.urdf.joints}
    drawn = visuals(hand.urdf).of_link
    links = [link.name for link in hand.urdf.links for _ in drawn[link.name]]
    shapes = [
        (shape, _rgb(colours.get(moved_by.get(link, ""), _ALONE)))
        for link, (shape, _) in zip(links, scene.shapes, strict=True)
    ]
    # from the side of the palm, fingers up
    return replace(scene, shapes=shapes, side=np.array([0.2, -0.3, 1.0]), down=np.array([-1.0, 0.0, 0.0]))


def draw_objects() -> Figure:
    """The six objects at one scale, see-through, with their centres of mass."""
    figure, axes = new_figure(9.0, 4.2, columns=3, rows=2)
    pictures = _cropped([_draw(_object_alone(name)) for name in OBJECTS])
    for axis, picture, (name, called) in zip(axes, pictures, OBJECTS.items(), strict=True):
        thing = load_object(name)
        size = np.ptp(np.concatenate([_corners(shape) for shape in thing.shapes]), axis=0) * 1000
        axis.imshow(picture, interpolation="none")
        axis.set_axis_off()
        axis.set_title(called, fontsize=10)
        size_text = " x ".join(f"{length:.0f}" for length in size)
        text = f"{size_text} mm, {1000 * thing.mass:.0f} g, friction {thing.friction:g}"
        axis.text(0.5, -0.02, text, fontsize=8, ha="center", va="top", transform=axis.transAxes)
    return figure


def _object_alone(name: str) -> Scene:
    """Its centre of mass, and its shapes about it."""
    thing = load_object(name)
    place = np.eye(4)
    place[:3, 3] = thing.com
    centre = Shape("sphere", (0.004,), place)
    shapes = [(centre, _CENTRE), *((shape, (0.90, 0.62, 0.0)) for shape in thing.shapes)]
    transforms = np.stack([shape.transform for shape, _ in shapes])[None]
    return Scene(
        shapes, transforms, np.array([0.0, 0.0, -1.0]), np.array([0.35, -1.0, 0.5]), len(thing.shapes)
    )


def _corners(shape: Shape) -> Array:
    """Of the box around a shape, in the object's frame ``(8, 3)``."""
    half = np.array(shape.size) / 2
    if shape.kind == "cylinder":
        half = np.array([shape.size[0], shape.size[0], shape.size[1] / 2])
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(-1, 3)
    return signs * half @ shape.transform[:3, :3].T + shape.transform[:3, 3]


@dataclass(frozen=True)
class FarTurn:
    """The applier, turned as far as the hand turns it."""

    angles: Array
    """About the axis since the grasp, true, before each motion and at the end [deg]."""
    off: Array
    """Off the axis [deg]."""
    scene: Scene
    """Frames of the same."""
    reason: str
    """Why the turn ended."""

    @property
    def end(self) -> int:
        """The frame of the largest angle."""
        return int(self.angles.argmax())


def turn_applier(seed: int, quick: bool) -> FarTurn:
    """By an E-KM that has turned it before, from one grasp, in preset nominal."""
    bench = Bench(Setting(sensing=True).hardware_instance(seed), "applier", "E-KM")
    for k, angle in enumerate(_WARM_UP[: 1 if quick else None]):
        bench.trial(seed, _FIRST_WARM_UP + k, angle, "warm-up")
    turn = bench.trial(seed, 0, 8.0 if quick else _BEYOND, poses=True)
    if not isinstance(turn, TrialRecord):
        raise SystemExit(f"No pinch held the applier (seed {seed}): {turn.message}")
    axis = bench.hand.rotation_axis.numpy()
    bench.close()
    q, position, rotation = (np.array(part) for part in zip(*turn.poses, strict=True))
    turned = np.degrees(log(torch.from_numpy(rotation @ rotation[0].T)).numpy())
    angles = turned @ axis
    off = np.linalg.norm(turned - angles[:, None] * axis, axis=-1)
    hand = load_hand("icub_right")
    scene = make_scene(hand, load_object("applier"), q, position, rotation, np.array(hand.gravity), axis=axis)
    return FarTurn(angles, off, scene, turn.reason)


def draw_turn(turn: FarTurn) -> Figure:
    """Frames from the grasp to the largest angle, evenly spread over the angle."""
    wanted = np.linspace(0, turn.angles[turn.end], _FRAMES)
    chosen = [int(np.abs(turn.angles[: turn.end + 1] - angle).argmin()) for angle in wanted]
    figure, axes = new_figure(9.0, 4.6, columns=3, rows=2)
    scenes = [replace(turn.scene, transforms=turn.scene.transforms[[k]]) for k in chosen]
    picture = Picture(scenes[0], _SIZE, smooth=True)
    frames = _cropped([picture.draw(scene, camera=turn.scene.camera) for scene in scenes])
    picture.close()
    for axis, k, frame in zip(axes, chosen, frames, strict=True):
        axis.imshow(frame, interpolation="none")
        axis.set_title(f"{turn.angles[k]:.0f} deg", fontsize=10)
        axis.set_axis_off()
    return figure


def _draw(scene: Scene) -> Array:
    """One frame ``(height, width, 3)``."""
    picture = Picture(scene, _SIZE, smooth=True)
    drawn = picture.draw(scene)
    picture.close()
    return drawn


def _cropped(pictures: list[Array]) -> list[Array]:
    """Without the white edges that all of them have."""
    drawn = (np.stack(pictures) < 255).any((0, 3))
    rows, columns = (np.flatnonzero(drawn.any(axis)) for axis in (1, 0))
    return [one[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] for one in pictures]


def _rgb(colour: str) -> tuple[float, float, float]:
    red, green, blue = (int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5))
    return red, green, blue
