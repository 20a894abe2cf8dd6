"""Where the notebooks are, and copies of them."""

from __future__ import annotations

import shutil
from pathlib import Path

from ..._files import make_folder
from ...exceptions import DescriptionError


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
