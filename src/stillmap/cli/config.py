"""`stillmap config`: every option with its default, unit and meaning, as TOML."""

import argparse
from typing import TYPE_CHECKING, Any

from stillmap.cli.commands import COMMANDS
from stillmap.cli.options import add_option_flags, option_names, resolved_options
from stillmap.cli.printing import print_json

if TYPE_CHECKING:
    from stillmap.pipeline import Options

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
    from stillmap.options import to_toml

    options = resolved_options(args)
    text = to_toml(options, args.only)  # refuses a name that there is not
    if args.json:
        print_json(_by_name(options, args.only))
    else:
        print(text, end="")
    return 0


def _by_name(options: "Options", only: str) -> dict[str, Any]:
    from stillmap.options import described, is_within

    return {
        one.name: {
            "value": one.value,
            "default": one.default,
            "type": one.kind,
            "choices": list(one.choices) or None,
            "doc": one.doc,
        }
        for one in described(options)
        if is_within(one.name, only)
    }
