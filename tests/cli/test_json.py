"""`--json`: one strict JSON object on stdout, nothing after an error."""

import json
import math

import pytest

from stillmap.cli.console import print_json
from stillmap.core.config import iter_options
from stillmap.pipeline.options import Options


def no_constant(text: str) -> None:
    raise AssertionError(f"{text} is no JSON")


def parsed(done) -> dict:
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout, parse_constant=no_constant)
    assert isinstance(found, dict)
    return found


@pytest.fixture(scope="module")
def mapped(stillmap, room, tmp_path_factory):
    out = tmp_path_factory.mktemp("mapped") / "out"
    words = ("--set", "em.max_iterations=1", "--no-odometry", "--json")
    return out, stillmap("map", room, "-o", out, *words)


def test_map(mapped):
    out, done = mapped
    found = parsed(done)
    record = json.loads((out / "run.json").read_text())
    assert found["output"] == str(out)
    assert {"map.pgm", "run.json", "report.html", "beams/p_static.npy"} <= set(found["files"])
    assert all((out / name).is_file() for name in found["files"])
    assert found["iterations"] == len(record["iterations"]) == 1
    for key in ("counts", "converged", "best_iteration", "warnings", "seconds", "area"):
        assert found[key] == record[key], key
    assert any("no odometry" in warning for warning in found["warnings"])
    # what people read goes on on stderr
    assert "iteration 1/1" in done.stderr
    assert "report.html" in done.stderr


def test_config(call):
    found = parsed(call("config", "--json", "--set", "em.prior=0.75"))
    assert list(found) == [one.name for one in iter_options(Options())]
    assert found["em.prior"] == {
        "value": 0.75,
        "default": Options().em.prior,
        "type": "float",
        "choices": None,
        "range": "more than 0 and less than 1",
        "doc": "Prior probability p(c = 1) that a beam is static.",
    }
    assert found["read.max_range"]["type"] == "float or unset"
    assert found["output.map_state"]["choices"] == ["last", "majority", "open", "shut"]
    assert all(one["doc"] for one in found.values())
    odometry = parsed(call("config", "slam.odometry", "--json"))
    assert set(odometry) == {name for name in found if name.startswith("slam.odometry.")}


def test_non_finite_becomes_null(capsys):
    print_json({"a": [math.nan, math.inf, 1.5], "b": {"c": -math.inf}})
    assert capsys.readouterr().out == '{"a": [null, null, 1.5], "b": {"c": null}}\n'
