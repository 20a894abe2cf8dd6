"""A scene in the browser: one page that needs no network and no library."""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .._files import write_whole
from ..description import HandDescription
from ..exceptions import ShapeError
from ..kinematics import HandKinematics
from ..typing import Array
from .scene import Colour, Scene
from .visuals import Mesh

_PAGE = Path(__file__).with_name("page.html")


@dataclass(frozen=True)
class Captions:
    """What a page says beside the picture: of ``n`` frames."""

    title: str = ""
    lines: tuple[str, ...] = ()
    """One for each frame."""
    turned: Array | None = None
    """``(n,)`` about the axis [deg]: drawn as a curve."""
    std: Array | None = None
    """``(n,)`` of it [deg]: drawn as a band of two standard deviations."""
    target: float | None = None
    """Where it is to go [deg]."""
    forces: Array | None = None
    """``(n, n_pads, 6)``: where a pad presses [m], and with what force [N], hand frame; NaN: not known."""


def save_animation(
    scene: Scene, path: Path, captions: Captions | None = None, *, seconds: float = 0.25
) -> Path:
    """Write the frames as one stand-alone HTML page: play, step, turn, zoom. WebGL 2 draws it.

    Args:
        captions: title, and what is shown with each frame.
        seconds: from frame to frame, between which poses are interpolated.

    Raises:
        ShapeError: ``captions`` is of another number of frames.
        OutputError: ``path`` cannot be written.
    """
    captions = Captions() if captions is None else captions
    n = len(scene.transforms)
    for name in ("lines", "turned", "std", "forces"):
        value = getattr(captions, name)
        if value is not None and len(value) not in ({0, n} if name == "lines" else {n}):
            raise ShapeError(name, f"({n}, ...)", (len(value),))
    eye, focus, up = (part.tolist() for part in scene.camera)
    data = {
        "title": captions.title,
        "lines": captions.lines,
        "frames": n,
        "seconds": seconds,
        "shapes": [_shape(scene, i, *one) for i, one in enumerate(scene.shapes)],
        "poses": _packed(scene.transforms[:, :, :3]),
        "camera": {"eye": eye, "focus": focus, "up": up},
        "curve": _curve(captions),
        "arrows": None if captions.forces is None else _packed(np.nan_to_num(captions.forces)),
    }
    # of a text that ends the script nothing is left that a browser takes for a tag
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    write_whole(path, _PAGE.read_text(encoding="utf-8").replace("/*DATA*/", text))
    return path


def pad_forces(hand: HandDescription, q: Array, normal: Array) -> Array:
    """The middle of each pad's surface and the force with which it presses there, for :class:`Captions`.

    Args:
        q: ``(n, n_q)`` [rad].
        normal: ``(n, n_pads)`` [N]; NaN: not known.

    Returns:
        ``(n, n_pads, 6)``: point [m] and force [N], hand frame.
    """
    links = HandKinematics(hand)(torch.as_tensor(q, dtype=torch.float64))
    found = np.zeros((*normal.shape, 6))
    for i, pad in enumerate(hand.pads):
        pose, way = links.of(pad.link).numpy(), np.array(pad.direction) / np.linalg.norm(pad.direction)
        middle = (np.array(pad.start) + np.array(pad.end)) / 2 + pad.radius * way
        found[:, i, :3] = pose[:, :3, :3] @ middle + pose[:, :3, 3]
        found[:, i, 3:] = normal[:, i, None] * (pose[:, :3, :3] @ way)
    return found


def _shape(scene: Scene, i: int, shape: Any, colour: Colour) -> dict[str, Any]:
    opacity = scene.opacity(i)
    look = {"colour": colour, "opacity": 1.0 if opacity is None else opacity}
    if isinstance(shape, Mesh):
        return {**look, "kind": "mesh", "vertices": _packed(shape.vertices), "faces": _packed(shape.faces)}
    return {**look, "kind": shape.kind, "size": list(shape.size)}


def _curve(captions: Captions) -> dict[str, Any] | None:
    if captions.turned is None:
        return None
    target = None if captions.target is None else float(captions.target)
    curve: dict[str, Any] = {"label": "turned [deg]", "values": captions.turned.tolist(), "target": target}
    if captions.std is not None:
        curve["low"] = (captions.turned - 2 * captions.std).tolist()
        curve["high"] = (captions.turned + 2 * captions.std).tolist()
    return curve


def _packed(values: Array) -> str:
    """As base64 of 32-bit floats: they hold whole numbers up to 16 million."""
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f4").tobytes()).decode()
