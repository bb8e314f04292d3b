"""Text for the page: Markdown and HTML."""

import html
import re
from collections.abc import Sequence

TEXT_STYLE = "font-size:.8em;line-height:1.5;padding:0 .9em"
_MARKDOWN = re.compile(r"([\\`*_{}\[\]()<>#+\-.!|~&$:])")  # special characters


def escape_markdown(text: str) -> str:
    """Text escaped for Markdown."""
    return _MARKDOWN.sub(r"\\\1", text)


def table_html(rows: Sequence[tuple[str, str]]) -> str:
    """A table of names and values."""
    cells = "".join(
        f'<tr><td style="padding-right:1em;opacity:.7">{html.escape(name)}</td>'
        f"<td>{html.escape(value)}</td></tr>"
        for name, value in rows
    )
    return f'<table style="{TEXT_STYLE}">{cells}</table>'
