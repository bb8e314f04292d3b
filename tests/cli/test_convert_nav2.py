"""`stillmap convert RESULT --mask`: files of zones that are at fault, and calls that are."""

import json
import shutil

import numpy as np
import pytest
from refusals import refused

SQUARE = [[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]]


def polygon(*rings, kind="Polygon"):
    return {"type": kind, "coordinates": list(rings)}


def feature(geometry, **properties):
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def collection(*features):
    return json.dumps({"type": "FeatureCollection", "features": features})


BLOCK = feature(polygon(SQUARE), action="block")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "is not JSON"),
        ("[" * 100_000, "is not JSON"),
        (json.dumps(BLOCK), "(a GeoJSON FeatureCollection)"),
        (collection(BLOCK, feature(polygon(SQUARE))), "feature 2: is damaged: Object"),
        (collection(feature(polygon(SQUARE), action="erased")), "its action is erase, block"),
        (collection(feature({"type": "Point"}, action="block")), "Polygon or MultiPolygon"),
        (
            collection(BLOCK, feature(polygon(SQUARE[:-1]), action="block", name="dock")),
            "feature 2 'dock': has a ring whose last position is not its first",
        ),
        (collection(feature(polygon(), action="block")), "rings of four positions"),
        (collection(feature(polygon([[0, 1], [2]] * 2), action="block")), "$[0][0][1]"),
        (collection(feature(polygon([[10**400, 1]] * 4), action="block")), "rings of four"),
        (collection(feature(polygon([[np.nan, 1]] * 4), action="block")), "is not JSON"),
        (collection(feature(polygon(SQUARE), action="speed")), "None is no speed limit"),
        (collection(feature(polygon(SQUARE), action="speed", speed="nan%")), "is no speed limit"),
        (
            collection(*(feature(polygon(SQUARE), action="speed", speed=s) for s in ("50%", 1))),
            "feature 1: has a speed limit in percent",
        ),
        (
            collection(*(feature(polygon(SQUARE), action="speed", speed=s) for s in (60, 0.5))),
            "feature 2: a limit of 0.5 m/s is less than a step",
        ),
        (
            collection(feature(polygon([[500 + x, y] for x, y in SQUARE]), action="block")),
            "feature 1: holds no cell of the map (the map: x ",
        ),
    ],
)
def test_faulty_zones(call, mapped, tmp_path, nothing_left, content, words):
    path = tmp_path / "zones.geojson"
    path.write_text(content)
    done = call("convert", mapped, "-o", tmp_path / "maps", "--mask", path)
    refused(done, words)
    assert "zones.geojson" in done.stderr
    nothing_left("zones.geojson")


def test_calls_at_fault(call, room, mapped, tmp_path, nothing_left):
    zones = tmp_path / "zones.geojson"
    zones.write_text(collection(BLOCK))
    for flags in (("--mask", zones), ("--keepout-crossings", 2), ("--to", "nav2")):
        done = call("convert", room, "-o", tmp_path / "a", *flags)
        refused(done, f"{flags[0]}", "is for results")
    refused(call("convert", mapped, "-o", tmp_path / "a.mcap", "--mask", zones), "--to nav2")
    refused(
        call("convert", mapped, "-o", tmp_path / "a", "--to", "ros2", "--slow-crossings", 2),
        "--slow-crossings is for maps and masks of nav2",
    )
    done = call("convert", mapped, "-o", tmp_path / "a", "--keepout-crossings", 0)
    refused(done, "--keepout-crossings", "not 0")
    refused(call("convert", mapped, "-o", tmp_path / "a", "--slow-to", "1"), "needs --slow-cross")
    done = call("convert", mapped, "-o", tmp_path / "a", "--slow-crossings", 1, "--slow-to", "x")
    refused(done, "--slow-to: 'x' is no speed limit")
    refused(call("convert", mapped, "-o", mapped, "--to", "nav2", "--overwrite"), "the result")
    nothing_left("zones.geojson")


def test_only_folders_of_its_kind_are_replaced(call, mapped, tmp_path):
    result, out = tmp_path / "result", tmp_path / "maps.new"
    shutil.copytree(mapped, result)
    done = call("convert", mapped, "-o", result, "--to", "nav2", "--overwrite")
    refused(done, "only a folder with nav2_params.yaml is replaced")
    for flags, status in (((), 0), ((), 2), (("--overwrite",), 0)):
        assert call("convert", mapped, "-o", out, "--to", "nav2", *flags).returncode == status


def test_results_of_other_versions(call, mapped, tmp_path):
    """They may have options that are no longer, or not yet, known."""
    result = tmp_path / "result"
    shutil.copytree(mapped, result)
    record = json.loads((result / "run.json").read_text())
    record["options"]["em"]["of_another_version"] = 1.0
    record["input"]["path"] = str(tmp_path / "gone")  # the recording is not needed
    (result / "run.json").write_text(json.dumps(record))
    assert call("convert", result, "-o", tmp_path / "a", "--to", "nav2").returncode == 0
    record["options"]["output"]["map_mode"] = "raw"
    (result / "run.json").write_text(json.dumps(record))
    assert call("convert", result, "-o", tmp_path / "b", "--to", "nav2").returncode == 0
    assert "mode: raw" in (tmp_path / "b/map.yaml").read_text()


def test_no_traffic(call, mapped, tmp_path):
    done = call("convert", mapped, "-o", tmp_path / "a", "--keepout-crossings", 1000)
    assert done.returncode == 0
    assert "warning: no square of the floor was crossed 1000 times, at most" in done.stderr
    result = tmp_path / "result"
    shutil.copytree(mapped, result)
    (result / "traffic.npz").unlink()
    done = call("convert", result, "-o", tmp_path / "b", "--keepout-crossings", 1)
    refused(done, "traffic.npz: does not exist", "objects.enabled")
    (result / "traffic.npz").write_bytes(b"PK")
    done = call("convert", result, "-o", tmp_path / "b", "--keepout-crossings", 1)
    refused(done, "traffic.npz: is damaged")


def test_zones_beyond_the_map_are_cut(call, mapped, tmp_path):
    zones = tmp_path / "zones.geojson"
    ring = [[-100, -100], [100, -100], [0, 100], [-100, -100]]
    zones.write_text(collection(feature(polygon(ring), action="block", name="all")))
    done = call("convert", mapped, "-o", tmp_path / "a", "--mask", zones)
    assert done.returncode == 0
    assert "zones.geojson: feature 1 'all' reaches beyond the map" in done.stderr
    assert "map, keep-out zones of " in done.stderr


def test_many_corners_on_many_rows_stay_in_memory():
    """A zigzag of 10 000 edges over all rows of a map."""
    import tracemalloc

    from stillmap.core.grid_map import GridMap
    from stillmap.results.export.zones import cells_inside

    n = 10_000
    x = np.linspace(0.0, 50.0, n)
    zigzag = np.stack([x, np.where(np.arange(n) % 2, 40.0, 0.0)], axis=1)
    ring = np.concatenate([zigzag, [[50.0, -1.0], [0.0, -1.0], zigzag[0]]])
    grid = GridMap(np.zeros((400, 500), np.float32), (0.0, 0.0, 0.0), 0.1)
    tracemalloc.start()
    _, inside = cells_inside([ring], grid)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 64 << 20
    assert 0.3 < inside.mean() < 0.7
