from __future__ import annotations

import hashlib
import os
import tempfile
from pathlib import Path

from ..exceptions import BusError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None


class OneMaster:
    """The right to command a hand from this machine; the system takes it back when its process ends.

    Args:
        hand: what is commanded, such as a topic or a part, by a name that all its drivers give it.

    Raises:
        BusError: another driver has it.
    """

    def __init__(self, hand: str) -> None:
        name = hashlib.sha256(hand.encode()).hexdigest()[:16]
        path = Path(tempfile.gettempdir()) / f"torch_ekm_{name}.lock"
        self._file = os.fdopen(os.open(path, os.O_RDONLY | os.O_CREAT, 0o666))
        if fcntl is not None:
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                self.release()
                raise BusError(hand, "another driver commands it: one hand has one master") from None

    def release(self) -> None:
        """Let others command it."""
        self._file.close()
