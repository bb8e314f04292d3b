"""Files that are read are opened by `stillmap.core.input_files` alone: everything else would wait
for a pipe, follow a device without end, or map a file into memory that may become shorter."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import stillmap

PACKAGE = Path(stillmap.__file__).parent
OWNER = "core/input_files.py"

# what opens files by name, and is given none of the user's: (module, function), and the reason
ALLOWED = {
    ("core/arrays.py", "mmap.mmap"): "unlinked files of our own",
    ("core/arrays.py", "os.open"): "a new file without a name",
    ("core/arrays.py", "zipfile.ZipFile"): "a new file",
    ("core/arrays.py", "open"): "a part of a new archive",
    ("core/array_folder.py", "np.load"): "an open InputFile",
    ("core/memory.py", "read_text"): "what the system says of memory",
    ("core/extras.py", "read_text"): "the metadata of the package",
    ("cli/main.py", "os.open"): "the null device",
    ("cli/console.py", "os.open"): "the null device",
    ("core/files.py", "os.open"): "sync of what was written",
    ("core/output_place.py", "read_bytes"): "where something is mounted",
    ("core/publishing.py", "os.open"): "locks of unfinished work, without blocking",
    ("core/publishing.py", "open"): "a finished file, which goes to its place",
    ("core/publishing.py", "shutil.copytree"): "a finished folder, which goes to its place",
    ("core/locks.py", "os.open"): "locks, without blocking",
    ("cli/view.py", "open"): "a browser",
    ("live/drive_folder.py", "os.open"): "a folder of our own",
    ("live/drive_folder.py", "open"): "after require_regular",
    ("fleet/child.py", "open"): "a pipe of our own",
    ("fleet/storage.py", "open"): "the journal, which is appended to under a lock",
    ("results/export/bag.py", "open"): "a writer of bags",
    ("results/points.py", "open"): "a cloud of our own, in an unfinished folder",
    ("results/saved.py", "shutil.copytree"): "by copy_file",
    ("results/export/rrd.py", "open"): "a pipe of our own",
    ("results/report/page.py", "read_text"): "a template of the package",
    ("io/images.py", "Image.open"): "an open InputFile",
    ("io/ros/image.py", "Image.open"): "bytes",
    ("io/ros/limits.py", "zstd.open"): "an open InputFile",
    ("io/ros/limits.py", "sqlite3.connect"): "after require_regular",
    ("io/point_cloud/las.py", "laspy.open"): "an open InputFile, or a new file",
    ("eval/model_readers.py", "trimesh.load_scene"): "bytes",
    ("results/export/obj.py", "trimesh.load_scene"): "bytes",
}
METHODS = {"read_text", "read_bytes"}  # of paths
FUNCTIONS = {
    *("open", "io.open", "os.open", "gzip.open", "zstd.open", "Image.open", "laspy.open"),
    *("bz2.open", "lzma.open", "tarfile.open", "zipfile.ZipFile", "sqlite3.connect"),
    *("np.load", "np.loadtxt", "np.genfromtxt", "np.fromfile", "np.memmap", "mmap.mmap"),
    *("np.lib.format.open_memmap", "trimesh.load", "trimesh.load_scene", "trimesh.load_mesh"),
    *("shutil.copy", "shutil.copy2", "shutil.copyfile", "shutil.copytree", "pickle.load"),
}
BARE = {"loadtxt", "fromfile", "memmap", "open_memmap"}  # imported by their own name


def reads(call: ast.Call) -> str | None:
    """The name of what opens a file to read it in a call; None: nothing does."""
    name = ast.unparse(call.func)
    last = name.rpartition(".")[2]
    is_method = isinstance(call.func, ast.Attribute)
    if is_method and last in METHODS:
        return last
    if name == "np.loadtxt" and not isinstance(call.args[0], ast.Constant):
        return None if ast.unparse(call.args[0]) == "taken" else name  # lines in memory
    if name in FUNCTIONS - {"open"} or name in BARE:
        return name
    if last != "open" or (is_method and not call.args and not call.keywords):
        return None  # `reader.open()` of a library, which has its path already
    mode = call.args[0 if is_method else 1 :][:1]
    mode += [one.value for one in call.keywords if one.arg == "mode"]
    text = mode[0].value if mode and isinstance(mode[0], ast.Constant) else "r"
    is_mode = isinstance(text, str) and set(text) <= set("rwxabt+")
    return "open" if is_mode and text[0] in "ra" and set(text) & set("r+") else None


def found_in(source: str) -> Iterator[tuple[int, str]]:
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and (name := reads(node)):
            yield node.lineno, name


def test_only_one_module_opens_files_that_are_read():
    others = [
        f"{module}:{line}: {name}"
        for path in sorted(PACKAGE.rglob("*.py"))
        if (module := path.relative_to(PACKAGE).as_posix()) != OWNER
        for line, name in found_in(path.read_text(encoding="utf-8"))
        if (module, name) not in ALLOWED
    ]
    assert others == []


def test_what_is_allowed_is_there():
    there = {
        (module, name)
        for module in {module for module, _ in ALLOWED}
        for _, name in found_in((PACKAGE / module).read_text(encoding="utf-8"))
    }
    assert there == set(ALLOWED)


@pytest.mark.parametrize(
    "line",
    [
        "open(path)",
        "open(path, 'rb')",
        "path.open('rb')",
        "path.open(mode='rb')",
        "path.read_bytes()",
        "np.load(path)",
        "np.fromfile(path, '<f4')",
        "Image.open(path)",
        "shutil.copy2(a, b)",
        "open(path, 'a+b')",
    ],
)
def test_reading_is_found(line):
    assert list(found_in(line))


@pytest.mark.parametrize("line", ["path.open('wb')", "open(path, 'xb')", "reader.open()"])
def test_writing_is_not_reading(line):
    assert not list(found_in(line))
