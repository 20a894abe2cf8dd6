"""Read an XML file of a hand or an object."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

from .._text import read_text
from ..exceptions import DescriptionError

_MOST_NAMES = 6  # of a note
LARGEST = 4 << 20  # bytes of a file that describes a hand or an object


def read_xml(path: Path, what: str, *roots: str) -> ET.Element:
    """The root element, which is one of ``roots``. Text is UTF-8, whatever the file declares.

    Raises:
        DescriptionError: no such file, more than 4 MiB, not UTF-8, malformed, or another root.
    """
    text = read_text(path, what, LARGEST)
    try:
        root = ET.fromstring(text)  # fetches no external entity, refuses those that blow up
    except (ET.ParseError, ValueError) as error:
        hint = "; of a file with macros run first: xacro" if "<xacro:" in text else ""
        raise DescriptionError(path, f"not well-formed XML: {error}{hint}") from None
    if any("xacro" in element.tag for element in root.iter()):
        raise DescriptionError(path, f"holds macros; run first: xacro {path} > NEW{path.suffix}")
    if root.tag not in roots:
        raise DescriptionError(path, f"the root element must be <{roots[0]}>, found <{root.tag}>")
    return root


def listed(note: str, names: Sequence[str]) -> str:
    """A note on several things: ``"note: a, b"``, and how many more there are."""
    more = len(names) - _MOST_NAMES
    return f"{note}: {', '.join(names[:_MOST_NAMES])}" + (f" and {more} more" if more > 0 else "")
