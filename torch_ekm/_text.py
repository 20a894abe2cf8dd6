"""How text and figures are read, whoever wrote them: files of hands, wirings and tables."""

from __future__ import annotations

import os

from ._files import read_file
from .exceptions import DescriptionError


def read_text(path: str | os.PathLike, what: str, largest: int) -> str:
    """All of a file of at most ``largest`` bytes, see :func:`~torch_ekm._files.read_file`.

    Raises:
        DescriptionError: it cannot be read, or is not UTF-8.
    """
    return decode(read_file(path, what, largest), path)


def decode(content: bytes, path: str | os.PathLike) -> str:
    """UTF-8, with or without a byte order mark.

    Raises:
        DescriptionError: another encoding; the message names the place, and how to convert.
    """
    bad = content.find(b"\0")  # of every second letter in UTF-16
    if bad < 0:
        try:
            return content.decode().lstrip("\ufeff")  # two, where files were joined
        except UnicodeDecodeError as error:
            bad = error.start
    line = content.count(b"\n", 0, bad) + 1
    remedy = "save it as UTF-8, as by 'iconv -f LATIN1 -t UTF-8 OLD > NEW', or with -f UTF-16"
    raise DescriptionError(path, f"line {line}: byte {bad}, 0x{content[bad]:02x}, is not UTF-8; {remedy}")


def figure(text: str) -> float | None:
    """A number with a decimal point, in ASCII digits, perhaps with an exponent: ``-1.5e-3``; None: no number.

    ``nan`` and ``inf``, in small or large letters, are numbers that are not finite. Blanks around do not
    count. What else Python's ``float`` takes is no number: ``1_000``, digits of other scripts.
    """
    if "_" in text or not text.isascii():
        return None
    try:
        return float(text)
    except ValueError:
        return None
