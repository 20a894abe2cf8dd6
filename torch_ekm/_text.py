"""How text and figures are read, whoever wrote them: files of hands, wirings and tables."""

from __future__ import annotations

import codecs
import os

from ._files import read_file
from .exceptions import DescriptionError

#: first bytes of what is no UTF-8, the longer ones first, and its name for iconv
_MARKS = (
    (codecs.BOM_UTF32_LE, "UTF-32"), (codecs.BOM_UTF32_BE, "UTF-32"),
    (codecs.BOM_UTF16_LE, "UTF-16"), (codecs.BOM_UTF16_BE, "UTF-16"),
)  # fmt: skip


def read_text(path: str | os.PathLike, what: str, largest: int) -> str:
    """All of a file of at most ``largest`` bytes, see :func:`~torch_ekm._files.read_file`.

    Raises:
        DescriptionError: it cannot be read, or is not UTF-8.
    """
    return decode(read_file(path, what, largest), path)


def decode(content: bytes, path: str | os.PathLike) -> str:
    """UTF-8, with or without a byte order mark.

    Raises:
        DescriptionError: another encoding; the message names the likely one, and how to convert.
    """
    for mark, name in _MARKS:
        if content.startswith(mark):
            raise DescriptionError(path, f"this is {name}, not UTF-8; {_convert(name)}")
    zero = content.find(b"\0")
    if zero >= 0:
        kind = "UTF-16LE" if zero % 2 else "UTF-16BE"
        problem = f"byte {zero} is 0: no text, or {kind} without a mark; {_convert(kind)}"
        raise DescriptionError(path, problem)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line, byte = content.count(b"\n", 0, error.start) + 1, content[error.start]
        problem = f"line {line}: byte {error.start}, 0x{byte:02x}, is not UTF-8; the file may be Latin-1"
        raise DescriptionError(path, f"{problem}; {_convert('LATIN1')}") from None


def _convert(name: str) -> str:
    return f"save it as UTF-8, as by 'iconv -f {name} -t UTF-8 OLD > NEW'"


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
