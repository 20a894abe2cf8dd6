"""How a stranger's files and figures are read; files that are whole or not there; folders with one writer."""

from __future__ import annotations

import contextlib
import os
import stat
import threading
import weakref
from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path
from typing import Any

from ._extras import require
from .exceptions import DescriptionError, EKMError, FileFormatError, FolderInUseError, OutputError

LOCK = ".lock"
"""Name of the file that a folder's writer holds; it stays, empty."""

Refusal = type[DescriptionError] | type[FileFormatError]
_UNASKED = 64 << 20  # bytes that any file may unpack to


def check_file(path: str | os.PathLike, what: str, largest: int, refusal: Refusal = DescriptionError) -> Path:
    """The path of a regular file of at most ``largest`` bytes: nothing else can be read without waiting.

    Raises:
        refusal: there is no such file, it is larger, or a folder, a pipe or a device.
    """
    path = Path(path)
    try:
        status = path.stat()
    except (FileNotFoundError, NotADirectoryError, ValueError):  # a name that no file can have
        raise refusal(path, f"no such {what}") from None
    except OSError as error:
        raise refusal(path, f"cannot be read: {error.strerror}") from None
    if not stat.S_ISREG(status.st_mode):
        raise refusal(path, f"no {what}: it is no file but a folder, a pipe or a device")
    if status.st_size > largest:
        raise refusal(path, f"a {what} has at most {largest} bytes, this one is larger")
    return path


@contextlib.contextmanager
def opened(
    path: str | os.PathLike, what: str, largest: int, refusal: Refusal = DescriptionError
) -> Iterator[BufferedReader]:
    """A file to be read, see :func:`check_file`.

    Raises:
        refusal: as there, or the system refuses.
    """
    try:
        with check_file(path, what, largest, refusal).open("rb") as file:
            yield file
    except OSError as error:
        raise refusal(path, f"cannot be read: {error.strerror or error}") from None


def read_file(path: str | os.PathLike, what: str, largest: int) -> bytes:
    """All bytes of a file, see :func:`opened`.

    Raises:
        DescriptionError: as there.
    """
    with opened(path, what, largest) as file:
        content = file.read(largest + 1)  # it may have grown, or be of unknown size
    if len(content) > largest:
        raise DescriptionError(path, f"a {what} has at most {largest} bytes, this one is larger")
    return content


@contextlib.contextmanager
def told_as_damage(path: str | os.PathLike, what: str, refusal: Refusal = DescriptionError) -> Iterator[None]:
    """Whatever a damaged file makes its library raise is one error; a file can be made to look right.

    Raises:
        refusal: something was raised that is no error of torch_ekm.
    """
    try:
        yield
    except EKMError:
        raise
    except Exception as error:
        raise refusal(path, f"damaged {what}: {type(error).__name__}: {error}") from None


def check_announced(
    path: str | os.PathLike,
    announced: int,
    there: int,
    refusal: Refusal = DescriptionError,
    *,
    times: int = 32,
) -> None:
    """That what a file says it unpacks to goes with its size: some kB can announce some GB.

    Args:
        announced: bytes in memory.
        there: bytes in the file.
        times: how well it may be packed.

    Raises:
        refusal: it is more than 64 MiB, and ``times`` as much as there is.
    """
    if announced > _UNASKED + times * there:
        raise refusal(path, f"damaged: {there} bytes that announce {announced} bytes of figures")


@contextlib.contextmanager
def told_as_output_error(path: str | Path) -> Iterator[None]:
    """What the system refuses while ``path`` is written is an OutputError."""
    try:
        yield
    except (OSError, ValueError) as error:  # a name that no file can have
        raise OutputError(path, getattr(error, "strerror", None) or error) from error


def make_folder(folder: Path) -> None:
    """With those above it, if it is not there.

    Raises:
        OutputError: it cannot be made.
    """
    with told_as_output_error(folder):
        folder.mkdir(parents=True, exist_ok=True)


def write_whole(path: Path, content: bytes | str) -> None:
    """Write a file that appears whole or not at all, and is safe on the disk when this returns. A link stays
    one, and what was at its end is replaced.

    Raises:
        OutputError: it cannot be written, or is a folder, a pipe or a device; it is what it was.
    """
    with told_as_output_error(path):
        path = Path(os.path.realpath(path))
        if path.exists() and not path.is_file():
            raise OutputError(path, "it is no file but a folder, a pipe or a device")
        # two who write it at once must not write into each other
        part = path.with_name(f"{path.name}.{os.getpid()}.{threading.get_ident():x}.part")
        try:
            with part.open("wb") as file:
                file.write(content.encode() if isinstance(content, str) else content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(part, path)
        except BaseException:
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)
            raise
        _sync(path.parent)


def _sync(folder: Path) -> None:
    """Wait until a folder's list of names is on the disk."""
    if os.name == "nt":  # a folder cannot be opened there
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class WriterLock:
    """The right to write in a folder; the system takes it back when its process ends, however it ends.

    Raises:
        FolderInUseError: another process has it; the message names the process.
        OutputError: the folder cannot be written to.
        MissingExtraError: filelock is not installed.
    """

    def __init__(self, folder: Path) -> None:
        filelock = require("filelock")
        self._path = folder / LOCK
        lock = filelock.FileLock(self._path, thread_local=False)
        with told_as_output_error(folder):
            try:
                lock.acquire(blocking=False)
            except filelock.Timeout:  # an OSError, too
                raise FolderInUseError(folder, self._holder()) from None
        _note(self._path, str(os.getpid()))
        self._end = weakref.finalize(self, _release, lock, self._path)  # at the end of the process, too

    @property
    def held(self) -> bool:
        """Whether this process still has the right to write."""
        return self._end.alive

    def release(self) -> None:
        """Let others write; more than once does nothing."""
        self._end()

    def __enter__(self) -> WriterLock:
        return self

    def __exit__(self, *exception: object) -> None:
        self.release()

    def _holder(self) -> int | None:
        try:
            return int(self._path.read_text(encoding="ascii"))
        except (OSError, ValueError):
            return None


def _release(lock: Any, path: Path) -> None:
    if lock.is_locked:
        _note(path, "")  # equal runs leave equal folders
        lock.release()


def _note(path: Path, text: str) -> None:
    with contextlib.suppress(OSError):  # the lock holds without: this only lets others know whose it is
        path.write_text(text, encoding="ascii")


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
