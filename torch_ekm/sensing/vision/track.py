"""What the tracker says about one image."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from ...exceptions import ObjectLostError
from ...typing import Float, Tensor
from .board_pose import BoardPose


class TrackStatus(Enum):
    """Why there is a pose, or none."""

    OK = "ok"
    NO_IMAGE = "no_image"  # the frame was dropped
    PALM_HIDDEN = "palm_hidden"  # too few markers of the palm's board were found
    OBJECT_HIDDEN = "object_hidden"  # too few markers of the object's board were found
    AMBIGUOUS = "ambiguous"  # two mirrored poses fit, and no earlier frame decides which
    JUMP = "jump"  # the pose is too far from the last one; accepted when seen repeatedly


@dataclass(frozen=True)
class Track:
    """Pose of the object in the hand frame, or the reason why there is none.

    ``position``, ``rotation`` and ``covariance`` are None unless ``status`` is OK.
    """

    status: TrackStatus
    position: Float[Tensor, " 3"] | None = None
    """Origin of the object's frame [m], float64."""
    rotation: Float[Tensor, "3 3"] | None = None
    covariance: Float[Tensor, "6 6"] | None = None
    """Of the error twist ``(v; w)`` about the object's origin, hand axes [m, rad]."""
    palm: BoardPose | None = None
    """The palm's board in the camera frame, where it was found in this image."""
    object: BoardPose | None = None
    """The object's board in the camera frame, where it was found."""
    markers: Mapping[int, NDArray[np.float64]] = field(default_factory=dict)
    """Corners ``(4, 2)`` [px] of each marker of both boards that was found, by its number."""

    @property
    def ok(self) -> bool:
        return self.status is TrackStatus.OK

    def pose(self) -> tuple[Float[Tensor, " 3"], Float[Tensor, "3 3"]]:
        """``(position, rotation)``.

        Raises:
            ObjectLostError: there is none in this frame.
        """
        if self.position is None or self.rotation is None:
            remedy = "take the next frame, or clear the line of sight"
            raise ObjectLostError(f"no pose in this frame: {self.status.value}; {remedy}")
        return self.position, self.rotation
