import dataclasses
import json
from pathlib import Path

import numpy as np

from stillmap.core.json import write_json
from stillmap.core.source import Source
from stillmap.results.run_json import run_record
from stillmap.slam.mount_calibration import Calibration, Parameter


def no_constant(name):
    raise AssertionError(f"{name} is not JSON")


def written(tmp_path, result):
    write_json(tmp_path / "run.json", run_record(result))
    text = (tmp_path / "run.json").read_text(encoding="utf-8")
    return json.loads(text, parse_constant=no_constant)


def test_the_keys_that_scripts_rely_on(tmp_path, result):
    run = written(tmp_path, result)
    assert list(run) == [
        "format_version",
        "version",
        "input",
        "options",
        "iterations",
        "converged",
        "best_iteration",
        "seconds",
        "cpu_seconds",
        "peak_memory_bytes",
        "counts",
        "area",
        "warnings",
        "quality",
        "learned",
        "calibration",
        "doubts",
        "changes",
        "doors",
        "loops",
    ]
    assert run["format_version"] == 1
    assert isinstance(run["version"], str)
    assert run["input"]["path"] == "logs/hall <1>.clf"
    assert run["options"]["em"] == {"prior": 0.9, "note": result.options.em.note, "seed": None}
    heights = {"min_obstacle_height": 0.2, "max_obstacle_height": 1.8}
    shown = {"map_mode": "trinary", "map_state": "last", "region": None, **heights}
    assert run["options"]["output"] == shown
    assert (run["converged"], run["best_iteration"]) == (True, 3)
    assert run["seconds"] == {"read": 0.21, "em": 7.1, "map": 0.02}
    assert run["cpu_seconds"] == {"read": 0.2, "em": 13.5, "map": 0.02}
    assert run["peak_memory_bytes"]["em"] == 96_000_000
    assert run["warnings"] == result.warnings
    assert run["learned"] == result.learned


def test_iterations(tmp_path, result):
    iterations = written(tmp_path, result)["iterations"]
    assert iterations[1] == {
        "number": 2,
        "bound": -31500.5,
        "expected_log_likelihood": -32100.25,
        "held_out_log_likelihood": None,
        "changed_share": 0.08,
        "touched_share": 1.0,
        "seconds": 1.8,
    }
    assert iterations[3]["bound"] is None  # not a number there


def test_calibration(tmp_path, result):
    yaw, scale = Parameter(0.0, 3.14, 0.01, True), Parameter(1.0, 1.02, 0.004, False)
    found = Calibration([{"theta": yaw}], [True], {"scale": scale}, 35)
    run = written(tmp_path, dataclasses.replace(result, calibration=found))["calibration"]
    assert run["windows"] == 35
    turned = {"recorded": 0.0, "estimated": 3.14, "std": 0.01, "applied": True}
    assert run["lasers"] == [{"theta": turned, "upside_down": True}]
    assert run["odometry"]["scale"] == {
        "recorded": 1.0,
        "estimated": 1.02,
        "std": 0.004,
        "applied": False,
    }


def test_doubts_loops_counts_and_areas(tmp_path, result):
    run = written(tmp_path, result)
    assert run["doubts"] == {
        "odometry_disagrees": [7, 9],
        "found_by_wider_search": [7],
        "carried_before": [20],
        "ambiguous": [31],
        "length_unknown": [{"first": 12, "last": 19, "metres": 3.25, "std": 0.4}],
    }
    accepted, refused = run["loops"]["accepted"], run["loops"]["refused"]
    assert accepted == [{"earlier": 2, "later": 40, "explained": 0.75}]
    why = ["explains too little", "other loops disagree", "explains too little"]
    assert [one["why"] for one in refused] == why
    assert refused[1] == {"earlier": 5, "later": 44, "explained": 0.9, "why": why[1]}
    hit, points = result.recording.hit, result.recording.points
    assert run["counts"] == {
        "scans": 60,
        "beams": 60 * 181,
        "hits": int(hit.sum()),
        "max_range": int((~hit & np.isfinite(points[:, 0])).sum()),
        "unusable": 3,
        "skipped": 41,
    }
    known = np.count_nonzero(~np.isnan(result.map.p_occupied))
    thin = np.count_nonzero(result.evidence.thinly_observed)
    assert 0 < thin < known
    assert run["area"] == {"known": round(0.01 * known, 6), "thin": round(0.01 * thin, 6)}


def test_values_of_every_kind_become_json(tmp_path, result):
    source = {
        "path": Path("a/b.bag"),
        "odd": float("inf"),
        "numpy": {"scalar": np.float32("nan"), "count": np.int64(3), "flag": np.bool_(True)},
        "array": np.array([[1.0, np.nan]]),
        "pair": (1, "ä"),
        7: None,
    }
    recording = dataclasses.replace(result.recording, source=Source(details=source))
    assert written(tmp_path, dataclasses.replace(result, recording=recording))["input"] == {
        "path": "a/b.bag",
        "odd": None,
        "numpy": {"scalar": None, "count": 3, "flag": True},
        "array": [[1.0, None]],
        "pair": [1, "ä"],
        "7": None,
        "skipped_unit": "line",
    }
