"""Modules that every command imports stay light: no NumPy."""

import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    "module", ["core.errors", "core.files", "core.config", "preprocessing.options", "cli.main"]
)
def test_numpy_is_not_imported(module):
    code = f"import sys, stillmap.{module}; print('numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
