"""The report's stills of models."""

import base64
import io
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stillmap.results.report.page import render_report
from stillmap.results.report.previews import (
    MOST_OBJECTS,
    model_section,
    render_object,
    render_previews,
)

sys.path.insert(0, str(Path(__file__).resolve().parent))

from made_up_room import quad, room, together, turning, wall_page


def magenta(picture):
    red, green, blue = np.moveaxis(picture.astype(int), -1, 0)
    return float(((red > green + 80) & (blue > green + 80)).mean())


@pytest.fixture(scope="module")
def thing():
    """A board of 1 x 2 m that faces x, in cyan."""
    front = quad([(0, -0.5, 0), (0, 0.5, 0), (0, 0.5, 2), (0, -0.5, 2)], 0)
    return together([front], [wall_page((0, 250, 250))])


@pytest.fixture(scope="module")
def stills(thing):
    return render_previews(room(), room(person=True), turning(40), {7: thing})


def test_the_place_is_shown_where_somebody_stood(stills):
    captions = [one.caption for one in stills.place]
    assert captions == ["where the robot looked"] * 2 + ["from above"]
    assert magenta(stills.place[0].sharpest) > 0.03
    assert all(magenta(one.filtered) == 0.0 for one in stills.place)
    assert not np.array_equal(stills.place[0].filtered, stills.place[1].filtered)


def test_from_above_one_looks_into_the_room(stills):
    picture = stills.place[-1].filtered.astype(int)
    assert (
        picture[..., 1] - picture[..., 0] > 60
    ).mean() > 0.02  # the green wall, behind the near one
    assert (picture[..., 2] - picture[..., 0] > 40).mean() > 0.01  # the blue one


def test_how_much_is_grey_is_told(stills):
    walls, rest = 2 * 3.0 * (6.0 + 4.0), 2 * 6.0 * 4.0
    assert stills.unpainted == pytest.approx(rest / (walls + rest))
    assert "44.4 % of the surface" in model_section(stills)


def test_without_the_sharpest_there_is_one_picture_each():
    stills = render_previews(room(), None, turning(40), {})
    assert [one.sharpest for one in stills.place] == [None] * 3
    section = model_section(stills)
    assert section.count("<img") == 3
    assert "Sharpest" not in section


def test_a_model_without_pictures_is_seen_from_above():
    stills = render_previews(room(), None, np.zeros((0, 4, 4)), {})
    assert [one.caption for one in stills.place] == ["from above"]


def cyan(picture):
    return float(((picture[..., 1] > 100) & (picture[..., 0] < 60)).mean())


def test_objects_are_seen_from_their_fronts(thing):
    stills = render_object(7, thing)
    assert list(stills.sides) == ["from ahead", "from its left"]
    ahead, left = (cyan(one) for one in stills.sides.values())
    assert ahead > 0.1
    assert 0.0 < left < 0.6 * ahead
    for one in stills.sides.values():
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
        (["right"], ["from ahead", "from behind", "from its right"]),
        (["left", "behind"], ["from its left", "from behind"]),
        (["ahead", "left", "behind", "right"], ["from ahead", "from its left", "from behind"]),
    ],
)
def test_a_side_that_shows_backs_is_left_out(sides, shown):
    assert list(render_object(0, box_with(sides)).sides) == shown


def test_backs_are_never_drawn():
    """Else one would read a number plate from inside the car."""
    stills = render_object(0, box_with(["ahead", "left", "behind"]))
    red = {
        side: float(((one[..., 0] > 200) & (one[..., 1] < 60)).mean())
        for side, one in stills.sides.items()
    }
    assert red["from its left"] > 0.1
    assert red["from ahead"] == 0.0


def test_captions_say_how_large_an_object_is(stills):
    text = model_section(replace(stills, objects=[render_object(3, box_with(["right"]))]))
    assert "<b>Object 3</b>: 4.00 x 0.00 x 1.00 m, from ahead<" in text
    assert text.count("<b>Object 3</b>") == 3


def test_what_lies_far_out_makes_nothing_small():
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
    ("left_out", "unread", "said"),
    [
        ({}, 0, "It is grey: there are no pictures."),
        (
            {"a camera without a lens": 1200, "taken where the poses leap": 3},
            0,
            "It is grey: none of the 1,203 pictures can be used "
            "(1,200: a camera without a lens; 3: taken where the poses leap).",
        ),
        ({}, 2, "It is grey: none of the 2 pictures can be used (2: damaged)."),
    ],
)
def test_without_pictures_nothing_is_called_filtered(left_out, unread, said):
    bare = replace(room(), page=np.full(12, -1, np.int32), pages=())
    bare = replace(bare, unread=tuple(["is damaged"] * unread))
    text = model_section(render_previews(bare, None, turning(unread), {}, left_out=left_out))
    assert said in text
    assert "<b>Surface</b>: from above" in text
    assert "Filtered" not in text
    assert "nobody before it" not in text


def test_pictures_that_show_nothing_are_still_pictures():
    bare = replace(room(), page=np.full(12, -1, np.int32), pages=())
    text = model_section(render_previews(bare, None, turning(3), {}, left_out={"a camera": 2}))
    assert "100.0 % of the surface" in text
    assert "It is grey:" not in text


def test_some_objects_are_enough(thing):
    many = dict.fromkeys(range(MOST_OBJECTS + 3), thing)
    stills = render_previews(room(), None, turning(4), many)
    assert [one.number for one in stills.objects] == list(range(MOST_OBJECTS))


def test_those_that_are_painted_most_come_first(thing):
    bare = replace(thing, page=np.full_like(thing.page, -1))
    large = replace(bare, vertices=2.0 * bare.vertices)
    stills = render_previews(room(), None, turning(4), {1: bare, 2: large, 3: thing})
    assert [one.number for one in stills.objects] == [3, 2, 1]


def test_the_pictures_lie_in_the_page(result, stills):
    page = render_report(result, stills=stills)
    assert "What it looks like" in page
    found = re.findall(r'class="still" src="data:image/jpeg;base64,([^"]+)"', page)
    assert len(found) == 2 * len(stills.place) + 2
    sizes = [Image.open(io.BytesIO(base64.b64decode(one))).size for one in found]
    assert sizes == [(640, 400)] * 6 + [(300, 225)] * 2
    assert not re.search(r'(src|href)="(?!data:|#)', page)


def test_they_stay_small(stills):
    """Of noise, the worst there is, and as many as there can be."""
    rng = np.random.default_rng(0)

    def noise(picture):
        return rng.integers(0, 255, picture.shape).astype(np.uint8)

    place = [
        replace(one, filtered=noise(one.filtered), sharpest=noise(one.filtered))
        for one in stills.place
    ]
    full = render_object(0, box_with(["right"]))
    full = replace(full, sides={side: noise(one) for side, one in full.sides.items()})
    assert len(full.sides) == 3
    worst = replace(
        stills, place=place, objects=[replace(full, number=n) for n in range(MOST_OBJECTS)]
    )
    assert len(model_section(worst)) < 5_000_000


def test_without_models_nothing_is_said(result):
    assert model_section(None) == ""
    assert "What it looks like" not in render_report(result)
