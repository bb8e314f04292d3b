"""Commands of README, quickstart and tutorials work: each page is run in an empty folder.

Blocks marked `sh` and `python` are run one after the other. Those marked `bash` or `text` are for
reading: they need a robot, or its files.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
PAGES = [ROOT / "docs" / "quickstart.md", *TUTORIALS, ROOT / "README.md"]
QUICK = {"README"}  # the others run in `make check`
BLOCK = re.compile(r"^```(sh|python)\n(.*?)^```", re.DOTALL | re.MULTILINE)
RUN = {"sh": ["bash", "-euo", "pipefail", "-c"], "python": [sys.executable, "-W", "error", "-c"]}


def blocks_of(page):
    return BLOCK.findall(page.read_text("utf-8"))


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=page.stem, marks=[] if page.stem in QUICK else [pytest.mark.slow])
        for page in PAGES
    ],
)
def test_page_runs(page, tmp_path):
    beside = Path(sys.executable).parent
    environment = {
        **os.environ,
        "MPLBACKEND": "Agg",
        "PATH": f"{beside}{os.pathsep}{os.environ['PATH']}",
    }
    blocks = blocks_of(page)
    assert blocks
    for language, text in blocks:
        done = subprocess.run(
            [*RUN[language], text],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, f"{text}\n{done.stdout}\n{done.stderr}"
