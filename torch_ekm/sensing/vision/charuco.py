"""A chessboard with markers in its white squares, to calibrate a camera with."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..._extras import require
from ...exceptions import ParameterError
from .board import get_dictionary


@dataclass(frozen=True, eq=False)
class CharucoTarget:
    """``columns x rows`` squares of edge ``square_size`` [m]; a white rim of half a square around them.

    Each marker names the chess corners around it, so that a view may show a part of the target only.

    Raises:
        ParameterError: fewer than 3 squares a side, or markers as large as the squares.
    """

    columns: int = 8
    rows: int = 6
    square_size: float = 0.025
    marker_size: float = 0.018
    dictionary: str = "DICT_5X5_100"

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3:
            raise ParameterError("CharucoTarget.columns, rows", (self.columns, self.rows), "3 or more")
        if not 0 < self.marker_size < self.square_size:
            raise ParameterError("CharucoTarget.marker_size", self.marker_size, "below square_size")

    @cached_property
    def board(self):
        """The same target as OpenCV's ``cv2.aruco.CharucoBoard``, lengths in [m]."""
        cv2 = require("cv2")
        size = (self.columns, self.rows)
        return cv2.aruco.CharucoBoard(
            size, self.square_size, self.marker_size, get_dictionary(self.dictionary)
        )

    @property
    def size(self) -> tuple[float, float]:
        """Width and height with the rim [m]."""
        return (self.columns + 1) * self.square_size, (self.rows + 1) * self.square_size

    def texture(self, texel: float = 2.5e-4) -> NDArray[np.uint8]:
        """What is printed: 0 black, 255 white, upper left first."""
        rim = max(1, round(self.square_size / 2 / texel))  # the square is an even number of texels
        size = ((self.columns + 1) * 2 * rim, (self.rows + 1) * 2 * rim)
        return self.board.generateImage(size, marginSize=rim, borderBits=1)
