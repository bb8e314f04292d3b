"""Numbers in the files of a result: finite, or NaN where docs/output.md has it."""

import json
import math
import re

import numpy as np
import yaml

_MAY_BE_NAN = {"p_occupied", "p_static", "speed"}


def require_finite(folder):
    """Raises AssertionError or ValueError for the first number that is none."""
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            _CHECKS.get(path.suffix, _pass)(path)


def _pass(path):
    assert path.stat().st_size, path


def _json(path):
    def refuse(word):
        raise AssertionError(f"{path.name}: {word}")

    json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


def _array(name, array):
    if array.dtype.kind != "f":
        return
    bad = np.isinf(array) if name in _MAY_BE_NAN else ~np.isfinite(array)
    assert not bad.any(), f"{name}: {array[bad][:3]}"


def _npy(path):
    _array(path.stem, np.load(path))


def _npz(path):
    with np.load(path) as file:
        for name, array in file.items():
            _array(name, array)


def _words(path):
    for word in path.read_text(encoding="utf-8").split():
        try:
            number = float(word)
        except ValueError:
            continue
        assert math.isfinite(number), path


def _yaml(path):
    json.dumps(yaml.safe_load(path.read_text(encoding="utf-8")), allow_nan=False)


def _ply(path):
    head, _, body = path.read_bytes().partition(b"end_header\n")
    types = {b"float": "<f4", b"double": "<f8", b"uchar": "u1", b"int": "<i4"}
    columns = re.findall(rb"property (\w+) (\w+)", head)
    rows = np.frombuffer(body, [(name.decode(), types[kind]) for kind, name in columns])
    assert len(rows) == int(re.findall(rb"element vertex (\d+)", head)[0])
    for name in rows.dtype.names or ():
        _array(f"{path.name} {name}", rows[name])


def _html(path):
    text = re.sub(r"<(script|style)\b.*?</\1>", "", path.read_text(encoding="utf-8"), flags=re.S)
    assert not re.search(r"(?i)>[^<>]*\b(nan|inf|infinity)\b[^<>]*<", text), path


_CHECKS = {
    ".json": _json,
    ".npy": _npy,
    ".npz": _npz,
    ".tum": _words,
    ".g2o": _words,
    ".yaml": _yaml,
    ".ply": _ply,
    ".html": _html,
}
