"""The command line, from the application itself."""

from __future__ import annotations

import re
from typing import Any

import typer.main


def commands() -> str:
    """A section for each command: what it does, and its arguments and options with their defaults."""
    from torch_ekm.cli import app

    group = typer.main.get_command(app)
    context = group.make_context("torch-ekm", [], resilient_parsing=True)
    return "\n\n".join(_section(name, group.commands[name]) for name in group.list_commands(context))  # type: ignore[attr-defined]


def _section(name: str, command: Any) -> str:
    usage = " ".join(
        ["torch-ekm", name, *(_metavar(one) for one in command.params if not one.opts[0].startswith("-"))]
    )
    parts = [f"## {name}", f"```text\n{usage} [OPTIONS]\n```" if command.params else f"```text\n{usage}\n```"]
    parts.append(_plain(command.help or ""))
    rows = [_row(one) for one in command.params if one.name != "help" and not getattr(one, "hidden", False)]
    if rows:
        parts.append("\n".join(["| argument or option | default | meaning |", "|---|---|---|", *rows]))
    return "\n\n".join(parts)


def _row(parameter: Any) -> str:
    is_option = parameter.opts[0].startswith("-")
    names = ", ".join(f"`{one}`" for one in (*parameter.opts, *parameter.secondary_opts))
    shown = names if is_option else f"`{_metavar(parameter)}`".replace("|", r"\|")
    default = parameter.default() if callable(parameter.default) else parameter.default
    if parameter.required:
        default_text = "required"
    elif default is None or default == "":
        default_text = "–"
    elif isinstance(default, bool):
        default_text = next(
            (f"`{one[0]}`" for one in ((parameter.opts, parameter.secondary_opts)[not default],) if one),
            "off",
        )
    else:
        default_text = f"`{default}`"
    meaning = _plain(getattr(parameter, "help", "") or "").replace("\n", " ")
    return f"| {shown} | {default_text} | {meaning} |"


def _metavar(parameter: Any) -> str:
    name = (parameter.metavar or parameter.name).strip("[]").upper()
    return name if parameter.required else f"[{name}]"


def _plain(text: str) -> str:
    """Help texts are plain: what Markdown would read as markup is escaped."""
    paragraphs = [" ".join(part.split()) for part in text.split("\n\n")]
    return "\n\n".join(re.sub(r"([\[\]<>|*_])", r"\\\1", part) for part in paragraphs)
