"""The command line: ``torch-ekm``."""

from __future__ import annotations

import sys
import warnings

from .._terminal import say_error, say_note  # first: needs the extra
from ..exceptions import EKMError, MissingExtraError
from . import describe as describe
from . import experiments as experiments
from . import real_hand as real_hand
from ._app import app

import typer  # isort: skip

__all__ = ["app", "main"]

_ClickException: type[Exception] = typer.BadParameter.__mro__[2]  # newer versions of typer hold their own


def main() -> None:
    """Entry point: what torch_ekm refuses on purpose, and what the system refuses (a full disk, say), is
    reported in one line, without a traceback. The process ends with 1 then, with 2 if it was an option.
    Warnings are notes of one line."""
    warnings.showwarning = lambda message, *_: say_note(message)
    try:
        code = app(standalone_mode=False)
    except _ClickException as error:
        context = getattr(error, "ctx", None)
        hint = f"; see '{context.command_path} --help'" if context is not None else ""
        say_error(f"{error.format_message().rstrip('.')}{hint}")  # pyright: ignore[reportAttributeAccessIssue]
        sys.exit(2)
    except typer.Abort:
        sys.exit(1)
    except (EKMError, OSError) as error:
        more = ["all commands run with extra 'experiments'"] * isinstance(error, MissingExtraError)
        say_error("; ".join([str(error), *more, *getattr(error, "__notes__", ())]))
        sys.exit(1)
    sys.exit(code if isinstance(code, int) else 0)
