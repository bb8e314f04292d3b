"""Options on the command line: default < file < --set < flag."""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stillmap.pipeline import Options


def add_option_flags(p: argparse.ArgumentParser) -> None:
    """`--config` and `--set`."""
    group = p.add_argument_group("any other option, see `stillmap config`")
    group.add_argument("--config", metavar="FILE.toml", help="options from a TOML file")
    add_set(group, "one option, e.g. em.prior=0.8; can be given again").completer = _assignments  # type: ignore[attr-defined]


def add_set(p: argparse._ActionsContainer, help: str) -> argparse.Action:
    """`--set`, the last of which wins."""
    return p.add_argument(
        "--set",
        dest="assignments",
        metavar="SECTION.KEY=VALUE",
        action="append",
        default=[],
        help=help,
    )


def resolved_options(args: argparse.Namespace, *flags: dict[str, Any]) -> "Options":
    """The options after file, --set and flags, checked.

    Raises:
        InputError: an unknown key or a wrong value, with the place it came from.
    """
    from stillmap.options import load_toml, merged, parse_assignment, replaced
    from stillmap.pipeline import Options

    options = Options()
    if args.config:
        options = replaced(options, load_toml(Path(args.config)), args.config)
    options = replaced(options, merged(*map(parse_assignment, args.assignments)), "--set")
    return replaced(options, merged(*flags))


def option_names(**_: Any) -> Iterator[str]:
    """Names of options and sections, for shells that complete them."""
    from stillmap.options import names
    from stillmap.pipeline import DEFAULTS

    return names(DEFAULTS)


def _assignments(prefix: str, **_: Any) -> Iterator[str]:
    from stillmap.pipeline import DEFAULTS

    return assignments(DEFAULTS, prefix)


def assignments(options: Any, prefix: str) -> Iterator[str]:
    """What may follow --set: every option, or the values of the one that is named already."""
    from stillmap.options import described

    name, equals, _ = prefix.partition("=")
    for one in described(options):
        if not equals:
            yield f"{one.name}="
        elif one.name == name:
            values = one.choices or (("true", "false") if "bool" in one.kind else ())
            yield from (f"{one.name}={value}" for value in values)
