"""`stillmap config`: every option with its default, unit and meaning, as TOML.

Options on the command line: default < file < --set < flag.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stillmap.cli.console import print_json
from stillmap.cli.parser import COMMANDS

if TYPE_CHECKING:
    from stillmap.pipeline.options import Options


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
    from stillmap.core.config import load_toml, merged, parse_assignment, replaced
    from stillmap.pipeline.options import Options

    options = Options()
    if args.config:
        options = replaced(options, load_toml(Path(args.config)), args.config)
    options = replaced(options, merged(*map(parse_assignment, args.assignments)), "--set")
    return replaced(options, merged(*flags))


def option_names(**_: Any) -> Iterator[str]:
    """Names of options and sections, for shells that complete them."""
    from stillmap.core.config import names
    from stillmap.pipeline.options import DEFAULTS

    return names(DEFAULTS)


def _assignments(prefix: str, **_: Any) -> Iterator[str]:
    from stillmap.pipeline.options import DEFAULTS

    return assignments(DEFAULTS, prefix)


def assignments(options: Any, prefix: str) -> Iterator[str]:
    """What may follow --set: every option, or the values of the one that is named already."""
    from stillmap.core.config import described

    name, equals, _ = prefix.partition("=")
    for one in described(options):
        if not equals:
            yield f"{one.name}="
        elif one.name == name:
            values = one.choices or (("true", "false") if "bool" in one.kind else ())
            yield from (f"{one.name}={value}" for value in values)


_EPILOG = """examples:
  stillmap config                       every option
  stillmap config em.dwell              one section
  stillmap config --set em.prior=0.8    with changes, as `stillmap map` would use them
  stillmap config > options.toml        to be changed, for `stillmap map --config options.toml`
"""


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the command."""
    p = commands.add_parser(
        "config",
        help=COMMANDS["config"],
        description="Print every option with its default, unit and meaning, as TOML that --config "
        "reads back. Later ones win: defaults, the file of --config, --set, other flags.",
        epilog=_EPILOG,
    )
    only = p.add_argument(
        "only", metavar="NAME", nargs="?", default="", help="one section or option, e.g. em.dwell"
    )
    only.completer = option_names  # type: ignore[attr-defined]
    p.add_argument("--json", action="store_true", help="one JSON object on stdout, by option")
    add_option_flags(p)
    p.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Prints the resolved options."""
    from stillmap.core.config import to_toml

    options = resolved_options(args)
    text = to_toml(options, args.only)  # refuses a name that there is not
    if args.json:
        print_json(_by_name(options, args.only))
    else:
        print(text, end="")
    return 0


def _by_name(options: "Options", only: str) -> dict[str, Any]:
    from stillmap.core.config import described, is_within

    return {
        one.name: {
            "value": one.value,
            "default": one.default,
            "type": one.kind,
            "choices": list(one.choices) or None,
            "range": str(one.limits) or None,
            "doc": one.doc,
        }
        for one in described(options)
        if is_within(one.name, only)
    }
