"""Columns of a Parquet file."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..._extras import require
from ..._files import check_announced, check_file, told_as_damage
from ...exceptions import DescriptionError
from ...typing import Array
from .csv_file import Names, Read, labels

_LARGEST = 4 << 30  # bytes


def open_parquet(path: Path, label: str) -> tuple[Names, Read]:
    """Column names, and a function that reads some of them; these hold numbers.

    Checksums of pages are compared where they were written (``write_page_checksum=True`` of pyarrow).

    Raises:
        DescriptionError: no Parquet file, damaged, or some kB that announce GB. The function raises it, too.
    """
    check_file(path, "file of a table", _LARGEST)
    parquet = require("pyarrow.parquet")
    with told_as_damage(path, "file, or no Parquet file"), parquet.ParquetFile(path) as file:
        return tuple(file.schema_arrow.names), partial(_read, path, label)


def _read(path: Path, label: str, columns: Sequence[str]) -> Array:
    parquet = require("pyarrow.parquet")
    with (
        told_as_damage(path, "Parquet file"),
        parquet.ParquetFile(path, page_checksum_verification=True) as file,
    ):
        n = file.metadata.num_rows
        check_announced(path, 8 * n * (1 + len(columns)), path.stat().st_size)
        table = file.read(columns=list(columns))
        values = [_values(path, name, table.column(name), name == label) for name in columns]
        if any(len(column) != n for column in values):
            raise DescriptionError(path, "damaged: it has another number of rows than it says")
        return np.stack(values, -1) if columns else np.empty((n, 0))


def _values(path: Path, name: str, column: Any, is_label: bool) -> Array:
    types = require("pyarrow").types
    kind = column.type
    if is_label and (types.is_string(kind) or types.is_large_string(kind)):
        texts = column.to_pylist()
        number = labels(texts)
        found = np.array([number(text) if text else None for text in texts], dtype=np.float64)
    elif types.is_integer(kind) or types.is_floating(kind):
        found = column.to_numpy().astype(np.float64)
    else:
        raise DescriptionError(path, f"column '{name}' holds {kind}, not numbers; leave it out or encode it")
    if not np.isfinite(found).all():
        row = int(np.flatnonzero(~np.isfinite(found))[0])
        raise DescriptionError(path, f"row {row + 1}, column '{name}' is empty or not finite")
    return found
