"""What the notebooks share: smoke mode, the hand to turn and zoom, and copies of them."""

from __future__ import annotations

import base64
import html
import os
import shutil
import sys
import tempfile
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..._files import make_folder
from ...exceptions import DescriptionError, MissingExtraError
from ...rendering import Scene, save_animation, save_picture


def smoke_mode() -> bool:
    """Run everything in its smallest size: ``TORCH_EKM_SMOKE`` is set to anything but 0."""
    return os.environ.get("TORCH_EKM_SMOKE", "0") not in ("", "0")


@dataclass
class HandView:
    """A scene as the last line of a notebook cell: a picture, or a page to turn and zoom."""

    scene: Scene
    """See :func:`~torch_ekm.rendering.make_scene`."""
    frames: tuple[int, ...] = (0,)
    """Of the picture, side by side."""
    interactive: bool = False
    """Also offer the page with all frames (viser): megabytes in a notebook that is stored. Without viser:
    the picture only."""

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, str]:
        bundle = {"text/plain": "HandView"}
        with tempfile.TemporaryDirectory() as folder:
            picture = save_picture(self.scene, Path(folder) / "hand.png", frames=self.frames)
            bundle["image/png"] = base64.b64encode(picture.read_bytes()).decode()
            if self.interactive:
                with suppress(MissingExtraError), _silence():
                    page = save_animation(self.scene, Path(folder) / "hand.html").read_text(encoding="utf-8")
                    bundle["text/html"] = (
                        f'<iframe srcdoc="{html.escape(page)}" width="100%" height="420" '
                        'style="border: 0"></iframe>'
                    )
        return bundle


def _silence() -> AbstractContextManager:
    """viser announces an address that nobody shall open, in a notebook through IPython's display."""
    if "IPython" not in sys.modules:
        return nullcontext()
    from IPython.utils.capture import capture_output

    return capture_output()


def notebook_folder() -> Path:
    """Where the notebooks lie: in the installed package, or in the checkout.

    Raises:
        DescriptionError: in neither.
    """
    package = Path(__file__).resolve().parents[2]
    for folder in (package / "_notebooks", package.parent / "notebooks"):
        if any(folder.glob("[0-9]*.ipynb")):
            return folder
    raise DescriptionError(package, "the notebooks are missing from this installation; install it again")


def copy_notebooks(folder: Path, *, overwrite: bool = False) -> list[Path]:
    """Copy all notebooks into ``folder`` (made if it is not there) and return the copies' paths.

    Raises:
        DescriptionError: one of them is there already and ``overwrite`` is not set; nothing is copied.
    """
    sources = sorted(notebook_folder().glob("[0-9]*.ipynb"))
    copies = [folder / source.name for source in sources]
    present = [copy.name for copy in copies if copy.exists()]
    if present and not overwrite:
        problem = "would be overwritten; name another folder, or use --overwrite"
        raise DescriptionError(folder, f"{', '.join(present)} {problem}")
    if folder.exists() and not folder.is_dir():
        raise DescriptionError(folder, "this is a file; name a folder")
    make_folder(folder)
    return [Path(shutil.copyfile(*pair)) for pair in zip(sources, copies, strict=True)]
