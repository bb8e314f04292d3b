"""Help texts agree with the options: choices, defaults, examples."""

import argparse
import re
import shlex
import typing

import pytest

from stillmap.cli.parser import COMMANDS, parser
from stillmap.core.config import iter_options
from stillmap.em import Estimator, MapState
from stillmap.eval.relations import MAX_DT
from stillmap.pipeline.options import MapMode, Options
from stillmap.prepare.options import ReadOptions
from stillmap.sim import SCENES, CrowdOptions

TOP = parser()


def commands(p=TOP):
    """Every command that does something."""
    below = p.subcommands()
    if below is None:
        yield p
    for one in (below or {}).values():
        yield from commands(one)


ALL = {p.prog.removeprefix("stillmap "): p for p in commands()}


def action(command: str, flag: str) -> argparse.Action:
    (found,) = [a for a in ALL[command]._actions if flag in a.option_strings or a.dest == flag]
    return found


def test_every_command_is_listed():
    assert set(TOP.subcommands()) == set(COMMANDS)
    assert {"map", "info", "view", "filter", "simulate", "config", "eval labels"} <= set(ALL)


@pytest.mark.parametrize("name", ["", "eval", *ALL])
def test_help_has_a_paragraph_and_examples(name, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    p = {"": TOP, "eval": TOP.subcommands()["eval"], **ALL}[name]
    assert re.fullmatch(r"[A-Z][^\n]{40,}\.", p.description)
    assert re.search(r"^(examples|to install it):\n  ", p.epilog, re.MULTILINE)
    text = p.format_help()
    for what in ("-h, --help", "-v, --verbose", "--quiet"):
        assert what in text


@pytest.mark.parametrize("columns", [80, 160])
@pytest.mark.parametrize("name", ALL)
def test_help_is_as_wide_as_the_terminal(name, columns, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    text = ALL[name].format_help().removesuffix(ALL[name].epilog)
    widths = [len(line) for line in text.splitlines()]
    assert max(widths) <= columns
    assert max(widths) > min(columns, 100) * 0.7


def examples(text: str) -> list[list[str]]:
    lines = re.findall(r"^  (stillmap .*)$", text, re.MULTILINE)
    return [shlex.split(re.split(r"  +| > ", line)[0])[1:] for line in lines]


def test_examples_parse():
    texts = [TOP.epilog, TOP.subcommands()["eval"].epilog, *(p.epilog for p in ALL.values())]
    found = [words for text in texts for words in examples(text)]
    assert len(found) > 30
    for words in found:
        args = TOP.parse_args(words)
        assert callable(args.run)
    assert {words[0] for words in found} == set(COMMANDS)


def test_top_level_help_names_exit_statuses():
    for status in ("0    done", "1    a defect", "2    the input or the call", "130  interrupted"):
        assert status in TOP.epilog


@pytest.mark.parametrize(
    ("command", "flag", "choices"),
    [
        ("map", "--estimator", typing.get_args(Estimator)),
        ("map", "--map-mode", typing.get_args(MapMode)),
        ("map", "--map-state", typing.get_args(MapState)),
        ("map", "--zero-means", typing.get_args(typing.get_type_hints(ReadOptions)["zero_means"])),
        ("simulate", "--shape", typing.get_args(typing.get_type_hints(CrowdOptions)["shape"])),
    ],
)
def test_choices_are_those_of_the_options(command, flag, choices):
    assert set(action(command, flag).choices) == set(choices)


@pytest.mark.parametrize(
    ("flag", "option"),
    [
        ("--threads", "threads"),
        ("--estimator", "estimator"),
        ("--resolution", "slam.resolution"),
        ("--map-mode", "output.map_mode"),
        ("--map-state", "output.map_state"),
        ("--min-range", "read.min_range"),
        ("--zero-means", "read.zero_means"),
    ],
)
def test_defaults_shown_are_those_of_the_options(flag, option):
    (one,) = [one for one in iter_options(Options()) if one.name == option]
    shown = re.search(r"\(default: (\S+)\)", action("map", flag).help)[1]
    assert type(one.default)(shown) == one.default


def test_defaults_of_scores():
    assert action("eval relations", "--max-dt").default == MAX_DT


def test_every_scene_is_listed():
    listed = ALL["simulate"].epilog.partition("\n\n")[0]
    for name in SCENES:
        if not name.endswith("-empty"):
            assert re.search(rf"^  {name} ", listed, re.MULTILINE)
