import base64
import dataclasses
import hashlib
import io
import itertools
import re

import numpy as np
import pytest
from PIL import Image
from report_page import Page

from stillmap.pipeline.quality import Quality, describe_quality
from stillmap.results.colors import ORANGE
from stillmap.results.map_server import write_map_server
from stillmap.results.report import formatting
from stillmap.results.report.estimation import curve_of, round_down
from stillmap.results.report.figures import UNKNOWN, VEIL_ALPHA, VIOLET
from stillmap.results.report.page import render_report
from stillmap.slam.mount_calibration import Calibration, Parameter

# what a reader finds in no dictionary, or only in the code
JARGON = r"\bnats?\b|\blooks\b|\b[em]_step\b|\brad\b|HMM|posterior|responsibilit"


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


def test_same_result_gives_the_same_page(result, html):
    assert render_report(result) == html


def test_text_from_files_is_escaped(page):
    text = "".join(page.text)
    for foreign in (
        "hall <1>.clf",
        "the odometry stalls at line 88 & <after>",
        "<script>alert(1)</script>",
        "a <b>bold</b> & 'quoted' note",
    ):
        assert foreign in text


def test_headline_figures(page):
    text = "|".join(page.text)
    for value in ("60", "12.4 %", "7.3 s", "2"):
        assert f"|{value}|" in text
    text = "".join(page.text)
    assert "from 60 scans over 12 s" in text
    assert "97 MB of memory" in text
    assert "Of 10,860 beams" in text
    assert "lines 203, 204," in text
    assert "15 more" in text


def test_words_are_plain(html):
    text = re.sub(r"<(style|script)>.*?</\1>", "", html, flags=re.DOTALL)
    text = " ".join(Page(text).text)
    assert re.findall(JARGON, text, re.IGNORECASE) == []


def test_headings_are_in_order(page):
    levels = [int(tag[1]) for tag, _ in page.tags if re.fullmatch(r"h[1-6]", tag)]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in itertools.pairwise(levels))


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
        line = getattr(words, name.lower()).partition(": ")[2]
        assert f"{name} {figure} of 100 {line}." in text
    text = " ".join(Page(section(render_report(result), "Quality")).text)
    assert text.count("cannot be told from this recording.") == 3
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


def test_curve_marks_the_best_and_spans_the_axes():
    curve = curve_of([1, 2, 3], [-30.0, -20.0, -25.0], best=2)
    left, top, right, bottom = curve.box
    assert curve.best == curve.dots[1]
    x, y = np.transpose(curve.dots)
    assert (np.diff(x) > 0).all()
    assert y.argmin() == 1
    assert left <= x.min() <= x.max() <= right
    assert top <= y.min() <= y.max() <= bottom
    assert [label for _, label in curve.x_ticks] == ["1", "2", "3"]
    ticks = np.array([float(label) for _, label in curve.y_ticks])
    heights = np.array([height for height, _ in curve.y_ticks])
    # ticks lie where their values would
    np.testing.assert_allclose(np.interp(-25.0, ticks, heights), curve.dots[2][1], atol=0.2)


def test_curve_has_gaps_where_values_are_not_finite():
    values = [-4.0, -3.0, float("nan"), -2.0, float("-inf"), -1.5, -1.0]
    curve = curve_of(range(1, 8), values, best=3)
    assert curve.best is None
    assert len(curve.dots) == 5
    assert [len(line.split()) for line in curve.lines] == [2, 2]
    assert curve_of([1, 2], [float("nan")] * 2, best=1).dots == []
    assert len(curve_of([1, 2], [-5e9, -5e9], best=1).y_ticks) > 1


@pytest.mark.parametrize(
    ("value", "rounded"), [(1.0, 1.0), (4.9, 2.0), (73.0, 50.0), (0.5, 0.5), (0.0019, 0.001)]
)
def test_round_down(value, rounded):
    assert round_down(value) == pytest.approx(rounded)


def with_likelihoods(result, values):
    first = result.iterations[0]
    records = [
        dataclasses.replace(first, number=n, bound=value) for n, value in enumerate(values, start=1)
    ]
    return dataclasses.replace(result, iterations=records)


def test_report_names_iterations_where_the_bound_decreased(result, section):
    def text(values):
        html = render_report(with_likelihoods(result, values))
        return " ".join(section(html, "Likelihood over the iterations").split())

    assert "never decreased" in text([-100, -90, -90])
    assert "decreased at iteration 3 (by 2.2 %)" in text([-100, -90, -92, -80])
    assert "decreased at iterations 2, 4 (most at iteration 4, by 3.0 %)" in text(
        [-100, -101, -100, -103]
    )
    assert "There was one iteration." in text([-5])
    assert "decreased at iteration 3 (by 3.0 %)" in text([-100, float("nan"), -103])


def estimated_by(result, estimator):
    options = dataclasses.replace(result.options, estimator=estimator)
    return dataclasses.replace(result, options=options)


def test_curve_titles_depend_on_the_estimator(result):
    default = render_report(result)
    assert "Log likelihood of the observations" in default
    assert "(5)" not in default
    for estimator in ("paper", "hit-ratio", "tracker"):
        printed = render_report(estimated_by(result, estimator))
        assert "Expected log likelihood, (5)" in printed
        assert "Log likelihood of the ranges" in printed


def test_one_iteration_makes_no_curve(result):
    one = render_report(dataclasses.replace(result, iterations=result.iterations[:1]))
    assert 'class="curve"' not in one
    assert "There was one iteration." in one
    assert render_report(result).count('class="curve"') == 2


def test_loop_closures(result, section):
    def text(loops):
        html = render_report(dataclasses.replace(result, loops=loops))
        return section(html, "Likelihood over the iterations")

    assert (
        "Loop closure: 1 of 4 candidates accepted; "
        "rejected: explains too little (2), other loops disagree (1)."
    ) in text(result.loops)
    assert "Loop closure: 1 of 1 candidates accepted." in text(result.loops[:1])
    assert "Loop closure" not in text([])


def test_one_snapshot_shows_no_evolution(result):
    assert "Map over the iterations" in render_report(result)
    one = render_report(dataclasses.replace(result, snapshots=result.snapshots[:1]))
    assert "Map over the iterations" not in one
    assert "Part with most dynamic returns" in one


@pytest.fixture
def fitted(section):
    """A function: the words of the section on fitted parameters."""
    return lambda result: re.sub(
        r"\s+",
        " ",
        " ".join(Page(section(render_report(result), "What was fitted to this recording")).text),
    )


def test_fitted_parameters(result, fitted):
    text = fitted(result)
    assert "87.3 % of the cells in which beams ended are static" in text
    assert "noise is 1.7 cm" in text
    assert "0.5 s or less 60.0 % 3 s 30.0 % 45 s or more 10.0 %" in text
    assert "1 % or less 90.0 % 15 % or more 10.0 %" in text
    assert "90 % or less 25.0 % 99.8 % or more 75.0 %" in text  # in rising order


def test_parameters_that_were_not_fitted_are_not_shown(result, fitted):
    assert fitted(dataclasses.replace(result, learned={})) == ""
    static = dataclasses.replace(result, p_static=np.ones_like(result.p_static))
    assert "only 0 dynamic returns" in fitted(static)
    assert "or less 60.0 %" not in fitted(static)
    noiseless = dataclasses.replace(result, learned={**result.learned, "scatter": 0.0})
    assert "noise" not in fitted(noiseless)


@pytest.mark.parametrize(
    "change",
    [
        {"iterations": [], "snapshots": [], "warnings": [], "stages": {}, "converged": False},
        {"stages": {"read": {"seconds": None, "peak_memory_bytes": None}}},
    ],
)
def test_report_of_an_incomplete_result(result, change):
    Page(render_report(dataclasses.replace(result, **change)))


def test_maps_without_known_cells_and_without_cells(result):
    for p in (np.full((5, 5), np.nan, np.float32), np.zeros((0, 0), np.float32)):
        empty = dataclasses.replace(
            result.map, p_occupied=p, origin=(0.0, 0.0, 0.0), resolution=1.0
        )
        none = dataclasses.replace(result.evidence, thinly_observed=np.zeros(p.shape, bool))
        Page(render_report(dataclasses.replace(result, map=empty, raw_map=empty, evidence=none)))


def test_likelihoods_that_are_not_finite(result):
    Page(render_report(with_likelihoods(result, [float("nan"), float("-inf"), -3.0])))


@pytest.mark.parametrize(
    ("function", "value", "text"),
    [
        ("format_duration", 0.0123, "0.012 s"),
        ("format_duration", 42.4, "42 s"),
        ("format_duration", 1.7e-5, "under 1 ms"),
        ("format_duration", 192.0, "3 min 12 s"),
        ("format_duration", 59.9, "1 min 0 s"),
        ("format_duration", 7260.0, "2 h 1 min"),
        ("format_share", 0.0, "0.0 %"),
        ("format_share", 0.00123, "0.12 %"),
        ("format_share", 0.1235, "12.3 %"),
        ("format_share", float("nan"), "unknown"),
        ("format_bytes", 45_600_000, "46 MB"),
        ("format_bytes", 2_345_000_000, "2.35 GB"),
        ("format_bytes", 0, "unknown"),
        ("format_number", None, "-"),
        ("format_clock", 3_723_400_000_000, "1:02:03.4"),
        ("format_sentence", "a wall, bent", "a wall, bent."),
        ("format_sentence", "is it?", "is it?"),
        ("format_scalar", True, "yes"),
        ("format_scalar", None, "not set"),
    ],
)
def test_numbers_as_text(function, value, text):
    assert getattr(formatting, function)(value) == text


def test_calibration(result):
    yaw, latency = Parameter(0.0, np.pi, 0.002, True), Parameter(0.0, 0.012, 0.008, False)
    found = Calibration([{"theta": yaw}], [False], {"latency": latency}, 35)
    text = " ".join(Page(render_report(dataclasses.replace(result, calibration=found))).text)
    assert re.search(r"laser, direction\s+0\.0°\s+180\.0 ± 0\.1°\s+estimated", text)
    assert re.search(r"odometry, delay\s+0\.000 s\s+0\.012 ± 0\.008 s\s+recorded", text)
    assert "upside down" not in text


def test_details_of_the_recording(page):
    text = "".join(page.text)
    assert "threshold how: 12 m repeats (919 x)" in text
    assert "start angle: -90°" in text
    assert "stamp goes back, 2 times: lines 88, 91" in text
    assert "ignored" not in text
