"""Buffers in the form in which single entries are written fastest: torch takes microseconds for each."""

from __future__ import annotations

import weakref
from typing import Any

from torch import nn

from ..typing import Tensor

_kept: weakref.WeakKeyDictionary[nn.Module, tuple[list, dict[str, Any]]] = weakref.WeakKeyDictionary()


def native_buffers(module: nn.Module) -> dict[str, Any]:
    """A module's own buffers: on the CPU arrays that share their memory, else as they are."""
    buffers, kept = module._buffers, _kept.get(module)
    if kept is None or any(buffers[name] is not t or t.data_ptr() != at for name, t, at in kept[0]):
        sources = [(name, t, t.data_ptr()) for name, t in buffers.items() if t is not None]
        kept = _kept[module] = sources, {name: native(t) for name, t, _ in sources}
    return kept[1]


def native(value: Any) -> Any:
    """A tensor on the CPU as an array, all else as it is."""
    return value.detach().numpy() if isinstance(value, Tensor) and value.is_cpu else value
