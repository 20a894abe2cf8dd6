"""Images from a camera or a video file, by OpenCV."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator

from ..._extras import require
from ...exceptions import DescriptionError
from .camera import PinholeCamera
from .sources import Frame, StreamOptions


class VideoCapture:
    """A camera ``VideoCapture(0)`` or a video file, through ``cv2.VideoCapture``.

    A camera is asked for the size of ``camera`` and for ``options.rate``; its frames are stamped by the
    clock when they arrive, and exposed ``options.latency`` before. Frames of a file are
    stamped by their number. Reading a camera that has nothing to give is a dropped frame.

    Args:
        device: number of a camera, or path or address of a video.
        camera: the lens, for the size of the images.
        options: rate and latency.

    Raises:
        DescriptionError: the device cannot be opened.
    """

    def __init__(
        self, device: int | str, camera: PinholeCamera | None = None, options: StreamOptions | None = None
    ) -> None:
        cv2 = require("cv2")
        self.options, self._live = options or StreamOptions(), isinstance(device, int)
        self._capture = cv2.VideoCapture(device)
        if not self._capture.isOpened():
            raise DescriptionError(device, "OpenCV cannot open this camera or video")
        if self._live:
            size = camera or PinholeCamera()
            self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, size.width)
            self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size.height)
            self._capture.set(cv2.CAP_PROP_FPS, self.options.rate)
            self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # an old frame is worse than none
        self._numbers, self._start = itertools.count(), time.monotonic()

    def __iter__(self) -> Iterator[Frame]:
        for index in self._numbers:
            there, image = self._capture.read()
            if self._live:
                arrival = time.monotonic() - self._start
                yield Frame(index, arrival - self.options.latency, arrival, image if there else None)
            elif there:
                exposed = index / self.options.rate
                yield Frame(index, exposed, exposed + self.options.latency, image)
            else:
                return

    def close(self) -> None:
        """Give the device back."""
        self._capture.release()
