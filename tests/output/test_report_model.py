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

from stillmap.output.report import report_html
from stillmap.output.report_model import MOST_OBJECTS, model_section, object_stills, stills_of

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
    return stills_of(room(), room(person=True), turning(40), {7: thing})


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
    stills = stills_of(room(), None, turning(40), {})
    assert [one.sharpest for one in stills.place] == [None] * 3
    section = model_section(stills)
    assert section.count("<img") == 3
    assert "Sharpest" not in section


def test_a_model_without_pictures_is_seen_from_above():
    stills = stills_of(room(), None, np.zeros((0, 4, 4)), {})
    assert [one.caption for one in stills.place] == ["from above"]


def test_objects_are_seen_from_three_sides(thing):
    pictures = object_stills(thing)
    cyan = [((one[..., 1] > 100) & (one[..., 0] < 60)).mean() for one in pictures]
    assert len(pictures) == 3
    assert cyan[0] > 0.1
    assert cyan[1] < 0.6 * cyan[0]  # from its side
    for one in pictures:
        edge = np.concatenate([one[0], one[-1], one[:, 0], one[:, -1]])
        assert (edge == one[0, 0]).all()  # it is whole in the picture


def test_some_objects_are_enough(thing):
    many = dict.fromkeys(range(MOST_OBJECTS + 3), thing)
    stills = stills_of(room(), None, turning(4), many)
    assert [number for number, _ in stills.objects] == list(range(MOST_OBJECTS))


def test_those_that_are_painted_most_come_first(thing):
    bare = replace(thing, page=np.full_like(thing.page, -1))
    large = replace(bare, vertices=2.0 * bare.vertices)
    stills = stills_of(room(), None, turning(4), {1: bare, 2: large, 3: thing})
    assert [number for number, _ in stills.objects] == [3, 2, 1]


def test_the_pictures_lie_in_the_page(result, stills):
    page = report_html(result, stills=stills)
    assert "What it looks like" in page
    found = re.findall(r'class="still" src="data:image/jpeg;base64,([^"]+)"', page)
    assert len(found) == 2 * len(stills.place) + 3
    sizes = [Image.open(io.BytesIO(base64.b64decode(one))).size for one in found]
    assert sizes == [(640, 400)] * 6 + [(300, 225)] * 3
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
    sides = [noise(one) for one in stills.objects[0][1]]
    worst = replace(stills, place=place, objects=[(n, sides) for n in range(MOST_OBJECTS)])
    assert len(model_section(worst)) < 5_000_000


def test_without_models_nothing_is_said(result):
    assert model_section(None) == ""
    assert "What it looks like" not in report_html(result)
