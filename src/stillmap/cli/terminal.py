"""Colours, on terminals alone."""

import os
from typing import IO

_STYLES = {"error": "1;31", "warning": "33"}  # bold red, yellow


def coloured(stream: IO[str]) -> bool:
    """Whether to write colours: as NO_COLOR, FORCE_COLOR, CLICOLOR_FORCE and TERM say."""
    if os.environ.get("NO_COLOR"):
        return False
    if os.environ.get("FORCE_COLOR") or os.environ.get("CLICOLOR_FORCE", "0") not in ("", "0"):
        return True
    return is_terminal(stream)


def is_terminal(stream: IO[str] | None) -> bool:
    """Whether a stream goes to a terminal that knows more than plain text."""
    return stream is not None and stream.isatty() and os.environ.get("TERM") != "dumb"


def painted(text: str, style: str, stream: IO[str] | None) -> str:
    """The text in the colour of a style, "error" or "warning", where the stream shows colours."""
    if stream is None or not coloured(stream):
        return text
    return f"\x1b[{_STYLES[style]}m{text}\x1b[0m"
