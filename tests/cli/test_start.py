"""Quick start: slow imports happen in the commands that need them."""

import subprocess

HEAVY = {
    "numpy",
    "scipy",
    "matplotlib",
    "gtsam",
    "rich",
    "PIL",
    "yaml",
    "stillmap.pipeline.em_loop",
}

PROGRAM = """
import contextlib, io, sys
from stillmap.cli.main import main
for words in {calls!r}:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        main(words)
    loaded = {heavy!r} & set(sys.modules)
    assert not loaded, (words, loaded)
"""


def test_help_version_load_nothing_heavy(command):
    calls = [["--version"], ["--help"]]
    calls += [["info", "--help"], ["simulate", "--help"], ["eval", "map", "--help"]]
    calls += [["view", "--help"], ["filter", "--help"], ["convert", "--help"]]
    program = PROGRAM.format(calls=calls, heavy=HEAVY)
    done = subprocess.run([command[0], "-c", program], capture_output=True, text=True, timeout=60)
    assert done.stderr == ""
    assert done.returncode == 0


def test_package_loads_names_on_use(command):
    program = (
        "import sys, stillmap\n"
        "assert 'numpy' not in sys.modules\n"
        "assert set(stillmap.__all__) <= set(dir(stillmap))\n"
        "assert stillmap.io.write and stillmap.InputError\n"
        "for name in stillmap.__all__: assert getattr(stillmap, name) is not None, name\n"
        "from stillmap import *\n"
        "assert Result.__name__ == 'Result'\n"
        "try: stillmap.nothing\n"
        "except AttributeError as error: assert 'nothing' in str(error)\n"
        "else: raise AssertionError\n"
    )
    done = subprocess.run([command[0], "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


def test_scipy_loads_on_call(command):
    program = (
        "import sys, stillmap.pipeline.result, stillmap.sim, stillmap.cli.eval\n"
        "late = {'scipy.sparse', 'scipy.spatial', 'scipy.ndimage', 'matplotlib', 'gtsam'}\n"
        "assert not late & set(sys.modules), late & set(sys.modules)\n"
    )
    done = subprocess.run([command[0], "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
