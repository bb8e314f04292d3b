"""`stillmap config`, and the precedence of options: default < file < --set < flag."""

import json
import math
import tomllib
from dataclasses import asdict

import pytest

from stillmap.cli.arguments import options_from_args
from stillmap.cli.console import print_json
from stillmap.cli.main import main
from stillmap.cli.parser import parser
from stillmap.core.config import iter_options
from stillmap.pipeline.options import Options


def config(capsys, *words: object) -> str:
    assert main(["config", *map(str, words)]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    return out


def refusal(capsys, *words: object) -> str:
    assert main(["config", *map(str, words)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    return err


def without_none(options: dict) -> dict:
    return {
        key: without_none(value) if isinstance(value, dict) else value
        for key, value in options.items()
        if value is not None
    }


def test_prints_every_option_with_its_default(capsys):
    assert tomllib.loads(config(capsys)) == without_none(asdict(Options()))


def test_config_takes_its_own_output_unchanged(capsys, tmp_path):
    chosen = ("--set", "em.prior=0.75", "--set", "read.max_range=20", "--set", "threads=3")
    file = tmp_path / "options.toml"
    file.write_text(config(capsys, *chosen))
    assert config(capsys, "--config", file) == file.read_text()
    assert tomllib.loads(file.read_text())["em"]["prior"] == 0.75


def test_set_overrides_file_and_last_set_counts(capsys, tmp_path):
    file = tmp_path / "options.toml"
    file.write_text("threads = 5\n[em]\nprior = 0.6\nmax_iterations = 9\n")
    sets = ("--set", "em.prior=0.7", "--set", "em.prior=0.8")
    for words in (("--config", file, *sets), (*sets, "--config", file)):
        options = tomllib.loads(config(capsys, *words))
        assert options["threads"] == 5
        assert options["em"]["prior"] == 0.8
        assert options["em"]["max_iterations"] == 9
        assert options["em"]["patience"] == Options().em.patience


def test_precedence(capsys, tmp_path, room):
    """Default < file < --set < flag, one step at a time."""
    file = tmp_path / "options.toml"
    file.write_text("[slam]\nresolution = 0.4\n")
    steps = ["--config", file], ["--set", "slam.resolution=0.3"], ["--resolution", 0.2]
    for n, wanted in enumerate((0.05, 0.4, 0.3, 0.2)):
        out = tmp_path / f"out{n}"
        given = [word for step in steps[:n] for word in step]
        words = ["map", room, "-o", out, "--quiet", "--set", "em.max_iterations=1", *given]
        assert main([*map(str, words)]) == 0
        options = json.loads((out / "run.json").read_text())["options"]
        assert options["slam"]["resolution"] == wanted
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("words", ["map in", "merge in", "fleet in", "live"])
def test_resolution_is_a_flag_of_all_that_map(words):
    words = [*words.split(), "-o", "out", "--resolution", "0.2"]
    slam = options_from_args(parser([words[0]]).parse_args(words)).slam
    assert slam.resolution == slam.voxel_size == 0.2


@pytest.mark.parametrize(
    ("key", "nearest"),
    [
        ("em.priors", "em.prior"),
        ("em.max_iteration", "em.max_iterations"),
        ("slam.odometry.rotation_per_metr", "slam.odometry.rotation_per_metre"),
        ("thread", "threads"),
    ],
)
def test_unknown_option_suggests_the_nearest(capsys, tmp_path, key, nearest):
    assert refusal(capsys, "--set", f"{key}=1") == (
        f"stillmap: --set: unknown option '{key}' (nearest: '{nearest}')\n"
    )
    file = tmp_path / "options.toml"
    *sections, name = key.split(".")
    file.write_text((f"[{'.'.join(sections)}]\n" if sections else "") + f"{name} = 1\n")
    assert refusal(capsys, "--config", file) == (
        f"stillmap: {file}: unknown option '{key}' (nearest: '{nearest}')\n"
    )


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--set", "em.prior=2"), ("--set: ", "em.prior")),
        (("--set", "em.prior=high"), ("--set: ", "em.prior", "'high'")),
        (
            ("--set", "em.time_bin=0"),
            ("--set: ", "'em.time_bin' must be at least 0.01 and at most 3600"),
        ),
        (("--set", "em.time_bin=nan"), ("--set: ", "em.time_bin", "finite")),
        (("--set", "em.label_tolerance=2"), ("--set: ", "em.label_tolerance", "at most 1")),
        (("--set", "em.held_out=1"), ("--set: ", "em.held_out", "0, or at least 2")),
        (
            ("--set", "em.change_detection=perhaps"),
            ("--set: ", "change_detection", "true or false"),
        ),
        (("--set", "output.map_state=first"), ("--set: ", "output.map_state", "majority")),
        (("--set", "estimator=guess"), ("--set: ", "estimator", "hit-ratio")),
        (("--set", "em=1"), ("--set: ", "'em' is a section")),
        (("--set", "em.prior"), ("section.key=value",)),
        (("--config", "/nowhere/options.toml"), ("/nowhere/options.toml: cannot be read",)),
    ],
)
def test_wrong_value_names_its_source(capsys, words, said):
    message = refusal(capsys, *words)
    for part in said:
        assert part in message


def test_as_json(capsys):
    found = json.loads(config(capsys, "--json", "--set", "em.prior=0.75"))
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
    odometry = json.loads(config(capsys, "slam.odometry", "--json"))
    assert set(odometry) == {name for name in found if name.startswith("slam.odometry.")}


def test_non_finite_becomes_null(capsys):
    print_json({"a": [math.nan, math.inf, 1.5], "b": {"c": -math.inf}})
    assert capsys.readouterr().out == '{"a": [null, null, 1.5], "b": {"c": null}}\n'
