"""Text that a terminal shows and does not obey."""

import re

# C0, C1 and delete; line and paragraph separators; marks that change the order of characters
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\u200e\u200f\u202a-\u202e\u2066-\u2069]")


def printable(text: str) -> str:
    """The text on one line, with control characters as escapes.

    Names of files, topics and frames may hold any, with which a terminal changes its colors, its
    title or lines above.
    """
    return _CONTROL.sub(_escape, text)


def _escape(found: re.Match[str]) -> str:
    number = ord(found[0])
    return f"\\x{number:02x}" if number < 0x100 else f"\\u{number:04x}"
