"""Images from a folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from ..._extras import require
from ...exceptions import DescriptionError
from .sources import Frame, StreamOptions


class ImageFolder:
    """The images of a folder, in the order of their names, at a steady rate.

    A file that cannot be read counts as a dropped frame.

    Args:
        folder: where they lie.
        pattern: which files.
        options: ``rate`` and ``latency`` give the times; the rest is not used.

    Raises:
        DescriptionError: no such folder, or no file of that pattern in it.
    """

    def __init__(
        self, folder: str | Path, pattern: str = "*.png", options: StreamOptions | None = None
    ) -> None:
        self.folder, self.options = Path(folder), options or StreamOptions()
        if not self.folder.is_dir():
            raise DescriptionError(folder, "no such folder")
        self.paths = sorted(self.folder.glob(pattern))
        if not self.paths:
            raise DescriptionError(folder, f"no file matches '{pattern}'")

    def __len__(self) -> int:
        return len(self.paths)

    def __iter__(self) -> Iterator[Frame]:
        cv2 = require("cv2")
        for index, path in enumerate(self.paths):
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)  # None where it is no image
            time = index / self.options.rate
            yield Frame(index, time, time + self.options.latency, image)
