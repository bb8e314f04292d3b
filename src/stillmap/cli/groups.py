"""Inputs of a command grouped to runs: parts of one, or sessions."""

import argparse
from pathlib import Path

from stillmap.cli.console import show_share
from stillmap.core.errors import InputError
from stillmap.io.input_groups import InputGroup, group_inputs
from stillmap.prepare.options import ReadOptions

_FOR_ONE_RUN = (
    "tilting",
    "tilting_topic",
    "poses",
    "region",
)  # flags of `map` that need one recording


def find_groups(
    args: argparse.Namespace, options: ReadOptions, scratch: Path | None
) -> list[InputGroup]:
    """Group the inputs of a command; a single one is not read.

    Raises:
        InputError: one of several cannot be read.
    """
    with show_share(args.quiet, "comparing the inputs") as progress:
        return group_inputs(args.input, options, progress=progress, scratch=scratch)


def require_for_sessions(args: argparse.Namespace, groups: list[InputGroup]) -> None:
    """Refuse flags of `map` that are for one recording, where there are several sessions.

    Raises:
        InputError: one of them is given.
    """
    for name in _FOR_ONE_RUN:
        if getattr(args, name) is not None:
            what = f"--{name.replace('_', '-')} is for one recording: {describe_sessions(groups)}"
            raise InputError(what)


def describe_sessions(groups: list[InputGroup]) -> str:
    """Why the groups are sessions, in one sentence."""
    return f"these are {len(groups)} sessions, {groups[1].why}"


def describe_group(group: InputGroup) -> str:
    """The inputs of a group and why they belong together, or why one stands alone."""
    if group.kind == "parts":
        return f"{', '.join(group.paths)}: parts of one run: {group.why}"
    return f"{group.paths[0]}: a session of its own: {group.why}"
