"""What the files of a hand and an object hold, as digests: a change of one of them can be told."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

from ..exceptions import DescriptionError
from .registry import hand_paths, object_paths


def file_digests(hand: str | Path, objects: Iterable[str | Path]) -> dict[str, str]:
    """SHA-256 of each file that describes the hand and the objects (names or paths), hexadecimal.

    Returns:
        ``{"hand icub_right_hand.urdf": digest, ..., "object box.object.toml": digest}``

    Raises:
        UnknownNameError: no such hand or object.
        DescriptionError: a file cannot be read.
    """
    named = [("hand", path) for path in hand_paths(hand)]
    named += [("object", path) for item in objects for path in object_paths(item)]
    digests = {}
    for kind, path in named:
        try:
            digests[f"{kind} {path.name}"] = hashlib.sha256(path.read_bytes()).hexdigest()
        except OSError as error:
            raise DescriptionError(path, f"cannot be read: {error.strerror}") from None
    return digests
