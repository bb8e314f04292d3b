"""Warnings about which the user can do something: what is wrong, where, and what to do.

A warning is one sentence, so that console, `run.json` and the notes of a recording hold it as text.
"""

_MARK = "; what to do: "


def advise(what: str, todo: str) -> str:
    """A warning that ends with advice."""
    return f"{what}{_MARK}{todo}"


def split_advice(warning: str) -> tuple[str, str]:
    """A warning split in its cause and its remedy, which is empty where nothing has to be done."""
    what, _, todo = warning.partition(_MARK)
    return what, todo
