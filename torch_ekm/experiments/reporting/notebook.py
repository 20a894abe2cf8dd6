"""Smoke mode, pictures of the hand, and copies of notebooks, which the notebooks share."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

from ..._files import make_folder
from ...exceptions import DescriptionError
from ...rendering import Scene, save_picture


def smoke_mode() -> bool:
    """Run everything in its smallest size: ``TORCH_EKM_SMOKE`` is set to anything but 0."""
    return os.environ.get("TORCH_EKM_SMOKE", "0") not in ("", "0")


def hand_picture(scene: Scene, frames: tuple[int, ...] = (0,)) -> Any:
    """A scene as the last line of a notebook cell: these frames of it side by side, an image of IPython."""
    from IPython.display import Image

    with tempfile.TemporaryDirectory() as folder:
        return Image(save_picture(scene, Path(folder) / "hand.png", frames=frames).read_bytes())


def notebook_folder() -> Path:
    """Find the notebooks: in the installed package, or in the checkout.

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
