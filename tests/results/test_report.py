import base64
import dataclasses
import io
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from stillmap.results.report import tables
from stillmap.results.report.figures import (
    ORANGE,
    UNKNOWN,
    VEIL,
    VIOLET,
    draw_map,
    draw_points,
    draw_poorly_observed,
    draw_snapshot,
    likelihood_svg,
    map_window,
)
from stillmap.results.report.page import likelihood_sentence, loops_sentence, render_report
from stillmap.results.report.tables import learned_section

VOID = {"meta", "img", "input", "br", "link", "hr"}


class Page(HTMLParser):
    """Every tag with its attributes, and the text; tags must close in order."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.text, self._open = [], [], []
        self.feed(text)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)

    def named(self, tag):
        return [attrs for name, attrs in self.tags if name == tag]


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


def test_nothing_is_fetched_from_anywhere(html, page):
    for tag, attrs in page.tags:
        assert tag not in {"script", "link", "iframe", "object", "embed", "base"}
        for name in ("src", "href", "xlink:href", "srcset", "action", "poster"):
            value = attrs.get(name, "#")
            assert value.startswith(("data:", "#")), (tag, name)
    assert "//" not in re.sub(r"base64,[A-Za-z0-9+/=]*", "", html)
    assert "@import" not in html
    assert set(re.findall(r"url\(([^)])", html)) <= {"#"}


def test_what_came_from_files_is_text_only(page):
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
    for value in ("60", "10,860", "12.4 %", "7.3 s", "97 MB", "12 s"):
        assert f"|{value}|" in text
    assert "number 3 kept; converged" in text
    assert "lines 203, 204," in text
    assert "15 more" in text


def test_pictures_have_words_and_show_the_maps(page, result):
    images = page.named("img")
    # raw, filtered, a veil and the dots over it, ways, traffic, three iterations
    assert [bool(image["alt"]) for image in images] == [True, True, False, False] + [True] * 5
    for image in images:
        assert picture(image).size == (int(image["width"]), int(image["height"]))
    raw, filtered = (np.asarray(picture(image).convert("RGB")) for image in images[:2])
    assert raw.shape == filtered.shape
    # the ghosts that the walkers leave are in the raw map alone
    assert (raw.astype(int) + 20 < filtered).all(axis=2).sum() > 500
    veil = np.asarray(picture(images[2]).convert("RGBA"))
    assert set(map(tuple, veil.reshape(-1, 4))) == {(*VIOLET, VEIL), (*UNKNOWN, 0)}
    dots = np.asarray(picture(images[3]).convert("RGBA"))
    assert set(map(tuple, dots.reshape(-1, 4))) == {(*ORANGE, 255), (*UNKNOWN, 0)}
    assert len(page.named("polyline")[0]["points"].split()) == result.recording.n_scans


def small_map(result, p):
    return dataclasses.replace(result.map, p_occupied=p, origin=(0.0, 0.0, 0.0), resolution=1.0)


def test_map_colours(result):
    p = np.array([[0, 1, np.nan], [np.nan, 0, 0]], np.float32)
    pixels = np.asarray(draw_map(small_map(result, p), (0, 0, 3, 2)).convert("RGB"))
    white, black = (255, 255, 255), (0, 0, 0)
    np.testing.assert_array_equal(pixels, [[UNKNOWN, white, white], [white, black, UNKNOWN]])


def test_the_window_holds_every_occupied_cell_of_both_maps(result):
    p = np.zeros((100, 300), np.float32)
    p[40, 50] = p[60, 90] = 0.7
    other = np.zeros((50, 100), np.float32)
    other[10, 20] = 0.7
    b = dataclasses.replace(small_map(result, other), origin=(100.0, 30.0, 0.0))
    assert map_window([small_map(result, p), b]) == (44.0, 34.0, 125.0, 67.0)
    # none occupied: what is known; nothing known: everything
    p[:] = np.nan
    assert map_window([small_map(result, p)]) == (0.0, 0.0, 300.0, 100.0)
    p[5, 6] = 0.1
    assert map_window([small_map(result, p)]) == (2.0, 1.0, 11.0, 10.0)


def test_dots_lie_where_the_points_are():
    points = np.array([[0.5, 0.5], [2.5, 1.5], [9.0, 9.0], [-0.1, 0.5]], np.float32)
    dots = np.asarray(draw_points(points, (0, 0, 3, 2), (3, 2)))
    np.testing.assert_array_equal(dots, [[0, 0, 1], [1, 0, 0]])


def test_the_veil_lies_over_thin_places(result):
    p = np.array([[0, 1, np.nan], [np.nan, 0, 0]], np.float32)
    thin = np.array([[0, 1, 0], [0, 0, 1]], bool)
    veil = np.asarray(draw_poorly_observed(small_map(result, p), thin, (-1, 0, 3, 2)))
    np.testing.assert_array_equal(veil, [[0, 0, 0, 1], [0, 0, 1, 0]])


def test_the_veil_is_reduced_as_the_map_is(result):
    p, thin = np.zeros((4000, 4000), np.float32), np.zeros((4000, 4000), bool)
    p[:2000] = np.nan  # of a square that is hardly known the known cells count
    p[:2000, ::7] = 0.0
    thin[:2000, 0:1000:7] = thin[2000:, 1000:2000] = True
    thin[3000, 3000] = True
    occupancy, window = small_map(result, p), (0, 0, 4000, 4000)
    image = draw_poorly_observed(occupancy, thin, window)
    assert image.size == draw_map(occupancy, window).size
    veil = np.asarray(image)
    middle = image.height // 2
    quarter = image.width // 4
    assert veil[: middle - 1, quarter + 1 : 2 * quarter - 1].all()
    assert not veil[: middle - 1, 2 * quarter + 1 :].any()
    columns = np.flatnonzero(veil[middle + 1 :].all(axis=0))
    assert 0 < columns.max() <= quarter
    assert not veil[middle + 1 :, :quarter][:, columns.max() + 1 :].any()


def test_how_much_is_thin_is_said(page, result):
    text = " ".join("".join(page.text).split())
    thin, known = (np.count_nonzero(one) for one in (result.evidence.thin, result.map.beta > 0))
    assert f"{0.01 * thin:,.1f} m² of the filtered map" in text
    assert f"{100 * thin / known:.1f} % of what is known" in text
    assert "fewer than 3 looks" in text
    nothing = dataclasses.replace(result.evidence, thin=np.zeros_like(result.evidence.thin))
    text = render_report(dataclasses.replace(result, evidence=nothing))
    assert "No place that is known rests on thin evidence." in text


def test_snapshot_shows_map_and_dots(result):
    shown = np.asarray(draw_snapshot(result.snapshots[-1]).convert("RGB"))
    colours = set(map(tuple, shown.reshape(-1, 3).tolist()))
    assert {(255, 255, 255), UNKNOWN, ORANGE} <= colours
    assert min(colours)[0] < 50  # a wall


def test_large_maps_are_reduced_but_keep_thin_walls(result):
    p = np.zeros((4000, 4000), np.float32)
    p[:, 1777] = 1.0
    p[3000:] = np.nan
    image = draw_map(small_map(result, p), (0, 0, 4000, 4000))
    assert image.width * image.height <= 1_500_000
    pixels = np.asarray(image.convert("L")).astype(int)
    wall = 1777 * image.width // 4000
    assert (pixels[image.height // 4 + 2 :, wall] == 0).all()
    assert (
        pixels[: image.height // 4 - 2]
        == np.asarray(Image.new("RGB", (1, 1), UNKNOWN).convert("L"))
    ).all()
    assert (pixels[image.height // 4 + 2 :, : wall - 2] == 255).all()


def test_a_report_of_a_large_map_stays_small(result):
    rng = np.random.default_rng(0)
    # noise is the worst that PNG can be given
    large = dataclasses.replace(
        result.map, p_occupied=rng.random((4000, 4000), np.float32), resolution=0.05
    )
    evidence = dataclasses.replace(result.evidence, thin=rng.random((4000, 4000)) < 0.5)
    text = render_report(dataclasses.replace(result, map=large, raw_map=large, evidence=evidence))
    assert len(text.encode()) < 10_000_000
    Page(text)


def test_curve_is_the_same_every_time_and_marks_the_best(result):
    titles = ("one curve", "the other")
    svg = likelihood_svg(result.iterations, 3, titles)
    assert svg == likelihood_svg(result.iterations, 3, titles)
    assert svg != likelihood_svg(result.iterations, 2, titles)
    assert all(title in svg for title in titles)
    assert "http" not in svg
    assert not re.search(r"#01020\d", svg)
    for colour in ("--ink", "--accent", "--orange"):
        assert f"var({colour})" in svg


def with_likelihoods(result, values):
    first = result.iterations[0]
    records = [
        dataclasses.replace(first, number=n, bound=value) for n, value in enumerate(values, start=1)
    ]
    return dataclasses.replace(result, iterations=records)


def test_the_report_says_where_the_likelihood_fell(result):
    def sentence(values):
        return likelihood_sentence(with_likelihoods(result, values))

    assert "never fell" in sentence([-100, -90, -90])
    assert "fell at iteration 3 (by 2.2 %)" in sentence([-100, -90, -92, -80])
    assert "fell at iterations 2, 4 (most, by 3.0 %, at iteration 4)" in sentence(
        [-100, -101, -100, -103]
    )
    assert "one iteration only" in sentence([-5])
    assert "fell at iteration 3 (by 3.0 %)" in sentence([-100, float("nan"), -103])


def estimated_by(result, estimator):
    options = dataclasses.replace(result.options, estimator=estimator)
    return dataclasses.replace(result, options=options)


def test_the_curves_are_called_what_the_estimator_made_them(result):
    default = render_report(result)
    assert "Bound: log likelihood of the cells" in default
    assert "(5)" not in default
    for estimator in ("paper", "hit-ratio", "tracker"):
        printed = render_report(estimated_by(result, estimator))
        assert "Expected log likelihood, (5)" in printed
        assert "log likelihood of the cells" not in printed


def test_one_iteration_makes_no_curve(result):
    one = render_report(dataclasses.replace(result, iterations=result.iterations[:1]))
    assert 'class="curve"' not in one
    assert "The numbers" in one


def test_loops_in_words(result):
    sentence = loops_sentence(result)
    assert sentence == (
        "Places seen again: 1 of 4 closed a loop; the rest was refused: explains too little (2), "
        "other loops disagree (1)."
    )
    assert sentence in render_report(result)
    closed = dataclasses.replace(result, loops=result.loops[:1])
    assert loops_sentence(closed) == "Places seen again: 1 of 1 closed a loop."
    assert loops_sentence(dataclasses.replace(result, loops=[])) == ""


def test_one_snapshot_shows_no_evolution(result):
    assert "How the map evolved" in render_report(result)
    one = render_report(dataclasses.replace(result, snapshots=result.snapshots[:1]))
    assert "How the map evolved" not in one
    assert "Where most moved" in one


def learned_text(result):
    return re.sub(r"\s+", " ", " ".join(Page(learned_section(result)).text))


def test_what_was_learned_in_words(result):
    text = learned_text(result)
    assert "87.3 % hold something that stands still" in text
    assert "scatter by 1.7 cm" in text
    assert "0.5 s or less 60.0 % 3 s 30.0 % 45 s or more 10.0 %" in text
    assert "1 % or less 90.0 % 15 % or more 10.0 %" in text
    assert "90 % or less 25.0 % 99.8 % or more 75.0 %" in text  # the least first
    assert learned_section(result) in render_report(result)


def test_nothing_is_told_that_was_not_learned(result):
    assert learned_section(dataclasses.replace(result, learned={})) == ""
    still = dataclasses.replace(result, p_static=np.ones_like(result.p_static))
    assert "Only 0 beams met something moving" in learned_text(still)
    assert "or less 60.0 %" not in learned_text(still)
    uneven = dataclasses.replace(result, learned={**result.learned, "scatter": 0.0})
    assert "scatter" not in learned_text(uneven)


@pytest.mark.parametrize(
    "change",
    [
        {"iterations": [], "snapshots": [], "warnings": [], "stages": {}, "converged": False},
        {"stages": {"read": {"seconds": None, "peak_memory_bytes": None}}},
    ],
)
def test_a_report_of_less(result, change):
    Page(render_report(dataclasses.replace(result, **change)))


def test_a_map_that_nobody_looked_at_and_one_without_cells(result):
    for p in (np.full((5, 5), np.nan, np.float32), np.zeros((0, 0), np.float32)):
        empty = small_map(result, p)
        none = dataclasses.replace(result.evidence, thin=np.zeros(p.shape, bool))
        Page(render_report(dataclasses.replace(result, map=empty, raw_map=empty, evidence=none)))


def test_likelihoods_that_are_no_numbers_are_drawn_as_gaps(result):
    Page(render_report(with_likelihoods(result, [float("nan"), float("-inf"), -3.0])))


@pytest.mark.parametrize(
    ("function", "value", "text"),
    [
        ("duration_text", 0.0123, "0.012 s"),
        ("duration_text", 42.4, "42 s"),
        ("duration_text", 1.7e-5, "under 1 ms"),
        ("duration_text", 192.0, "3 min 12 s"),
        ("duration_text", 59.9, "1 min 0 s"),
        ("duration_text", 7260.0, "2 h 1 min"),
        ("share_text", 0.0, "0.0 %"),
        ("share_text", 0.00123, "0.12 %"),
        ("share_text", 0.1235, "12.3 %"),
        ("share_text", float("nan"), "unknown"),
        ("bytes_text", 45_600_000, "46 MB"),
        ("bytes_text", 2_345_000_000, "2.35 GB"),
        ("bytes_text", 0, "unknown"),
        ("number_text", None, "-"),
    ],
)
def test_numbers_in_words(function, value, text):
    assert getattr(tables, function)(value) == text


def test_what_was_guessed_is_told(page):
    text = "".join(page.text)
    assert "threshold how: 12 m repeats (919 x)" in text
    assert "bearings: -1.5708, 1.5708" in text
    assert "stamp goes back, 2 times: lines 88, 91" in text
    assert "ignored" not in text
