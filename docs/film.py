"""The moving picture of README, and the pages that the site shows: a turn, a hand, a plan.

    python docs/film.py

The picture: one turn with the KM and with the E-KM, on one clock, to the end of both. Turns from the same
grasp of the same simulated hand; the E-KM has made three other turns before. Needs a graphics library
(OpenGL).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial.transform import Rotation, Slerp

from torch_ekm.control import ClosedLoop, LookAndMoveController, PoseTarget
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.inspection.view import view
from torch_ekm.model import KinematicModel
from torch_ekm.plant import Observation, Plant, PlantWrapper
from torch_ekm.rendering import Captions, Picture, Scene, make_scene, save_animation
from torch_ekm.rendering.web import pad_forces
from torch_ekm.simulation import SimulatedHand
from torch_ekm.typing import Array

DOCS = Path(__file__).parent
SEED, ANGLE = 1000, 25.0  # of the grasp; of the turn [deg]
BEFORE = (14.0, -8.0, 22.0)  # turns that the E-KM has made [deg]
SIZE, TITLE, PLOT = (400, 300), 36, 150  # of a scene; height of its title and of the curves [pixel]
STEP, SHOWN = 0.06, 0.08  # of the simulation between two pictures, and how long each is shown [s]
COLOURS = {"KM": "#d55e00", "E-KM": "#0072b2"}


class Filmed(PlantWrapper):
    """Keeps each reading, those on the way too."""

    def __init__(self, plant: Plant) -> None:
        super().__init__(plant)
        self.seen: list[Observation] = []

    def reset(self, seed: int) -> Observation:
        """Grasp again; what was seen before is left out."""
        self.seen = []
        return super().reset(seed)

    def observation(self, seen: Observation) -> Observation:
        """As it is, and kept."""
        self.seen.append(seen)
        return seen


@dataclass(frozen=True)
class Turn:
    """What was seen and made, from the first reading on."""

    name: str
    times: Array
    errors: Array
    """Left of the turn at each [deg]."""
    q: Array
    position: Array
    rotation: Array
    forces: Array
    """Of the pads, as measured [N]."""
    motions: Array
    """When each began [s]."""

    def between(self, values: Array, at: Array) -> Array:
        """At these times, each the last known one at the latest."""
        flat = values.reshape(len(values), -1)
        found = [np.interp(np.minimum(at, self.times[-1]), self.times, one) for one in flat.T]
        return np.stack(found, axis=1)

    def scene(self, at: Array, hand: SimulatedHand) -> Scene:
        """Hand and object at these times."""
        q, position = self.between(self.q, at), self.between(self.position, at)
        turning = Slerp(self.times, Rotation.from_matrix(self.rotation))
        rotation = turning(np.minimum(at, self.times[-1])).as_matrix()
        axis, gravity = hand.rotation_axis.numpy(), np.array(hand.hand.gravity)
        return make_scene(hand.hand, hand.object, q, position, rotation, gravity, axis=axis)

    def pictures(self, at: Array, hand: SimulatedHand) -> list[Array]:
        """At these times, each the last known one at the latest."""
        scene = self.scene(at, hand)
        camera = Picture(scene.meshes, size=SIZE, smooth=True)
        drawn = [camera.draw(frame[None], scene.camera) for frame in scene.transforms]
        camera.close()
        return drawn

    def page(self, at: Array, hand: SimulatedHand) -> Path:
        """For the site."""
        left = self.between(self.errors, at)[:, 0]
        captions = Captions(
            f"{hand.hand.name} turns {hand.object.name} by {ANGLE:g} deg: {self.name}",
            tuple(self.title(time) for time in at),
            left[0] - left,
            target=ANGLE,
            forces=pad_forces(hand.hand, self.between(self.q, at), self.between(self.forces, at)),
        )
        return save_animation(
            self.scene(at, hand), DOCS / "_static" / "viewer" / "turn.html", captions, seconds=SHOWN
        )

    def title(self, time: float) -> str:
        """How many motions, and what is left."""
        left = float(np.interp(time, self.times, self.errors))
        made = int(np.searchsorted(self.motions, time, side="right"))
        return f"{self.name}   {made} motion{'s' * (made != 1)}   {left:4.1f} deg to go"


def turn(name: str, hand: SimulatedHand) -> Turn:
    """The turn with one of the two models."""
    plant = Filmed(hand)
    model, knowledge, controller = KinematicModel(hand.hand, hand.object), None, None
    for k, angle in enumerate([*(BEFORE if name == "E-KM" else ()), ANGLE]):
        start = plant.reset(SEED if angle == ANGLE else SEED + 1 + k)
        if controller is None:
            chosen = model if name == "KM" else EnhancedModel.for_grasp(model, start.state)
            controller = LookAndMoveController(chosen, hand.rotation_axis)
        loop = ClosedLoop(plant, controller, knowledge=knowledge)
        done = loop.run(PoseTarget.turned(start.state, hand.rotation_axis, degrees=angle))
        knowledge = loop.knowledge if name == "E-KM" else None
        print(f"{name}: {angle:g} deg, {len(done.steps)} motions, {done.reason.value}", flush=True)
    known = {seen.time: seen for seen in plant.seen}
    times = np.array(sorted(known))
    states = [known[time].truth.state for time in times]  # a simulated hand knows
    forces = np.stack([known[time].fingertip_force.numpy() for time in times])
    target = PoseTarget.turned(states[0], hand.rotation_axis, degrees=ANGLE)
    errors = np.array([math.degrees(done.focus.error(target, state)) for state in states])
    q, position, rotation = (
        np.stack([getattr(state, part).numpy() for state in states]) for part in ("q", "position", "rotation")
    )
    began = np.array([step.before.time for step in done.steps]) - times[0]
    return Turn(name, times - times[0], errors, q, position, rotation, forces, began)


def curves(turns: list[Turn], time: float) -> Image.Image:
    """What is left of each turn until ``time``, over the clock of the simulation."""
    width, font = 2 * SIZE[0], ImageFont.load_default(14)
    page = Image.new("RGB", (width, PLOT), "white")
    draw = ImageDraw.Draw(page)
    left, right, top, bottom = 62, width - 20, 12, PLOT - 34
    end, most = max(one.times[-1] for one in turns), 5 * math.ceil(max(one.errors.max() for one in turns) / 5)

    def place(t: float, error: float) -> tuple[float, float]:
        return left + (right - left) * t / end, bottom - (bottom - top) * error / most

    for error in range(0, most + 1, 10):
        draw.line([place(0, error), place(end, error)], fill="#dddddd")
        draw.text((left - 8, place(0, error)[1]), f"{error}", fill="black", font=font, anchor="rm")
    for second in range(int(end) + 1):
        draw.text((place(second, 0)[0], bottom + 4), f"{second}", fill="black", font=font, anchor="mt")
    draw.text((right, bottom + 18), "time in the simulation [s]", fill="black", font=font, anchor="rt")
    draw.text((4, top - 8), "left\n[deg]", fill="black", font=font)
    for one in turns:
        known = one.times <= time
        way = [place(*pair) for pair in zip(one.times[known], one.errors[known], strict=True)]
        now = min(time, one.times[-1])
        way.append(place(now, float(np.interp(now, one.times, one.errors))))
        draw.line(way, fill=COLOURS[one.name], width=3)
        x, y = way[-1]
        draw.ellipse((x - 4, y - 4, x + 4, y + 4), fill=COLOURS[one.name])
        if x > left + 60:  # before that they would lie on each other
            side = "lm" if x < width - 80 else "rm"
            draw.text((x + 8, y - 9), one.name, fill=COLOURS[one.name], font=font, anchor=side)
    return page


def main() -> None:
    """Film both turns, and write the pages."""
    (DOCS / "_static" / "viewer").mkdir(exist_ok=True)
    hand = SimulatedHand("icub_right", "box", preset="nominal")
    turns = [turn(name, hand) for name in ("KM", "E-KM")]
    at = np.arange(0, max(one.times[-1] for one in turns) + STEP, STEP)
    films = [one.pictures(at, hand) for one in turns]
    turns[1].page(np.arange(0, turns[1].times[-1] + STEP / 2, STEP / 2), hand)
    hand.close()
    for name, what in (("hand", view("icub_right")), ("plan", view("icub_right", "box", reach=True))):
        save_animation(what.scene, DOCS / "_static" / "viewer" / f"{name}.html", what.captions)
    pictures = []
    for k, time in enumerate(at):
        page = Image.new("RGB", (2 * SIZE[0], TITLE + SIZE[1] + PLOT), "white")
        for side, (one, film) in enumerate(zip(turns, films, strict=True)):
            page.paste(Image.fromarray(film[k]), (side * SIZE[0], TITLE))
            place = (side * SIZE[0] + 12, 8)
            ImageDraw.Draw(page).text(
                place, one.title(time), fill=COLOURS[one.name], font=ImageFont.load_default(17)
            )
        page.paste(curves(turns, time), (0, TITLE + SIZE[1]))
        pictures.append(page)
    palette = pictures[-1].quantize(64)  # one for all: pixels that stay the same cost nothing
    frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    duration = [int(1000 * SHOWN)] * (len(frames) - 1) + [3000]
    path = DOCS / "images" / "turn.gif"
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=duration, loop=0, optimize=True)
    print(f"{path}: {len(frames)} pictures, {path.stat().st_size / 1024:.0f} kB")


if __name__ == "__main__":
    main()
