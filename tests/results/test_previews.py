"""Previews of models in the report."""

import base64
import io
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stillmap.results.report.page import environment, render_report
from stillmap.results.report.previews import (
    MAX_OBJECTS,
    models_data,
    render_object,
    render_previews,
)

sys.path.insert(0, str(Path(__file__).resolve().parent))

from made_up_room import quad, room, together, turning, wall_page


def models_html(previews):
    """The section on models."""
    return environment().get_template("models.html.j2").render(models=models_data(previews))


def magenta(picture):
    red, green, blue = np.moveaxis(picture.astype(int), -1, 0)
    return float(((red > green + 80) & (blue > green + 80)).mean())


@pytest.fixture(scope="module")
def thing():
    """A board of 1 x 2 m that faces x, in cyan."""
    front = quad([(0, -0.5, 0), (0, 0.5, 0), (0, 0.5, 2), (0, -0.5, 2)], 0)
    return together([front], [wall_page((0, 250, 250))])


@pytest.fixture(scope="module")
def previews(thing):
    return render_previews(room(), room(person=True), turning(40), {7: thing})


def test_views_show_where_an_object_was_removed(previews):
    captions = [one.caption for one in previews.place]
    assert captions == ["view of the robot's camera"] * 2 + ["overview"]
    assert magenta(previews.place[0].sharpest) > 0.03
    assert all(magenta(one.filtered) == 0.0 for one in previews.place)
    assert not np.array_equal(previews.place[0].filtered, previews.place[1].filtered)


def test_overview_looks_into_the_room(previews):
    picture = previews.place[-1].filtered.astype(int)
    assert (
        picture[..., 1] - picture[..., 0] > 60
    ).mean() > 0.02  # the green wall, behind the near one
    assert (picture[..., 2] - picture[..., 0] > 40).mean() > 0.01  # the blue one


def test_untextured_share(previews):
    walls, rest = 2 * 3.0 * (6.0 + 4.0), 2 * 6.0 * 4.0
    assert previews.untextured == pytest.approx(rest / (walls + rest))
    assert "44.4 % of the surface" in models_html(previews)


def test_without_sharpest_texture_there_is_one_image_per_view():
    previews = render_previews(room(), None, turning(40), {})
    assert [one.sharpest for one in previews.place] == [None] * 3
    section = models_html(previews)
    assert section.count("<img") == 3
    assert "Sharpest" not in section


def test_model_without_images_has_an_overview():
    previews = render_previews(room(), None, np.zeros((0, 4, 4)), {})
    assert [one.caption for one in previews.place] == ["overview"]


def cyan(picture):
    return float(((picture[..., 1] > 100) & (picture[..., 0] < 60)).mean())


def test_objects_are_seen_from_their_front_faces(thing):
    previews = render_object(7, thing)
    assert list(previews.sides) == ["front", "left"]
    ahead, left = (cyan(one) for one in previews.sides.values())
    assert ahead > 0.1
    assert 0.0 < left < 0.6 * ahead
    for one in previews.sides.values():
        edge = np.concatenate([one[0], one[-1], one[:, 0], one[:, -1]])
        assert (edge == one[0, 0]).all()  # it is whole in the picture


def box_with(sides):
    """A car of 4 x 2 x 1 m, of which some sides were seen, each in a colour of its own."""
    x, y, z = 2.0, 1.0, 1.0
    round_it = {
        "ahead": [(x, -y, 0), (x, y, 0), (x, y, z), (x, -y, z)],
        "left": [(x, y, 0), (-x, y, 0), (-x, y, z), (x, y, z)],
        "behind": [(-x, y, 0), (-x, -y, 0), (-x, -y, z), (-x, y, z)],
        "right": [(-x, -y, 0), (x, -y, 0), (x, -y, z), (-x, -y, z)],
    }
    tones = {"ahead": (0, 250, 250), "left": (250, 0, 0), "behind": (0, 0, 250), "right": (9, 9, 9)}
    quads = [quad(round_it[side], n) for n, side in enumerate(sides)]
    return together(quads, [np.full((8, 8, 3), tones[side], np.uint8) for side in sides])


@pytest.mark.parametrize(
    ("sides", "shown"),
    [
        (["right"], ["front", "rear", "right"]),
        (["left", "behind"], ["left", "rear"]),
        (["ahead", "left", "behind", "right"], ["front", "left", "rear"]),
    ],
)
def test_sides_of_mostly_back_faces_are_left_out(sides, shown):
    assert list(render_object(0, box_with(sides)).sides) == shown


def test_back_faces_are_not_drawn():
    """Else one would read a number plate from inside the car."""
    previews = render_object(0, box_with(["ahead", "left", "behind"]))
    red = {
        side: float(((one[..., 0] > 200) & (one[..., 1] < 60)).mean())
        for side, one in previews.sides.items()
    }
    assert red["left"] > 0.1
    assert red["front"] == 0.0


def test_captions_give_the_size(previews):
    text = models_html(replace(previews, objects=[render_object(3, box_with(["right"]))]))
    assert "<b>Object 3</b>: 4.00 x 0.00 x 1.00 m, front<" in text
    assert text.count("<b>Object 3</b>") == 3


def test_distant_islands_do_not_shrink_the_overview():
    """A street of 40 x 10 m, and two islands of a square metre a long way off."""

    def floor(x, y, length, width, page):
        corners = [(x, y), (x + length, y), (x + length, y + width), (x, y + width)]
        return quad([(*corner, 0.0) for corner in corners], page)

    tiles = [floor(x, y, 2.0, 2.0, 0) for x in range(-20, 20, 2) for y in range(-5, 5, 2)]
    islands = [floor(150.0, 90.0, 1.0, 1.0, 0), floor(-160.0, -40.0, 1.0, 1.0, 0)]
    alone, all_ = (
        render_previews(together(quads, [wall_page((250, 0, 0))]), None, turning(0), {}).place[-1]
        for quads in (tiles, tiles + islands)
    )
    share = [
        float((one.filtered[..., 0] > one.filtered[..., 1] + 50).mean()) for one in (alone, all_)
    ]
    assert share[0] > 0.2
    assert share[1] > 0.9 * share[0]


@pytest.mark.parametrize(
    ("unusable", "unread", "reason"),
    [
        ({}, 0, "without texture: there are no images."),
        (
            {"a camera without a lens": 1200, "taken where the poses leap": 3},
            0,
            "without texture: none of the 1,203 images can be used "
            "(1,200: a camera without a lens; 3: taken where the poses leap).",
        ),
        ({}, 2, "without texture: none of the 2 images can be used (2: damaged)."),
    ],
)
def test_reason_for_a_surface_without_texture(unusable, unread, reason):
    bare = replace(room(), page=np.full(12, -1, np.int32), pages=())
    bare = replace(bare, unread=tuple(["is damaged"] * unread))
    text = models_html(render_previews(bare, None, turning(unread), {}, unusable=unusable))
    assert reason in text
    assert "<b>Surface</b>: overview" in text
    assert "Filtered" not in text
    assert "no such image" not in text


def test_usable_images_that_show_nothing():
    bare = replace(room(), page=np.full(12, -1, np.int32), pages=())
    text = models_html(render_previews(bare, None, turning(3), {}, unusable={"a camera": 2}))
    assert "100.0 % of the surface" in text
    assert "without texture" not in text


def test_number_of_objects_is_limited(thing):
    many = dict.fromkeys(range(MAX_OBJECTS + 3), thing)
    previews = render_previews(room(), None, turning(4), many)
    assert [one.number for one in previews.objects] == list(range(MAX_OBJECTS))


def test_best_textured_objects_come_first(thing):
    bare = replace(thing, page=np.full_like(thing.page, -1))
    large = replace(bare, vertices=2.0 * bare.vertices)
    previews = render_previews(room(), None, turning(4), {1: bare, 2: large, 3: thing})
    assert [one.number for one in previews.objects] == [3, 2, 1]


def test_previews_are_inline(result, previews):
    page = render_report(result, previews=previews)
    assert ">Models</h2>" in page
    found = re.findall(r'class="preview" src="data:image/jpeg;base64,([^"]+)"', page)
    assert len(found) == 2 * len(previews.place) + 2
    sizes = [Image.open(io.BytesIO(base64.b64decode(one))).size for one in found]
    assert sizes == [(640, 400)] * 6 + [(300, 225)] * 2
    assert not re.search(r'(src|href)="(?!data:|#)', page)


def test_size_is_limited(previews):
    """Of noise, the worst there is, and as many as there can be."""
    rng = np.random.default_rng(0)

    def noise(picture):
        return rng.integers(0, 255, picture.shape).astype(np.uint8)

    place = [
        replace(one, filtered=noise(one.filtered), sharpest=noise(one.filtered))
        for one in previews.place
    ]
    full = render_object(0, box_with(["right"]))
    full = replace(full, sides={side: noise(one) for side, one in full.sides.items()})
    assert len(full.sides) == 3
    worst = replace(
        previews, place=place, objects=[replace(full, number=n) for n in range(MAX_OBJECTS)]
    )
    assert len(models_html(worst)) < 5_000_000


def test_without_models_there_is_no_section(result):
    assert models_html(None).strip() == ""
    assert "<h2>Models</h2>" not in render_report(result)
