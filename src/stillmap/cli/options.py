"""Options on the command line: default < file < --set < flag."""

import argparse
from pathlib import Path
from typing import Any

from stillmap.options import load_toml, merged, parse_assignment, replaced
from stillmap.pipeline import Options


def add_option_flags(p: argparse.ArgumentParser) -> None:
    """`--config` and `--set`."""
    p.add_argument("--config", metavar="FILE.toml", help="options from a TOML file")
    p.add_argument(
        "--set",
        dest="assignments",
        metavar="SECTION.KEY=VALUE",
        action="append",
        default=[],
        help="one option, e.g. em.prior=0.8; see `stillmap config`; can be given again",
    )


def resolved_options(args: argparse.Namespace, *flags: dict[str, Any]) -> Options:
    """The options after file, --set and flags, checked.

    Raises:
        InputError: an unknown key or a wrong value, with the place it came from.
    """
    options = Options()
    if args.config:
        options = replaced(options, load_toml(Path(args.config)), args.config)
    options = replaced(options, merged(*map(parse_assignment, args.assignments)), "--set")
    return replaced(options, merged(*flags))
