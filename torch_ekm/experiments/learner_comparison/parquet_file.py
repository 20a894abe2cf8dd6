"""Columns of a Parquet file, as far as it can be known that they are those that were written."""

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

    Checksums of pages are compared where they were written, and figures with the statistics of their row
    group (least, largest, number of missing ones), which nearly all programs write. A figure that was
    changed within these cannot be told from the one that was written, unless there are checksums
    (``write_page_checksum=True`` of pyarrow).

    Raises:
        DescriptionError: no Parquet file, damaged, or some kB that announce GB. The function raises it, too.
    """
    check_file(path, "file of a table", _LARGEST)
    parquet = require("pyarrow.parquet")
    with told_as_damage(path, "file, or no Parquet file"), parquet.ParquetFile(path) as file:
        return tuple(file.schema_arrow.names), partial(_read, path, label)


def _read(path: Path, label: str, columns: Sequence[str]) -> Array:
    parquet, pyarrow = require("pyarrow.parquet"), require("pyarrow")
    with (
        told_as_damage(path, "Parquet file"),
        parquet.ParquetFile(path, page_checksum_verification=True) as file,
    ):
        groups = [file.metadata.row_group(i) for i in range(file.num_row_groups)]
        if sum(group.num_rows for group in groups) != file.metadata.num_rows:
            raise DescriptionError(path, "damaged: its groups have other numbers of rows than it says")
        check_announced(path, 8 * file.metadata.num_rows * (1 + len(columns)), path.stat().st_size)
        parts = [file.schema_arrow.empty_table().select(list(columns))]
        for i, group in enumerate(groups):
            parts.append(file.read_row_group(i, columns=list(columns)))
            _compare(path, parts[-1], group)
        table = pyarrow.concat_tables(parts)
        values = [_values(path, name, table.column(name), name == label) for name in columns]
        return np.stack(values, -1) if columns else np.empty((file.metadata.num_rows, 0))


def _compare(path: Path, part: Any, group: Any) -> None:
    """Figures of a row group with what the file says of them."""
    said = {one.path_in_schema: one.statistics for one in map(group.column, range(group.num_columns))}
    for name, column in zip(part.column_names, part.columns, strict=True):
        of = said.get(name)
        wrong = len(column) != group.num_rows
        if of is not None and of.has_null_count:
            wrong |= column.null_count != of.null_count
        if of is not None and of.has_min_max and isinstance(of.min, int | float):
            figures = column.drop_null().to_numpy()
            figures = figures[figures == figures]
            wrong |= not len(figures) or (figures.min(), figures.max()) != (of.min, of.max)
        if wrong:
            raise DescriptionError(path, f"damaged: column '{name}' does not hold what its statistics say")


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
