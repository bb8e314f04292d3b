"""Help texts agree with the options: choices, defaults, examples."""

import re
import shlex

from stillmap.cli.parser import COMMANDS, parser
from stillmap.sim import SCENES

TOP = parser()


def commands(p=TOP):
    """Every command that does something."""
    below = p.subcommands()
    if below is None:
        yield p
    for one in (below or {}).values():
        yield from commands(one)


ALL = {p.prog.removeprefix("stillmap "): p for p in commands()}


def examples(text: str) -> list[list[str]]:
    lines = re.findall(r"^  (stillmap .*)$", text, re.MULTILINE)
    return [shlex.split(re.split(r"  +| > ", line)[0])[1:] for line in lines]


def test_examples_parse():
    texts = [TOP.epilog, TOP.subcommands()["eval"].epilog, *(p.epilog or "" for p in ALL.values())]
    found = [words for text in texts for words in examples(text)]
    assert len(found) > 30
    for words in found:
        args = TOP.parse_args(words)
        assert callable(args.run)
    assert {words[0] for words in found} == set(COMMANDS)


def test_every_help_can_be_shown():
    for p in (TOP, *ALL.values()):
        assert p.format_help().startswith("usage: stillmap")


def test_every_scene_is_listed():
    listed = ALL["simulate"].epilog.partition("\n\n")[0]
    for name in SCENES:
        if not name.endswith("-empty"):
            assert re.search(rf"^  {name} ", listed, re.MULTILINE)
