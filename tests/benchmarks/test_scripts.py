"""Every benchmark imports against the current package, and prints its help."""

import importlib
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"
# workers run in environments of other programs
SCRIPTS = sorted(path.stem for path in FOLDER.glob("*.py") if not path.stem.endswith("_worker"))


@pytest.mark.parametrize("name", SCRIPTS)
def test_script(name, monkeypatch, capsys):
    if name in ("pasted", "pasted_scores"):
        pytest.importorskip("PIL")
    module = importlib.import_module(name)
    if hasattr(module, "main"):
        monkeypatch.setattr(sys, "argv", [f"{name}.py", "--help"])
        with pytest.raises(SystemExit) as stopped:
            module.main()
        assert stopped.value.code == 0
        assert "usage:" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["poses", "holding"])
def test_constants_that_variants_replace_are_there(name):
    full_path = importlib.import_module("poses").full_path
    for variant in importlib.import_module(name).ABLATION:
        for path, value in variant.constants.items():
            module, _, constant = full_path(path).rpartition(".")
            stands = getattr(importlib.import_module(module), constant)
            assert isinstance(stands, tuple) == isinstance(value, tuple), path
