"""`stillmap config`: print every option; the flags `--config` and `--set` of all commands."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stillmap.cli.console import print_json, print_lines

if TYPE_CHECKING:
    from stillmap.pipeline.options import Options


def add_option_flags(p: argparse.ArgumentParser) -> None:
    """Add `--config` and `--set`."""
    group = p.add_argument_group("any other option, see `stillmap config`")
    group.add_argument("--config", metavar="FILE.toml", help="options from a TOML file")
    add_set_flag(group, "one option, e.g. em.prior=0.8; can be given again")


def add_set_flag(p: argparse._ActionsContainer, help: str) -> None:
    """Add `--set`; the last value of an option counts."""
    p.add_argument(
        "--set",
        dest="assignments",
        metavar="SECTION.KEY=VALUE",
        action="append",
        default=[],
        help=help,
    )


def options_from_args(args: argparse.Namespace, *flags: dict[str, Any]) -> "Options":
    """Resolve options by precedence: default < file < --set < flag.

    Raises:
        InputError: an unknown key or a wrong value, and where it came from.
    """
    from stillmap.core.config import load_toml, merge_nested, override, parse_assignment
    from stillmap.pipeline.options import Options

    options = Options()
    if args.config:
        options = override(options, load_toml(Path(args.config)), args.config)
    options = override(options, merge_nested(*map(parse_assignment, args.assignments)), "--set")
    return override(options, merge_nested(*flags))


DESCRIPTION = (
    "Print every option with its default, meaning and range, as TOML for --config."
    " Precedence: defaults < file of --config < --set < other flags."
)
EPILOG = """examples:
  stillmap config                       every option
  stillmap config slam.odometry         one section
  stillmap config --set em.prior=0.8    with changes, as `stillmap map` would use them
  stillmap config > options.toml        to edit, for `stillmap map --config options.toml`
"""


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the flags and arguments."""
    p.add_argument(
        "only",
        metavar="NAME",
        nargs="?",
        default="",
        help="one section or option, e.g. slam.odometry",
    )
    p.add_argument("--json", action="store_true", help="one JSON object on stdout, by option")
    add_option_flags(p)


def run(args: argparse.Namespace) -> int:
    """Print the options."""
    from stillmap.core.config import to_toml

    options = options_from_args(args)
    text = to_toml(options, args.only)  # raises for unknown names
    if args.json:
        print_json(_describe(options, args.only))
    else:
        print_lines(text.splitlines())
    return 0


def _describe(options: "Options", only: str) -> dict[str, Any]:
    from stillmap.core.config import is_within, iter_options

    return {
        one.name: {
            "value": one.value,
            "default": one.default,
            "type": one.kind,
            "choices": list(one.choices) or None,
            "range": str(one.limits) or None,
            "doc": one.doc,
        }
        for one in iter_options(options)
        if is_within(one.name, only)
    }
