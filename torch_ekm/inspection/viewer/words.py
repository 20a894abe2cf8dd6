from __future__ import annotations

import html
from collections.abc import Iterable


def as_html(lines: Iterable[object]) -> str:
    """A paragraph for each line, shown as it stands: a log is not trusted to write the viewer's page.

    viser's Markdown would render HTML that it finds, which can hold scripts.
    """
    style = "margin: 0.3em 1em; font-size: 0.85em; overflow-wrap: anywhere"
    text = (str(line).encode(errors="backslashreplace").decode() for line in lines)
    return "".join(f'<p style="{style}">{html.escape(line)}</p>' for line in text)
