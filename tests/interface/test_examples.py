"""Examples of the documentation: their types are right, and those of the main job run."""

import ast
import builtins
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import stillmap
from stillmap.cli.main import main

ROOT = Path(__file__).resolve().parents[2]
# the laboratory quotes code as it was when its figures were measured
PAGES = [
    page
    for page in sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/**/*.md")])
    if "lab" not in page.relative_to(ROOT).parts
]


def blocks(page):
    return re.findall(r"^```python\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)


def undefined(code):
    """Names that the text around an example explains."""
    names = [node for node in ast.walk(ast.parse(code)) if isinstance(node, ast.Name)]
    stored = {node.id for node in names if not isinstance(node.ctx, ast.Load)}
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.alias):
            stored.add(node.asname or node.name.partition(".")[0])
        elif isinstance(node, ast.FunctionDef | ast.ClassDef | ast.ExceptHandler) and node.name:
            stored.add(node.name)
    return sorted({node.id for node in names} - stored - set(dir(builtins)))


def check_types(folder, *files):
    """What mypy says to programs that use the package as it is imported here."""
    pytest.importorskip("mypy")
    parent = Path(stillmap.__file__).parents[1]
    path = {} if "site-packages" in parent.parts else {"MYPYPATH": str(parent)}
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--config-file=", "--ignore-missing-imports", *files],
        env={**os.environ, **path, "MYPY_CACHE_DIR": str(folder / "cache")},
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    return [line for line in (done.stdout + done.stderr).splitlines() if ": error:" in line]


@pytest.mark.slow  # mypy reads the whole package
def test_examples_have_the_right_types(tmp_path):
    files = []
    for page in PAGES:
        code = "\n".join(blocks(page))
        if not code:
            continue
        given = "".join(f"{name}: Any\n" for name in undefined(code))
        files.append(f"{page.relative_to(ROOT)}".replace("/", "_").replace("-", "_")[:-3] + ".py")
        (tmp_path / files[-1]).write_text(f"from typing import Any\n\n{given}\n{code}")
    assert len(files) > 5
    assert check_types(tmp_path, *files) == []
    wrong = "import stillmap\nstillmap.build('log.bag', resolution='fine').plott()\n"
    (tmp_path / "wrong.py").write_text(wrong)
    found = check_types(tmp_path, "wrong.py")
    assert sorted(line.rpartition(" ")[2] for line in found) == ["[arg-type]", "[attr-defined]"]


def write_inputs(folder, where):
    """The files that the examples read, in the present folder."""
    assert main(["convert", str(folder), "-o", "log.bag", "--quiet"]) == 0
    (where / "hall").symlink_to(folder)
    read = stillmap.read(folder)
    n = read.n_beams // read.n_scans
    points = read.points.reshape(read.n_scans, n, 2)
    x, y = read.T_odom_base[:, :2, 2].T
    np.savez(
        where / "scans.npz",
        stamps=1e-9 * read.stamp_ns,
        ranges=np.linalg.norm(points, axis=2),
        angles=np.arctan2(points[0, :, 1], points[0, :, 0]),
        odometry=np.stack([x, y, np.arctan2(*read.T_odom_base[:, 1::-1, 0].T)], axis=1),
    )


@pytest.mark.slow
@pytest.mark.parametrize("page", ["README.md", "docs/python.md"])
def test_examples_of_the_main_job_run(page, folder, tmp_path, monkeypatch):
    pytest.importorskip("pandas")
    pytest.importorskip("matplotlib").use("Agg")
    monkeypatch.chdir(tmp_path)
    write_inputs(folder, tmp_path)
    values = {**np.load("scans.npz"), "cloud_0": np.ones((40, 3)), "cloud_1": np.eye(3)}
    for block in blocks(ROOT / page)[:2]:  # further ones need a 3D recording, and other days
        exec(compile(block, page, "exec"), values)
    assert len(list(tmp_path.glob("*/map.pgm"))) == 1
    if page == "docs/python.md":
        assert values["recording"].n_scans == len(values["stamps"])
        assert values["clouds"].n_beams == 43
