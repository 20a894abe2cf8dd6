"""The moving picture of README: one turn with the KM and with the E-KM, side by side.

    python docs/film.py docs/images/turn.gif

Runs the first hand of the demo; needs a graphics library (OpenGL).
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial.transform import Rotation, Slerp

from torch_ekm.description import load_hand, load_object
from torch_ekm.experiments.jobs import run_jobs
from torch_ekm.experiments.protocols.demo import Demo
from torch_ekm.experiments.records import TrialRecord
from torch_ekm.rendering import Picture, Scene, make_scene
from torch_ekm.typing import Array

SEED = 1000
SIZE, TITLE = (400, 320), 34  # of a scene, and height of its title [pixel]
BETWEEN, MOTIONS = 4, 20  # pictures of a motion; motions shown


def turns() -> list[TrialRecord]:
    """The longest turn of each controller."""
    demo = Demo()
    with TemporaryDirectory() as folder:
        kept = run_jobs(demo.run, demo.jobs([SEED]), Path(folder))
    records = [TrialRecord.from_json(record) for session in kept.values() for record in session]
    made = [record for record in records if isinstance(record, TrialRecord)]
    return [
        max((r for r in made if r.controller == name), key=lambda r: r.angle_deg) for name in demo.controllers
    ]


def in_between(turn: TrialRecord) -> tuple[Scene, list[str]]:
    """The turn with ``BETWEEN`` pictures of each motion, and their titles."""
    q, position, rotation = (np.array(part[: MOTIONS + 1]) for part in zip(*turn.poses, strict=True))
    n = len(q) - 1
    at = np.linspace(0, n, n * BETWEEN + 1)
    lower = np.minimum(at.astype(int), n - 1)
    share = (at - lower).reshape(-1, *(1,) * (q.ndim - 1))
    hand = load_hand("icub_right")
    scene = make_scene(
        hand,
        load_object(turn.object),
        q[lower] * (1 - share) + q[lower + 1] * share,
        position[lower] * (1 - share) + position[lower + 1] * share,
        Slerp(np.arange(n + 1), Rotation.from_matrix(rotation))(at).as_matrix(),
        np.array(hand.gravity),
    )
    left = turn.errors_deg
    titles = [f"{turn.controller}   motion {int(t):2d}   {abs(left[int(t)]):4.1f} deg to go" for t in at]
    return scene, titles


def titled(picture: Array, text: str) -> Array:
    """The picture below its title."""
    page = Image.new("RGB", (picture.shape[1], picture.shape[0] + TITLE), "white")
    page.paste(Image.fromarray(picture), (0, TITLE))
    ImageDraw.Draw(page).text((12, 8), text, fill="black", font=ImageFont.load_default(17))
    return np.asarray(page)


def main(path: Path) -> None:
    films = []
    for turn in turns():
        scene, titles = in_between(turn)
        camera = Picture(scene.meshes, size=SIZE, smooth=True)
        drawn = [camera.draw(frame[None], scene.camera) for frame in scene.transforms]
        camera.close()
        films.append([titled(*both) for both in zip(drawn, titles, strict=True)])
    length = max(map(len, films))
    whole = [np.concatenate([film[min(k, len(film) - 1)] for film in films], axis=1) for k in range(length)]
    pictures = [Image.fromarray(frame) for frame in whole]
    palette = pictures[-1].quantize(64)  # one for all: pixels that stay the same cost nothing
    frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    duration = [60] * (length - 1) + [2500]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=duration, loop=0, optimize=True)
    print(f"{path}: {length} pictures, {path.stat().st_size / 1024:.0f} kB")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
