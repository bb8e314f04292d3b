"""Exit statuses, one-line errors, closed pipes."""

import os
import subprocess

import pytest

from stillmap.cli.main import main


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--quiet", "--frob"), "--frob"),
        (("chart",), "'chart'"),
        (("map",), "INPUT"),
        (("map", "log"), "--output"),
        (("map", "log", "-o"), "-o"),
        (("map", "log", "-o", "out", "--resolution", "fine"), "--resolution"),
        (("map", "log", "-o", "out", "--estimator", "guess"), "'guess'"),
        (("info", "--frobnicate", "x"), "--frobnicate"),
        (("eval",), "eval"),
        ((), "COMMAND"),
    ],
)
def test_bad_call_is_one_line(words, said, capsys):
    with pytest.raises(SystemExit) as left:
        main(list(words))
    out, err = capsys.readouterr()
    assert (left.value.code, out) == (2, "")
    assert err.startswith("stillmap")
    assert err.count("\n") == 1
    assert said in err
    assert "--help" in err


def test_reader_that_closes_early_is_no_error(stillmap, room):
    for words in (("info", room), ("info", room, "--json"), ("config",), ("--help",)):
        reader, writer = os.pipe()
        os.close(reader)  # as `| head -0`: gone before the first line
        try:
            done = stillmap(*words, capture_output=False, stdout=writer, stderr=subprocess.PIPE)
        finally:
            os.close(writer)
        assert (done.returncode, done.stderr) == (0, ""), words


def test_closed_streams_are_no_error(room, command):
    quoted = " ".join(command)
    for redirection in (">&-", "2>&-", ">&- 2>&-"):
        done = subprocess.run(
            ["sh", "-c", f'{quoted} info "$1" {redirection}', "sh", str(room)],
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert (done.returncode, done.stderr) == (0, ""), redirection


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full here")
def test_full_disk_behind_stdout_is_one_line(stillmap):
    with open("/dev/full", "w") as full:
        done = stillmap("config", capture_output=False, stdout=full, stderr=subprocess.PIPE)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("stillmap: ")


def test_defect_exits_with_1(command):
    # not caught: the trace is what we want to be sent
    program = (
        "import sys, stillmap.cli.config as c\n"
        "def fail(args): raise RuntimeError('ours')\n"
        "c.run = fail\n"
        "from stillmap.cli.main import main\n"
        "sys.exit(main(['config']))\n"
    )
    done = subprocess.run([command[0], "-c", program], capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert "RuntimeError: ours" in done.stderr


@pytest.mark.parametrize(
    ("stop", "status", "said"),
    [
        (KeyboardInterrupt(), 130, "stillmap: interrupted, nothing was half-written\n"),
        (SystemExit(143), 143, ""),
    ],
)
@pytest.mark.parametrize("cause", [True, False])
def test_interrupt_behind_another_error(monkeypatch, capsys, stop, status, said, cause):
    # as Python does where a class is made: its names are set within a module that is imported
    def fail(_):
        try:
            raise stop
        except BaseException as error:
            if cause:
                raise RuntimeError("while a class was made") from error
            raise ValueError("while a file was closed")  # noqa: B904

    monkeypatch.setattr("stillmap.cli.config.run", fail)
    assert main(["config"]) == status
    assert capsys.readouterr() == ("", said)
