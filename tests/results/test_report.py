import base64
import dataclasses
import hashlib
import io
import re

import numpy as np
import pytest
from PIL import Image
from report_page import Page

from stillmap.pipeline.quality import Quality, describe_quality
from stillmap.results.colors import ORANGE
from stillmap.results.map_server import write_map_server
from stillmap.results.report.estimation import curve_of
from stillmap.results.report.figures import UNKNOWN, VEIL_ALPHA, VIOLET
from stillmap.results.report.page import render_report
from stillmap.slam.mount_calibration import Calibration, Parameter

# what a reader finds in no dictionary, or only in the code


@pytest.fixture(scope="module")
def html(result):
    return render_report(result)


@pytest.fixture(scope="module")
def page(html):
    return Page(html)


def picture(attrs):
    head, data = attrs["src"].split(",")
    assert head == "data:image/png;base64"
    return Image.open(io.BytesIO(base64.b64decode(data)))


def test_page_makes_no_request(html, page):
    for tag, attrs in page.tags:
        assert tag not in {"link", "iframe", "object", "embed", "base"}
        assert tag != "script" or attrs == {}  # inline
        for name in ("src", "href", "xlink:href", "srcset", "action", "poster"):
            value = attrs.get(name, "#")
            assert value.startswith(("data:", "#")), (tag, name)
    assert "//" not in re.sub(r"base64,[A-Za-z0-9+/=]*", "", html)
    assert "@import" not in html
    assert set(re.findall(r"url\(([^)])", html)) <= {"#"}


def test_browsers_run_no_script_but_the_own_one(html, page):
    scripts = re.findall(r"<script>(.*?)</script>", html, re.DOTALL)
    assert len(scripts) == 1
    policy = next(
        meta["content"]
        for meta in page.named("meta")
        if meta.get("http-equiv") == "Content-Security-Policy"
    )
    digest = base64.b64encode(hashlib.sha256(scripts[0].encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in policy
    assert "default-src 'none'" in policy
    handlers = [name for _, attrs in page.tags for name in attrs if name.startswith("on")]
    assert handlers == []


def test_text_from_files_is_escaped(page):
    text = "".join(page.text)
    for foreign in (
        "hall <1>.clf",
        "the odometry stalls at line 88 & <after>",
        "<script>alert(1)</script>",
        "a <b>bold</b> & 'quoted' note",
    ):
        assert foreign in text


def test_images_have_alt_texts_and_show_the_maps(page, result):
    images = page.named("img")
    # the map with two layers over it, raw, clean, tracks, traffic, three iterations
    assert [bool(image["alt"]) for image in images] == [True, False, False] + [True] * 7
    for image in images:
        assert picture(image).size == (int(image["width"]), int(image["height"]))
    raw, clean = (np.asarray(picture(image).convert("RGB")) for image in images[3:5])
    assert raw.shape == clean.shape
    # the traces of the walkers are in the raw map only
    assert (raw.astype(int) + 20 < clean).all(axis=2).sum() > 500
    layer = np.asarray(picture(images[1]).convert("RGBA"))
    assert set(map(tuple, layer.reshape(-1, 4))) == {(*VIOLET, VEIL_ALPHA), (*UNKNOWN, 0)}
    dots = np.asarray(picture(images[2]).convert("RGBA"))
    assert set(map(tuple, dots.reshape(-1, 4))) == {(*ORANGE, 255), (*UNKNOWN, 0)}
    assert len(page.named("polyline")[0]["points"].split()) == result.recording.n_scans


def test_map_comes_first_as_it_was_written(page, result, tmp_path):
    write_map_server(tmp_path, result.map)
    written = np.asarray(Image.open(tmp_path / "map.pgm"))
    first = picture(page.named("img")[0])
    np.testing.assert_array_equal(np.asarray(first.convert("L")), written)
    boxes = {one["id"]: "checked" in one for one in page.named("input") if "id" in one}
    assert boxes == {
        "show-dynamic": False,
        "show-thin": False,
        "show-path": False,
        "show-grid": True,
    }


def test_files_beside_the_report_are_linked(result, tmp_path):
    (tmp_path / "objects").mkdir()
    for name in ("map.pgm", "run.json", "objects/objects.json", "unknown.txt"):
        (tmp_path / name).touch()
    links = [one["href"] for one in Page(render_report(result, folder=tmp_path)).named("a")]
    assert links == ["map.pgm", "objects/objects.json", "run.json"]
    assert Page(render_report(result)).named("a") == []


def test_only_warnings_with_advice_are_at_the_top(result, section):
    warnings = ["walls are <bent>; what to do: record it again", "odometry was late"]
    html = render_report(dataclasses.replace(result, warnings=warnings))
    box = section(html, "One thing to check")
    assert "walls are &lt;bent&gt;." in box
    assert "<b>What to do:</b> record it again." in box
    assert "odometry was late." in section(html, "Notes")
    assert "odometry was late." not in box
    assert "to check" not in render_report(result)


def test_quality_in_figures_and_words(result, section):
    rated = dataclasses.replace(result, quality=Quality(71.3, 91.2, 55.7))
    text = " ".join(Page(section(render_report(rated), "Quality")).text)
    text = re.sub(r"\s+", " ", text)
    words = describe_quality(rated.quality)
    for name, figure in (("Overall", 71), ("Labels", 91), ("Geometry", 56)):
        line = words[name.lower()].partition(": ")[2]
        assert f"{name} {figure} of 100 {line}." in text
    text = " ".join(Page(section(render_report(result), "Quality")).text)
    assert text.count("cannot be determined from this recording.") == 3
    assert "of 100" not in text


def test_thinly_observed_area(page, result):
    text = " ".join("".join(page.text).split())
    thin, known = (
        np.count_nonzero(one) for one in (result.evidence.thinly_observed, result.map.beta > 0)
    )
    share, area = f"{100 * thin / known:.1f} %", f"{0.01 * thin:,.1f} m²"
    assert f"Thin evidence{share}{area} were observed fewer than 3 times" in text
    nothing = dataclasses.replace(
        result.evidence, thinly_observed=np.zeros_like(result.evidence.thinly_observed)
    )
    text = render_report(dataclasses.replace(result, evidence=nothing))
    assert "all of the area is well observed" in text


def test_report_of_a_large_map_stays_small(result):
    rng = np.random.default_rng(0)
    # noise is the worst case for PNG
    large = dataclasses.replace(
        result.map, p_occupied=rng.random((4000, 4000), np.float32), resolution=0.05
    )
    evidence = dataclasses.replace(result.evidence, thinly_observed=rng.random((4000, 4000)) < 0.5)
    text = render_report(dataclasses.replace(result, map=large, raw_map=large, evidence=evidence))
    assert len(text.encode()) < 10_000_000
    Page(text)


def test_curve_spans_the_axes_and_has_gaps_where_values_are_not_finite():
    curve = curve_of([1, 2, 3], [-30.0, -20.0, -25.0], best=2)
    left, top, right, bottom = curve["box"]
    assert curve["best"] == curve["dots"][1]
    x, y = np.transpose(curve["dots"])
    assert (np.diff(x) > 0).all()
    assert y.argmin() == 1
    assert left <= x.min() <= x.max() <= right
    assert top <= y.min() <= y.max() <= bottom
    assert [label for _, label in curve["x_ticks"]] == ["1", "2", "3"]
    heights, labels = zip(*curve["y_ticks"], strict=True)
    # ticks lie where their values would
    at = np.interp(-25.0, [float(label) for label in labels], heights)
    assert at == pytest.approx(curve["dots"][2][1], abs=0.2)
    values = [-4.0, -3.0, float("nan"), -2.0, float("-inf"), -1.5, -1.0]
    curve = curve_of(range(1, 8), values, best=3)
    assert curve["best"] is None
    assert len(curve["dots"]) == 5
    assert [len(line.split()) for line in curve["lines"]] == [2, 2]
    assert curve_of([1, 2], [float("nan")] * 2, best=1)["dots"] == []
    assert len(curve_of([1, 2], [-5e9, -5e9], best=1)["y_ticks"]) > 1


def test_report_of_an_incomplete_result(result):
    first = result.iterations[0]
    bounds = (float("nan"), float("-inf"), -3.0)
    for changes in (
        {"iterations": [], "snapshots": [], "warnings": [], "stages": {}, "converged": False},
        {"stages": {"read": {"seconds": None, "peak_memory_bytes": None}}},
        {
            "iterations": [
                dataclasses.replace(first, number=n, bound=b) for n, b in enumerate(bounds)
            ]
        },
    ):
        Page(render_report(dataclasses.replace(result, **changes)))
    one = render_report(dataclasses.replace(result, iterations=result.iterations[:1]))
    assert 'class="curve"' not in one
    assert "There was one iteration." in one
    for p in (np.full((5, 5), np.nan, np.float32), np.zeros((0, 0), np.float32)):
        empty = dataclasses.replace(
            result.map, p_occupied=p, origin=(0.0, 0.0, 0.0), resolution=1.0
        )
        none = dataclasses.replace(result.evidence, thinly_observed=np.zeros(p.shape, bool))
        Page(render_report(dataclasses.replace(result, map=empty, raw_map=empty, evidence=none)))


def test_calibration(result):
    yaw, latency = Parameter(0.0, np.pi, 0.002, True), Parameter(0.0, 0.012, 0.008, False)
    found = Calibration([{"theta": yaw}], [False], {"latency": latency}, 35)
    text = " ".join(Page(render_report(dataclasses.replace(result, calibration=found))).text)
    assert re.search(r"laser, direction\s+0\.0°\s+180\.0 ± 0\.1°\s+estimated", text)
    assert re.search(r"odometry, delay\s+0\.000 s\s+0\.012 ± 0\.008 s\s+recorded", text)
    assert "upside down" not in text
