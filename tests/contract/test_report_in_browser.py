"""The report in a browser: controls with and without scripts, accessibility by axe."""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from opening_models import HERE, MODULES, require
from PIL import Image
from small_place import RECORD, make_place

from stillmap.cli.main import main
from stillmap.results.map_server import write_map_server
from stillmap.results.reader import read_grid
from stillmap.results.report.place import render_place_report
from stillmap.sim import scene_by_name, simulate, write_simulation

pytestmark = pytest.mark.slow


def opened(result, pixel, folder):
    """What `check_report.js` finds; (column, row) of a pixel of the map's picture."""
    node = require("node", "axe-core")
    require("node", "puppeteer-core")
    browser = shutil.which("chromium")
    if browser is None:
        pytest.skip("no chromium")
    words = [node, HERE / "check_report.js", MODULES, browser, folder, result / "report.html"]
    done = subprocess.run(
        [str(word) for word in (*words, *pixel)], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A result in 3D with pictures, surface and models."""
    path = tmp_path_factory.mktemp("place")
    changes = {"lidar": {"channels": 24, "columns": 300}, "robot": {"scans": 40}}
    scene = scene_by_name("street", {**changes, "camera": {"enabled": True, "rate": 1.0}})
    write_simulation(simulate(scene, 3), path / "recording")
    words = ["map", path / "recording", "-o", path / "out", "--quiet"]
    words += ["--poses", path / "recording/truth/trajectory.tum"]
    assert main([*map(str, words)]) == 0
    return path / "out"


def occupied_pixel(result):
    """Column and row of an occupied pixel of map.pgm, the one closest to the middle."""
    pixels = np.asarray(Image.open(result / "map.pgm"))
    rows, columns = np.nonzero(pixels == 0)
    middle = np.array(pixels.shape) / 2
    k = np.argmin((rows - middle[0]) ** 2 + (columns - middle[1]) ** 2)
    return int(columns[k]), int(rows[k])


@pytest.fixture(scope="module", params=["result", "place"])
def found(request, tmp_path_factory):
    """A report, in 2D and in 3D with models, and what the browser found in it."""
    result = request.getfixturevalue(request.param)
    pixel = occupied_pixel(result)
    return result, pixel, opened(result, pixel, tmp_path_factory.mktemp("profile"))


def test_axe_finds_nothing(found):
    for look in ("light", "dark", "phone"):
        assert found[2][look]["violations"] == [], look


def test_nothing_is_wider_than_the_screen(found):
    for look in ("light", "dark", "phone"):
        assert found[2][look]["overflow"] == 0, look


def test_page_asks_for_nothing_outside(found):
    result, _, seen = found
    page = (result / "report.html").as_uri()[:80]
    assert {one for one in seen["requests"] if not one.startswith("data:")} == {page}
    assert seen["errors"] == []


def test_map_zooms_and_pans(found):
    _, _, seen = found
    seen = seen["map"]
    start = seen["start"]
    # the wheel alone scrolls the page
    assert seen["wheel"]["scroll"] > 0
    assert seen["wheel"]["width"] == start["width"]
    assert seen["button"]["width"] == pytest.approx(1.5 * start["width"])
    assert seen["drag"]["left"] - seen["button"]["left"] == pytest.approx(70, abs=0.5)
    assert seen["drag"]["top"] - seen["button"]["top"] == pytest.approx(-30, abs=0.5)
    assert seen["focused"]["width"] > seen["drag"]["width"]
    assert seen["focused"]["readout"] == seen["drag"]["readout"]  # the same point below the mouse
    assert seen["all"]["left"] == pytest.approx(start["left"], abs=0.5)
    assert seen["all"]["width"] == pytest.approx(start["width"])
    assert seen["keys"]["width"] == pytest.approx(1.5 * start["width"])


def test_coordinates_are_those_of_the_map(found):
    result, (column, row), seen = found
    with np.load(result / "map.npz") as saved:
        height = saved["p_occupied"].shape[0]
        x, y, _ = saved["origin"]
        cell = saved["resolution"]
    words = seen["map"]["hover"]["readout"].replace(",", "").split()
    assert words[0] == "x"
    assert words[3] == "y"
    # the mouse moves by whole pixels, several cells in a wide map
    reach = 1.5 * float(cell)
    assert float(words[1]) == pytest.approx(x + (column + 0.5) * cell, abs=reach)
    assert float(words[4]) == pytest.approx(y + (height - row - 0.5) * cell, abs=reach)
    assert words[5:] == ["m:", "occupied"]


def test_printed_map_is_whole_and_has_a_scale(found):
    seen = found[2]["print"]
    before, printed, after = seen["before"], seen["printed"], seen["after"]
    metres, unit = printed["text"].split()
    assert unit == "m"
    x0, _, x1, _ = printed["window"]
    # the border of the bar lies outside of its length
    assert printed["bar"] / printed["sheet"] * (x1 - x0) == pytest.approx(float(metres), rel=0.05)
    assert printed["sheet"] < 700 < before["sheet"]
    assert after["sheet"] == pytest.approx(before["sheet"])
    assert after["text"] == before["text"]


def test_slider_divides_raw_and_clean(found):
    seen = found[2]["slider"]
    assert seen["start"] == {
        "value": 50,
        "clip": "inset(0px 50% 0px 0px)",
        "pair": "none",
        "images": 2,
    }
    assert seen["key"]["value"] == 51
    assert seen["drag"]["value"] == pytest.approx(31, abs=1)
    assert seen["drag"]["clip"] == f"inset(0px {100 - seen['drag']['value']}% 0px 0px)"


def test_layers_are_off_at_first(found):
    names = ("dynamic", "thin", "path", "grid")
    for seen in (found[2]["layers"], found[2]["plain"]["layers"]):
        assert [seen["start"][name] for name in names] == [False, False, False, True]
        assert [seen["toggled"][name] for name in names] == [True, True, True, False]


def test_without_scripts_the_maps_are_pictures(found):
    plain = found[2]["plain"]
    assert plain["map"] == [True]
    assert plain["pair"] == [True, True]
    assert not any(plain["controls"])


def test_links_lead_to_files(found):
    result, _, _ = found
    page = (result / "report.html").read_text(encoding="utf-8")
    links = [part.partition('"')[0] for part in page.split('<a href="')[1:]]
    assert {"map.pgm", "map.yaml", "trajectory.tum", "run.json"} <= set(links)
    assert all((result / Path(link)).is_file() for link in links)
    assert ("mesh.glb" in links) == (result / "mesh.glb").exists()


@pytest.fixture(scope="module")
def merged(tmp_path_factory):
    """What the browser finds in the report of a made-up place."""
    folder = make_place(tmp_path_factory.mktemp("merged") / "place")
    grid = read_grid(folder)
    write_map_server(folder, grid)
    page = render_place_report(folder, grid, "trinary", RECORD)
    (folder / "report.html").write_text(page, encoding="utf-8")
    return folder, opened(folder, occupied_pixel(folder), tmp_path_factory.mktemp("profile"))


def test_report_of_a_place_is_accessible_and_asks_for_nothing(merged):
    folder, seen = merged
    for look in ("light", "dark", "phone"):
        assert seen[look] == {"violations": [], "overflow": 0}, look
    page = (folder / "report.html").as_uri()[:80]
    assert {one for one in seen["requests"] if not one.startswith("data:")} == {page}
    assert seen["errors"] == []


def test_map_of_a_place_zooms_and_shows_trajectories(merged):
    _, seen = merged
    start, button = seen["map"]["start"], seen["map"]["button"]
    assert button["width"] == pytest.approx(1.5 * start["width"])
    assert seen["map"]["hover"]["readout"].endswith("occupied")
    for layers in (seen["layers"], seen["plain"]["layers"]):
        assert layers == {
            "start": {"path": False, "grid": True},
            "toggled": {"path": True, "grid": False},
        }
