"""What files hold never reaches a terminal as control characters."""

import json
import logging
from pathlib import Path

import numpy as np
import pytest

from stillmap.cli.console import fail, print_lines, say
from stillmap.cli.main import main
from stillmap.core.errors import InputError, printable
from stillmap.core.recording import Recording
from stillmap.core.source import Source
from stillmap.io import stillmap_folder

EVIL = "a\x1b[31mred\x07\x1b]0;title\x07\x9b2J\u202eb\nc\r"
SHOWN = r"a\x1b[31mred\x07\x1b]0;title\x07\x9b2J\u202eb"
CONTROL = {*map(chr, range(32)), *map(chr, range(127, 160)), "\u202e"} - {"\n"}


def require_clean(text: str) -> None:
    assert not CONTROL & set(text)


@pytest.fixture
def evil_recording(tmp_path: Path) -> Path:
    """A recording whose name, texts and warnings hold control characters."""
    path = tmp_path / "a\x1b[2Jb"
    source = {
        "format": EVIL,
        "path": EVIL,
        "base_frame": EVIL,
        "base_frame_how": EVIL,
        "params": {EVIL: EVIL},
        "ignored": {EVIL: 2},
        "topics": [{"topic": EVIL, "type": EVIL, "messages": 1, "why": EVIL}],
        "sensors": [{"name": EVIL, "frame": EVIL}],
        "skipped": {EVIL: {"count": 1, "lines": [3]}},
        "warnings": [EVIL],
    }
    recording = Recording(
        stamp_ns=np.array([1, 10**9], np.int64),
        offset=np.array([0, 2, 4], np.int64),
        points=np.ones((4, 2), np.float32),
        hit=np.ones(4, bool),
        T_base_sensor=np.eye(3)[None],
        sensor=np.zeros(2, np.int32),
        T_odom_base=None,
        source=Source.from_dict(source),
    )
    stillmap_folder.write(recording, path)
    return path


def test_printable():
    assert printable(EVIL) == SHOWN + r"\nc\r"
    assert printable("Größe 3 µm, 日本語") == "Größe 3 µm, 日本語"
    assert str(InputError(EVIL)).startswith(SHOWN)


def test_each_way_to_the_terminal(capsys):
    say(EVIL)
    fail(EVIL)
    logging.getLogger("stillmap").warning(EVIL)
    print_lines([EVIL, EVIL])
    said = capsys.readouterr()
    require_clean(said.out + said.err)
    assert said.out.count(SHOWN) == 2


def test_what_is_in_a_recording(evil_recording, capsys):
    assert main(["info", str(evil_recording)]) == 0
    said = capsys.readouterr()
    require_clean(said.out + said.err)
    assert said.out.count(SHOWN) >= 8
    assert main(["info", str(evil_recording), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["warnings"] == [EVIL]
    assert found["base_frame"] == EVIL


@pytest.mark.parametrize(
    "words",
    [
        ["info", EVIL],
        ["info", f"--{EVIL}"],
        [EVIL],
        ["map", EVIL, "-o", EVIL],
        ["config", EVIL],
        ["config", "--set", f"read.topic='{EVIL}'"],
        ["eval", EVIL],
        ["simulate", EVIL, "-o", EVIL],
    ],
)
def test_words_of_the_command_line(words, capsys):
    try:
        status = main(words)
    except SystemExit as error:
        status = error.code
    assert status == (0 if "--set" in words else 2)
    said = capsys.readouterr()
    require_clean(said.out + said.err)
    assert len(said.err.splitlines()) == (status == 2)


def test_defects(monkeypatch, capsys):
    def fails(*_):
        raise RuntimeError(EVIL)

    monkeypatch.setattr("stillmap.cli.config.options_from_args", fails)
    assert main(["config"]) == 1
    require_clean(capsys.readouterr().err)


def test_result_that_is_mapped(evil_recording, capsys, tmp_path):
    status = main(["map", str(evil_recording), "-o", str(tmp_path / "o\x1b[2Jut"), "-v"])
    said = capsys.readouterr()
    require_clean(said.out + said.err)
    assert status in (0, 2)
