"""Completion scripts, run in the shells."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from stillmap.cli.main import main

BASH = """
eval "$(stillmap completion bash)"
while IFS= read -r line; do
  COMP_LINE=$line COMP_POINT=${#line} COMP_TYPE=9 COMPREPLY=()
  _python_argcomplete stillmap
  printf '%s|' "${COMPREPLY[@]}"
  echo
done
"""
FISH = """
stillmap completion fish | source
while read -l line
  complete -C "$line" | string replace -r '\\t.*' '' | string join '|'
end
true
"""


@pytest.fixture
def place(tmp_path):
    """A folder with a log, a folder and options, to be in."""
    there = tmp_path / "place"
    (there / "out").mkdir(parents=True)
    for name in ("walk.log", "options.toml", "other.txt"):
        (there / name).write_text("")
    return there


@pytest.fixture
def ask(tmp_path, place):
    """Asks a shell how lines may go on: line to completions."""
    commands = tmp_path / "bin"
    commands.mkdir()
    # with these modules, whether they are installed or not
    (commands / "stillmap").write_text(f'#!/bin/sh\nexec "{sys.executable}" -m stillmap "$@"\n')
    (commands / "stillmap").chmod(0o755)
    package = Path(sys.modules["stillmap"].__file__).parents[1]
    environment = {
        "PATH": f"{commands}:{os.environ['PATH']}",
        "PYTHONPATH": str(package),
        "HOME": str(tmp_path),
    }

    def run(shell: list[str], script: str, lines: list[str]) -> dict[str, set[str]]:
        if shutil.which(shell[0]) is None:
            pytest.skip(f"no {shell[0]} here")
        (tmp_path / "script").write_text(script)
        done = subprocess.run(
            [*shell, tmp_path / "script"],
            input="".join(f"{line}\n" for line in lines),
            capture_output=True,
            text=True,
            timeout=120,
            cwd=place,
            env=environment,
        )
        assert done.returncode == 0, done.stderr
        answers = done.stdout.splitlines()
        assert len(answers) == len(lines), done.stdout
        found = [{word.strip() for word in one.split("|")} - {""} for one in answers]
        return dict(zip(lines, found, strict=True))

    return run


def test_bash(ask):
    names = {
        "map",
        "info",
        "live",
        "view",
        "merge",
        "fleet",
        "filter",
        "convert",
        "simulate",
        "eval",
        "config",
    }
    names |= {"completion"}
    wanted = {
        "stillmap ": names,
        "stillmap ma": {"map"},
        "stillmap -v ma": {"map"},
        "stillmap map --reso": {"--resolution"},
        "stillmap map walk.log --estimator ": {"stillmap", "paper", "hit-ratio", "tracker"},
        "stillmap map w": {"walk.log"},
        "stillmap map walk.log -o o": {"out/"},
        "stillmap map walk.log --config o": {"options.toml", "out/"},
        "stillmap map walk.log --set em.pri": {"em.prior="},
        "stillmap map walk.log --set em.time": {"em.time_bin="},
        "stillmap map walk.log --set slam.loop_closure=": {"true", "false"},
        "stillmap map walk.log --set output.map_mode=t": {"trinary"},
        "stillmap view ": {"out/"},
        "stillmap simulate office-m": {"office-moved", "office-moved-empty"},
        "stillmap simulate hall --set crowd.peo": {"crowd.people="},
        "stillmap eval ": {"relations", "trajectory", "labels", "map", "model", "sessions"},
        "stillmap eval trajectory a b --delta-unit f": {"frames"},
        "stillmap config em.time": {"em.time_bin"},
        "stillmap completion ": {"bash", "zsh", "fish"},
        "stillmap map walk.log --resolution ": set(),
    }
    assert ask(["bash", "--norc"], BASH, list(wanted)) == wanted


def test_bash_completes_sections_of_options(ask):
    (found,) = ask(["bash", "--norc"], BASH, ["stillmap map log --set "]).values()
    sections = {name.rpartition(".")[0] for name in found}
    assert {"", "em", "slam", "read", "objects", "output"} <= sections
    assert all(name.endswith("=") for name in found)


def test_fish(ask):
    wanted = {
        "stillmap ma": {"map"},
        "stillmap map --reso": {"--resolution"},
        "stillmap map w": {"walk.log"},
        "stillmap map walk.log --estimator t": {"tracker"},
        "stillmap map walk.log --set em.pri": {"em.prior="},
    }
    assert ask(["fish", "--no-config"], FISH, list(wanted)) == wanted


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_script_is_valid_for_its_shell(shell, capsys):
    assert main(["completion", shell]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert "stillmap" in out
    if shutil.which(shell) is None:
        pytest.skip(f"no {shell} here")
    done = subprocess.run([shell, "-n"], input=out, capture_output=True, text=True, timeout=30)
    assert (done.returncode, done.stderr) == (0, "")
