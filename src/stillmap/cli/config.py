"""`stillmap config`: every option with its default, unit and meaning, as TOML."""

import argparse

from stillmap.cli.options import add_option_flags, resolved_options
from stillmap.options import to_toml


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the command."""
    p = commands.add_parser(
        "config", help="every option with its default, unit and meaning, as TOML"
    )
    add_option_flags(p)
    p.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Prints the resolved options."""
    print(to_toml(resolved_options(args)), end="")
    return 0
