"""What an editor, `help` and `inspect` show of the package, whose parts load when first used."""

import inspect
import pydoc
import subprocess
import sys
from pathlib import Path

import pytest

import stillmap

CONSTRUCTORS = [stillmap.Recording.from_scans, stillmap.Recording.from_clouds]
CALLABLE = [name for name in stillmap.__all__ if name != "__version__"]


def test_every_name_is_there_and_listed():
    assert set(stillmap.__all__) <= set(dir(stillmap))
    assert [name for name in stillmap.__all__ if not hasattr(stillmap, name)] == []
    assert stillmap.__all__ == sorted(stillmap.__all__)
    with pytest.raises(AttributeError, match="no attribute 'buidl'"):
        stillmap.buidl  # noqa: B018


@pytest.mark.parametrize("name", CALLABLE)
def test_signature_and_help(name):
    value = getattr(stillmap, name)
    parameters = inspect.signature(value).parameters.values()
    assert all(one.kind is not one.VAR_KEYWORD for one in parameters)
    page = pydoc.plain(pydoc.render_doc(value))
    assert name in page.splitlines()[0] or name in page
    assert inspect.getdoc(value)
    assert "**kwargs" not in page.splitlines()[2]


@pytest.mark.parametrize(
    "function",
    [stillmap.build, stillmap.load, stillmap.read, *CONSTRUCTORS],
    ids=lambda function: function.__name__,
)
def test_a_signature_can_be_read(function):
    assert len(str(inspect.signature(function))) < 600


def test_build_says_what_it_takes():
    signature = inspect.signature(stillmap.build)
    assert list(signature.parameters)[:2] == ["recording", "options"]
    keywords = [p.name for p in signature.parameters.values() if p.kind is p.KEYWORD_ONLY]
    assert keywords == ["resolution", "odometry", "poses", "progress", "scratch"]


def test_an_editor_completes():
    jedi = pytest.importorskip("jedi")
    folder = str(Path(stillmap.__file__).parents[1])

    def script(text):
        project = jedi.Project(folder, added_sys_path=[folder])
        return jedi.Script(f"import stillmap\n{text}", project=project)

    [signature] = script("stillmap.build(").get_signatures()
    assert "resolution" in [one.name for one in signature.params]
    names = {one.name for one in script("stillmap.").complete()}
    assert set(stillmap.__all__) - {"__version__"} <= names
    for maker in ("build('a')", "load('a')"):
        names = {one.name for one in script(f"stillmap.{maker}.").complete()}
        assert {"map", "poses", "p_static", "objects", "plot", "save", "to_dataframe"} <= names
    names = {one.name for one in script("stillmap.Recording.").complete()}
    assert {"from_scans", "from_clouds"} <= names


def test_import_alone_loads_nothing():
    code = "import sys, stillmap; print('numpy' in sys.modules, 'stillmap.core' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]
