"""Names of the package; its errors in the terms of Python, of the command line in the shell's."""

import dataclasses
import inspect
import sys

import numpy as np
import pytest

import stillmap
from stillmap.cli.main import main


def calls(built, folder, saved, tmp_path):
    """Calls that fail, by name."""
    gone = tmp_path / "gone"
    built.save(gone)
    record = (gone / "run.json").read_text()
    (gone / "run.json").write_text(record.replace(str(folder), str(tmp_path / "elsewhere")))
    sparse = dataclasses.replace(
        built.recording,
        points=np.zeros((built.recording.n_beams, 3), np.float32),
        T_base_sensor=np.eye(4)[None],
        T_odom_base=None,
    )
    return {
        "save where something is": lambda: built.save(saved),
        "copy where something is": lambda: stillmap.load(saved).save(saved.parent),
        "a recording that was moved": lambda: stillmap.load(gone).recording,
        "another recording": lambda: stillmap.load(saved, recording=sparse).recording,
        "no result": lambda: stillmap.load(folder),
        "nothing there": lambda: stillmap.build(tmp_path / "nothing.bag"),
        "no recording": lambda: stillmap.read(saved),
        "no poses": lambda: stillmap.build(folder, poses="recording"),
        "no trajectory": lambda: stillmap.build(folder, poses=tmp_path / "nothing.tum"),
        "an estimator for 2D": lambda: stillmap.build(sparse, {"estimator": "tracker"}),
        "an unknown option": lambda: stillmap.build(folder, {"em": {"priro": 1}}),
        "a value out of range": lambda: stillmap.build(folder, {"em.prior": 2.0}),
        "a section": lambda: stillmap.build(folder, {"em": 1}),
        "topics of a folder": lambda: stillmap.read(folder, stillmap.ReadOptions(topic="/scan")),
    }


def test_errors_are_in_the_terms_of_python(built, folder, saved, tmp_path):
    said = {}
    for name, call in calls(built, folder, saved, tmp_path).items():
        with pytest.raises(stillmap.InputError) as caught:
            call()
        said[name] = str(caught.value)
        assert "--" not in said[name], said[name]
        assert "\n" not in said[name]
    assert "overwrite=True" in said["save where something is"]
    assert "recording=PATH" in said["a recording that was moved"]
    assert "estimator=stillmap" in said["an estimator for 2D"]


def test_the_command_line_puts_its_flags_in_their_place(folder, saved, capsys):
    assert main(["map", str(folder), "-o", str(saved), "--quiet"]) == 2
    said = capsys.readouterr().err
    assert "--overwrite" in said
    assert "=True" not in said
    assert main(["map", str(folder), "-o", f"{saved}-2", "--poses", "recording", "--quiet"]) == 2
    assert "--poses FILE.tum gives them" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("module", "call"),
    [
        ("matplotlib.pyplot", lambda result: result.plot()),
        ("pandas", lambda result: result.to_dataframe()),
        ("pyarrow", lambda result: result.to_arrow()),
    ],
)
def test_a_missing_library_is_named(built, monkeypatch, module, call):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(stillmap.MissingExtra, match=r"pip install .*\[notebook\]"):
        call(built)


def test_every_name_is_there_and_listed():
    assert set(stillmap.__all__) <= set(dir(stillmap))
    assert [name for name in stillmap.__all__ if not hasattr(stillmap, name)] == []
    assert stillmap.__all__ == sorted(stillmap.__all__)
    with pytest.raises(AttributeError, match="no attribute 'buidl'"):
        stillmap.buidl  # noqa: B018


def test_build_says_what_it_takes():
    signature = inspect.signature(stillmap.build)
    assert list(signature.parameters)[:2] == ["recording", "options"]
    keywords = [p.name for p in signature.parameters.values() if p.kind is p.KEYWORD_ONLY]
    assert keywords == ["resolution", "odometry", "poses", "progress", "scratch"]
