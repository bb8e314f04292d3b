"""Print every option with its default, meaning and range, as TOML for --config. Precedence:
defaults < file of --config < --set < other flags.

examples:
  stillmap config                       every option
  stillmap config slam.odometry         one section
  stillmap config --set em.prior=0.8    with changes, as `stillmap map` would use them
  stillmap config > options.toml        to edit, for `stillmap map --config options.toml`
"""

import argparse

from stillmap.cli.arguments import OTHERS, options_from_args
from stillmap.cli.console import print_json, print_lines

FLAGS = f"""
only NAME?  one section or option, e.g. slam.odometry
--json  one JSON object on stdout, by option
{OTHERS}"""


def run(args: argparse.Namespace) -> int:
    """Print the options."""
    from stillmap.core.config import is_within, iter_options, to_toml

    options = options_from_args(args)
    text = to_toml(options, args.only)  # raises for unknown names
    if not args.json:
        print_lines(text.splitlines())
        return 0
    described = {}
    for info in iter_options(options):
        if is_within(info.name, args.only):
            described[info.name] = {
                "value": info.value,
                "default": info.default,
                "type": info.kind,
                "choices": list(info.choices) or None,
                "range": info.limits or None,
                "doc": info.doc,
            }
    print_json(described)
    return 0
