"""Which pictures paint what moved: a board that goes along a wall, seen by a camera before it."""

from dataclasses import replace

import numpy as np
import pytest
from made_up_rooms import looking, rectangle

from stillmap.mesh import mover_colors
from stillmap.mesh.inputs import ObjectFrame, TrackedBox
from stillmap.mesh.mover_colors import assign_object_views
from stillmap.mesh.place import Background, ViewAssignment
from stillmap.mesh.reconstruction import ObjectShape
from stillmap.mesh.triangle_mesh import concatenate_meshes
from stillmap.tracking.boxes import Box

WALL = rectangle([-8.0, 4.0, -3.0], [16.0, 0, 0], [0, 0, 6.0], 24)
BOARD = rectangle([-0.25, 0.0, 0.0], [0.5, 0, 0], [0, 0, 1.0], 10)
WALLS, CLOTHES = (180, 170, 160), (200, 30, 40)
SPEED = 1.0  # m/s along x


@pytest.fixture(autouse=True)
def exact_outlines(monkeypatch):
    """Outlines are known exactly."""
    monkeypatch.setattr(mover_colors, "_OUTLINE_INSET", 0.0)
    monkeypatch.setattr(mover_colors, "OUTLINE_DRIFT", 0.0)


def thing(id=3, y=2.0):
    """A box of 0.5 by 0.2 m that is at x = 0 when time begins, and goes on."""
    seconds = np.array([0.0, 4.0])
    along = np.array([[0.0, y], [4.0 * SPEED, y]])
    ahead = np.array([[1.0, 0.0]] * 2)
    box = Box(id, seconds, along, ahead, SPEED * ahead, (0.25, 0.1), 0.5)
    return TrackedBox(box, np.array([-0.5, -0.5]), 1.0)


def shape(seconds=0.0):
    return ObjectShape(
        3, BOARD, ObjectFrame.from_track(thing()), False, seconds, (seconds, seconds)
    )


def view(number, seconds, place=(0.0, 0.0, 0.0)):
    at = looking(place, np.add(place, [0.0, 1, 0]))
    return replace(at, image=number, stamp_ns=round(1e9 * seconds))


def place_of(mesh=WALL, painter=1):
    n = len(mesh)
    of_all = np.full(n, painter, np.int32)
    p = np.ones(n, np.float32)
    return ViewAssignment(mesh, of_all, p, np.ones(n, np.bool_))


def pictures(gap=0.0, there=(0,), shift=0.0):
    """The pictures of views: in those named the board is where it is when time begins, moved by
    `shift` metres, with a gap in its middle through which the wall is seen."""

    def colours(one):
        out = np.full((300, 400, 3), WALLS, np.uint8)
        if one.image in there:
            x, z = (np.arange(400) - 199.5) / 150.0 - shift, (149.5 - np.arange(300)) / 150.0
            board = (np.abs(x) <= 0.25) & (np.abs(x) >= gap)
            out[np.ix_(np.abs(z) <= 0.5, board)] = CLOTHES
        return out

    return colours


def dress(views, place=None, colours=None, others=(), of=None):
    background = Background(place or place_of(), views, colours or pictures())
    things = [thing(), *others]
    return assign_object_views(of or shape(), background, things, 0)


def area_painted(found):
    areas = found[0].mesh.areas()
    return areas[found[0].view >= 0].sum()


def painted_at(found):
    """x and z of what is painted."""
    return found[0].mesh.centers[found[0].view >= 0][:, [0, 2]]


def test_a_thing_is_painted_by_what_shows_it():
    found = dress([view(0, 0.0), view(1, 30.0)])
    assert area_painted(found) == pytest.approx(0.5)
    assert [one.image for one in found[1]] == [0]
    # as if it had stood still
    np.testing.assert_allclose(
        found[1][0].to_camera(np.zeros((1, 3))), [[0.0, 0.5, 2.0]], atol=1e-9
    )


def test_and_more_of_it_the_farther_it_went(monkeypatch):
    monkeypatch.setattr(mover_colors, "_OUTLINE_INSET", 0.05)
    monkeypatch.setattr(mover_colors, "OUTLINE_DRIFT", 0.25)
    views, colours = [view(0, 0.0), view(1, 30.0)], pictures()
    still = dress(views, colours=colours)
    went = dress(views, colours=colours, of=shape(0.4))
    assert 0.0 < area_painted(went) < 0.6 * area_painted(still)


def test_what_looks_like_the_place_behind_is_not_painted(monkeypatch):
    found = dress([view(0, 0.0), view(1, 30.0)], colours=pictures(gap=0.04))
    x = np.abs(painted_at(found)[:, 0])
    assert 0.02 < x.min() < 0.07
    assert 0.4 < area_painted(found) < 0.46
    monkeypatch.setattr(mover_colors, "_MIN_BACKGROUND_DIFFERENCE", 0.0)
    monkeypatch.setattr(mover_colors, "_UNCERTAIN_INSET", 0.0)
    found = dress([view(0, 0.0), view(1, 30.0)], colours=pictures(gap=0.04))
    assert area_painted(found) == pytest.approx(0.5)


@pytest.mark.parametrize(("right", "painted"), [(-0.1, 0.45), (0.0, 0.0)], ids=["little", "half"])
def test_what_the_place_hides_is_not_painted(right, painted):
    """Nor what is beside it, where that is little."""
    pillar = rectangle([-0.5, 1.0, -1.0], [0.5 + right, 0, 0], [0, 0, 2.0])
    found = dress([view(0, 0.0), view(1, 30.0)], place_of(concatenate_meshes([WALL, pillar])))
    assert (painted_at(found)[:, 0] > 2.0 * right).all()
    assert area_painted(found) == pytest.approx(painted, abs=0.03)


def test_pictures_taken_too_late_do_not_paint(monkeypatch):
    views = [view(0, 0.6), view(1, 30.0)]
    colours = pictures(shift=0.6)
    assert area_painted(dress(views, colours=colours)) == 0.0
    monkeypatch.setattr(mover_colors, "IMAGE_WINDOW", 0.7)
    assert area_painted(dress(views, colours=colours)) == pytest.approx(0.5)
