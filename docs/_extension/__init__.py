"""What Sphinx knows about this package: where a name is documented, and how docstrings are written."""

from __future__ import annotations

from typing import Any


def setup(app: Any) -> dict[str, bool]:
    """Connect the parts."""
    from . import docstrings, generated, names, numbers

    docstrings.setup(app)
    names.setup(app)
    generated.setup(app)
    numbers.setup(app)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
