"""Suggestions for bad calls; reports of defects."""

import pytest

from stillmap.cli.main import main
from stillmap.cli.parser import COMMANDS
from stillmap.core.errors import InputError, MissingExtra, import_extra


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
        (("mpa",), "invalid choice: 'mpa'", "'map'"),
        (("eval", "lables"), "invalid choice: 'lables'", "'labels'"),
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


@pytest.mark.parametrize("group", ["io", "mesh", "viewer"])
def test_missing_extra_names_the_command_that_adds_it(group):
    with pytest.raises(MissingExtra, match="needs absent_library to be read") as caught:
        import_extra("absent_library.part", "some.file", group=group)
    assert f"pip install '.[{group}]'" in caught.value.hint
