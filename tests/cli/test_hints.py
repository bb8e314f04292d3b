"""Suggestions for bad calls; reports of defects."""

import json
import logging
import os
import shlex
import subprocess
import sys
from importlib.metadata import PackageNotFoundError

import pytest

from stillmap.cli.main import main
from stillmap.cli.parser import COMMANDS
from stillmap.core.errors import (
    InputError,
    MissingExtra,
    closest_match,
    import_extra,
    install_command,
)


def refusal(capsys, *words: object) -> str:
    try:
        status = main([str(word) for word in words])
    except SystemExit as left:
        status = left.code
    out, err = capsys.readouterr()
    assert (status, out) == (2, "")
    assert err.count("\n") == 1
    assert err.startswith("stillmap")
    return err


@pytest.mark.parametrize(
    ("words", "said", "meant"),
    [
        (("mpa",), "unknown command 'mpa'", "'map'"),
        (("MAP",), "unknown command 'MAP'", "'map'"),
        (("eval", "lables"), "unknown score 'lables'", "'labels'"),
        (("--verison",), "--verison", "'--version'"),
        (("map", "log", "-o", "out", "--resoluton", "1"), "--resoluton", "'--resolution'"),
        (("map", "--resoluton=1"), "--resoluton=1", "'--resolution'"),
        (("map", "log", "-o", "out", "--estimator", "trakcer"), "'trakcer'", "'tracker'"),
        (("simulate", "hal", "-o", "out"), "'hal'", "'hall'"),
        (("config", "em.time"), "'em.time'", "'em.time_bin'"),
        (("config", "--set", "resolution=1"), "'resolution'", "'slam.resolution'"),
        (("config", "--set", "loops=false"), "'loops'", "'slam.loop_closure'"),
    ],
)
def test_suggestions(capsys, words, said, meant):
    message = refusal(capsys, *words)
    assert said in message
    assert meant in message


@pytest.mark.parametrize(
    "words", [("zzzz",), ("map", "log", "-o", "out", "--zzzz"), ("map", "a", "b", "-o", "out")]
)
def test_no_suggestion_without_similar_name(capsys, words):
    assert "did you mean" not in refusal(capsys, *words)


@pytest.mark.parametrize(
    ("assignment", "said"),
    [
        ("em.prior.x=1", "'em.prior' is a value, not a section"),
        ("em=1", "'em' is a section, not a value"),
        ("slam=1", "'slam' is a section, not a value"),
        ("em.prior=[1]", "'em.prior' must be a valid number, got [1]"),
        ("em.prior=2020-01-01", "'em.prior' must be a valid number"),
        ("threads=1.5", "'threads' must be a valid integer, got 1.5"),
        ("em..prior=1", "unknown option 'em.'"),
        ("em.prior=1\nthreads=2", "'em.prior' must be a valid number"),
    ],
)
def test_invalid_options(capsys, assignment, said):
    assert said in refusal(capsys, "config", "--set", assignment)


def test_error_for_multiline_flag_is_one_line(capsys):
    refusal(capsys, "map", "log", "-o", "out", "--a\nb")
    refusal(capsys, "info", "no\nsuch\nfile")


def test_similar_file_name_is_suggested(capsys, tmp_path):
    (tmp_path / "walk.log").write_text("")
    (tmp_path / "options.toml").write_text("")
    meant = f"did you mean '{tmp_path / 'walk.log'}'?"
    for words in (("info",), ("map", "-o", tmp_path / "out")):
        assert meant in refusal(capsys, *words, tmp_path / "walk.lgo")
    config = refusal(capsys, "config", "--config", tmp_path / "option.toml")
    assert f"did you mean '{tmp_path / 'options.toml'}'?" in config
    # who mistypes a path does not ask what else could be read
    message = refusal(capsys, "info", tmp_path / "quite-another")
    assert message.strip().endswith("quite-another: does not exist")
    assert "did you mean" not in refusal(capsys, "info", tmp_path / "no/such/walk.log")
    # names that stillmap gives are no slips of the pen
    (tmp_path / "ran.json").write_text("")
    message = refusal(capsys, "filter", tmp_path, "-o", tmp_path / "out")
    assert "did you mean" not in message


@pytest.mark.parametrize(
    "words",
    [
        ("map", "log", "--overwrite", "-o", ""),
        ("map", "log", "--overwrite", "--output="),
        ("info", ""),
        ("config", "--config", ""),
    ],
)
def test_empty_argument_is_refused(capsys, tmp_path, monkeypatch, words):
    (tmp_path / "mine").write_text("mine")
    monkeypatch.chdir(tmp_path)
    assert "an argument is empty" in refusal(capsys, *words)
    assert (tmp_path / "mine").read_text() == "mine"


def test_closest_match():
    assert closest_match("resoluton", ["paper", "resolution"]) == "resolution"
    assert closest_match("PAPER", ["paper"]) == "paper"
    assert closest_match("xyz", ["paper"]) is None
    assert closest_match("xyz", ["paper"], min_similarity=0.0) == "paper"
    assert closest_match("x", []) is None


def test_no_command_lists_commands(stillmap):
    done = stillmap()
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("usage: stillmap ")
    assert "the main job" in done.stderr
    assert len(done.stderr.splitlines()) < 20


def test_defect_is_reported_after_its_trace(command):
    program = (
        "import sys, stillmap.cli.config as c\n"
        "def fail(args): raise RuntimeError('ours')\n"
        "c.run = fail\n"
        "from stillmap.cli.main import main\n"
        "sys.exit(main(['config']))\n"
    )
    done = subprocess.run([command[0], "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (1, "")
    *trace, last = done.stderr.splitlines()
    assert trace[0].startswith("Traceback")
    assert trace[-1] == "RuntimeError: ours"
    assert last.startswith("stillmap: this is a defect of stillmap")


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (MemoryError("Unable to allocate 7 GiB"), 2, "not enough memory: Unable to allocate 7 GiB"),
        (MemoryError(), 2, "not enough memory"),
        (FileNotFoundError(2, "No such file", "/some/file"), 2, "/some/file: No such file"),
        (InputError("is odd", where="log:3", hint="mend it"), 2, "log:3: is odd (mend it)"),
    ],
)
def test_system_errors_are_one_line(monkeypatch, capsys, error, status, said):
    def fail(_):
        raise error

    monkeypatch.setattr("stillmap.cli.config.run", fail)
    monkeypatch.setattr("stillmap.cli.main._drop_stdout", lambda: None)
    assert main(["config"]) == status
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"stillmap: {said}")
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "verbose", "quiet"),
    [
        (("config",), False, False),
        (("-v", "config"), True, False),
        (("config", "-v"), True, False),
        (("--quiet", "config", "--verbose"), True, True),
        (("config", "--quiet"), False, True),
        (("--quiet", "map", "in", "-o", "out"), False, True),
        (("map", "in", "-o", "out", "--quiet"), False, True),
        (("-v", "eval", "labels", "a", "b"), True, False),
        (("eval", "-v", "labels", "a", "b"), True, False),
        (("eval", "labels", "a", "b", "-v"), True, False),
    ],
)
def test_verbose_and_quiet_anywhere(monkeypatch, words, verbose, quiet):
    got = []
    for name in ("config", "map", "eval"):
        monkeypatch.setattr(f"stillmap.cli.{name}.run", lambda args: got.append(args) or 0)
    assert main(list(words)) == 0
    assert (got[0].verbose, got[0].quiet) == (verbose, quiet)


def test_verbose_prints_more_to_stderr(monkeypatch, capsys):
    def run(_):
        logging.getLogger("stillmap.pipeline.result").info("iteration %d", 3)
        return 0

    monkeypatch.setattr("stillmap.cli.config.run", run)
    main(["config"])
    assert capsys.readouterr() == ("", "")
    main(["-v", "config"])
    assert capsys.readouterr() == ("", "stillmap: iteration 3\n")


CALLS = [
    ("map", "in", "-o", "out"),
    ("info", "in"),
    ("view", "out"),
    ("merge", "in", "in2", "-o", "out"),
    ("fleet", "in", "-o", "out"),
    ("live", "-o", "out"),
    ("filter", "out", "-o", "clean"),
    ("convert", "in", "-o", "out"),
    ("simulate", "hall", "-o", "out"),
    ("eval", "labels", "out", "sim"),
    ("config",),
]


@pytest.mark.parametrize("words", CALLS, ids=lambda words: words[0])
def test_ctrl_c_in_any_command(monkeypatch, capsys, words):
    def run(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(f"stillmap.cli.{words[0]}.run", run)
    assert main(list(words)) == 130
    assert capsys.readouterr() == ("", "stillmap: interrupted, nothing was half-written\n")


def test_every_command_has_a_call():
    assert {words[0] for words in CALLS} == set(COMMANDS)


class Origin:
    """A distribution of which only its direct_url.json is read."""

    def __init__(self, text):
        self.text = text

    def read_text(self, name):
        assert name == "direct_url.json"
        return self.text


@pytest.fixture
def installed_from(monkeypatch):
    """Pretend that the package was installed from a URL (None: an index), beside no pip."""
    monkeypatch.setenv("PATH", "/nowhere")

    def pretend(record):
        text = None if record is None else json.dumps(record)
        monkeypatch.setattr("importlib.metadata.distribution", lambda _name: Origin(text))

    return pretend


def wanted(command):
    """What a pip command installs; it runs in this interpreter."""
    *pip, install, requirement = shlex.split(command)
    assert (pip, install) == ([sys.executable, "-m", "pip"], "install")
    return requirement


@pytest.mark.parametrize("group", ["io", "mesh", "viewer"])
def test_missing_extra_names_the_clone_it_was_installed_from(installed_from, tmp_path, group):
    clone = tmp_path / "a clone"
    clone.mkdir()
    installed_from({"url": clone.as_uri(), "dir_info": {}})
    with pytest.raises(MissingExtra, match="needs absent_library to be read") as caught:
        import_extra("absent_library.part", "some.file", group=group)
    assert wanted(caught.value.hint) == f"{clone}[{group}]"


def test_extra_of_a_wheel_is_installed_from_the_wheel(installed_from, tmp_path):
    wheel = tmp_path / "stillmap-0.1.0-py3-none-any.whl"
    installed_from({"url": wheel.as_uri(), "archive_info": {}})
    # a wheel that is gone cannot be installed from
    assert wanted(install_command("io")) == "stillmap[io]"
    wheel.write_bytes(b"")
    assert wanted(install_command("io")) == f"stillmap[io] @ {wheel.as_uri()}"


def test_extra_from_index_and_repository(installed_from):
    installed_from(None)
    assert wanted(install_command("mesh")) == "stillmap[mesh]"
    url = "https://example.org/stillmap.git"
    installed_from({"url": url, "vcs_info": {"vcs": "git", "commit_id": "abc"}})
    assert wanted(install_command("mesh")) == f"stillmap[mesh] @ git+{url}@abc"


def test_extra_of_sources_that_are_not_installed(monkeypatch, tmp_path):
    def missing(name):
        raise PackageNotFoundError(name)

    monkeypatch.setattr("importlib.metadata.distribution", missing)
    module = tmp_path / "src/stillmap/core/errors.py"
    monkeypatch.setattr("stillmap.core.errors.__file__", str(module))
    assert shlex.split(install_command("viewer"))[-1] == "stillmap[viewer]"
    (tmp_path / "pyproject.toml").write_text("")
    assert shlex.split(install_command("viewer"))[-1] == f"{tmp_path}[viewer]"


def test_pip_of_the_environment_is_named_briefly(monkeypatch, tmp_path):
    pip = tmp_path / "pip"
    pip.write_text("#!/bin/sh\n")
    pip.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert install_command("io").startswith(f"{shlex.quote(sys.executable)} -m pip install ")
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    assert install_command("io").startswith("pip install ")


@pytest.mark.slow
def test_command_for_the_viewer_works_here():
    """Nothing is fetched: pip resolves this installation's own origin, without dependencies."""
    flags = ["--dry-run", "--no-deps", "--no-index", "--no-build-isolation", "--quiet"]
    words = [*shlex.split(install_command("viewer")), *flags]
    environment = {**os.environ, "PIP_DISABLE_PIP_VERSION_CHECK": "1"}
    done = subprocess.run(words, capture_output=True, text=True, env=environment, timeout=300)
    assert done.returncode == 0, done.stderr
