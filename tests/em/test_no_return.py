"""Where the map has nothing but the word of beams without a return."""

from dataclasses import replace

import numpy as np
import pytest
from made_up import FAR, RESOLUTION, ROOM, Ball, Wall, at, watch
from recordings import of_one_sensor

from stillmap import _core, em
from stillmap.core import chunks


def with_lost(seen, lost, length=FAR):
    """The same recording with these beams without a return."""
    r = seen.recording
    u = r.points / np.linalg.norm(r.points, axis=1)[:, None]
    points = np.where(lost[:, None], length * u, r.points).astype(np.float32)
    recording = replace(r, points=points, hit=r.hit & ~lost)
    return replace(seen, recording=recording, what=np.where(lost, -1, seen.what))


def room_with():
    """Three walls about the sensor, at 4 and 3 metres; the fourth side is open behind it."""
    return watch(ROOM, 20)


def known(seen, threads=1):
    """The map, look-ups of values at points, and the trust in beams without a return."""
    found = seen.e_step()
    grid = _core.OccupancyGrid2D(RESOLUTION)
    e, no_return = found.p_static, found.no_return
    observed = em.add_trusted_beams(grid, seen.recording, seen.poses, e, no_return, threads)
    for a, b in zip(grid.dense(), seen.grid(e).dense(), strict=True):
        np.testing.assert_array_equal(a, b)
    m = em.make_occupancy_map(grid, found.occupied, observed)

    def p_occupied(*points):
        return at(m, points)

    def beta(*points):
        return grid.alpha_beta(np.floor(np.array(points) / RESOLUTION).astype(np.int64))[:, 1]

    return p_occupied, beta, found.learned["no_return_trusted"], m


def test_a_lone_beam_without_return_shows_nothing():
    seen = room_with()
    p_occupied, beta, _, _ = known(with_lost(seen, np.arange(len(seen.what)) % 181 == 90))
    assert np.isnan(p_occupied((5.05, 0.05), (20.05, 0.05))).all()
    assert (beta((5.05, 0.05), (20.05, 0.05)) > 10).all()
    assert p_occupied((2.05, 0.05)) < 0.1  # its neighbours see these cells too
    assert p_occupied((4.05, 0.35)) > 0.8


def test_neighbouring_beams_show_free_space_in_the_open():
    # a wall on one side only: all other beams are in the open
    seen = watch([Wall((0, 1), 3.0)], 20)
    p_occupied, beta, trust, _ = known(seen)
    assert trust > 0.9
    free = p_occupied((2.05, -1.05), (20.05, 0.05), (5.05, -12.05))
    assert (free < 0.1).all()
    # the last 0.3 m say nothing
    assert np.isnan(p_occupied((29.85, 0.05)))
    assert beta((29.85, 0.05)) > 0


def test_neighbouring_beams_show_nothing_behind_a_wall():
    # a few beams miss their return at the wall, most are in the open
    seen = watch([Wall((1, 0), 4.0, width=0.6), Wall((0, 1), 3.0)], 40)
    scan, beam = np.divmod(np.arange(len(seen.what)), 181)
    p_occupied, beta, trust, _ = known(with_lost(seen, (scan % 20 == 3) & (np.abs(beam - 90) < 4)))
    assert trust > 0.9
    assert np.isnan(p_occupied((6.05, 0.05), (20.05, 0.05))).all()
    assert (beta((6.05, 0.05), (20.05, 0.05)) > 0).all()
    assert p_occupied((20.05, -5.05)) < 0.1


def test_nothing_is_shown_where_walls_swallow_beams():
    # glass: half of the beams on the wall ahead have no return, as those in the gap beside it
    seen = watch([Wall((1, 0), 4.0, width=2.0), Wall((0, 1), 3.0), Wall((0, -1), 3.0)], 40)
    scan, beam = np.divmod(np.arange(len(seen.what)), 181)
    p_occupied, beta, trust, _ = known(with_lost(seen, (scan % 2 == 0) & (np.abs(beam - 90) < 24)))
    assert trust < 0.5
    outside = (6.05, 0.05), (20.05, 0.05), (6.05, 3.35)
    assert np.isnan(p_occupied(*outside)).all()
    assert (beta(*outside[:2]) > 0).all()
    inside = p_occupied((1.05, 0.05), (3.55, 0.05), (2.05, -1.05))
    assert (inside < 0.1).all()


@pytest.mark.parametrize(("threads", "beams"), [(1, 1), (3, 500)])
def test_chunks_and_threads_change_no_bit(monkeypatch, threads, beams):
    seen = room_with()
    seen = with_lost(seen, np.random.default_rng(1).random(len(seen.what)) < 0.2)
    once = known(seen)[3].p_occupied
    monkeypatch.setattr(chunks, "CHUNK_BEAMS", beams)
    np.testing.assert_array_equal(known(seen, threads)[3].p_occupied, once)


@pytest.mark.parametrize("estimator", ["paper", "hit-ratio", "tracker"])
def test_other_estimators_count_every_beam(estimator):
    seen = room_with()
    found = seen.e_step(estimator=estimator)
    assert found.no_return is None
    grid = _core.OccupancyGrid2D(RESOLUTION)
    e = found.p_static
    assert em.add_trusted_beams(grid, seen.recording, seen.poses, e, None) is None
    np.testing.assert_array_equal(grid.dense()[2], seen.grid(e).dense()[2])


def test_scans_without_a_single_return_say_nothing_of_walls():
    """A sensor that is blind for a while neither clears walls nor spoils the trust in the rest."""
    seen = room_with()
    blinded = with_lost(seen, (np.arange(len(seen.what)) // 181) % 2 == 0)
    hit = blinded.recording.hit
    for found in (seen.e_step(), blinded.e_step()):
        assert (found.p_static[hit] > 0.9).mean() > 0.98


def test_a_blind_sensor_says_nothing():
    """Labels are those of the recording without the scans in which nothing returned."""
    seen = watch([Wall((1, 0), 4.0, width=1.5), Ball(2.0, -1.0, 10, 25)], 90)
    scan = np.arange(len(seen.what)) // 181
    blind = (scan >= 30) & (scan < 60)
    found = with_lost(seen, blind).e_step()
    r, kept = seen.recording, np.r_[0:30, 60:90]
    without = of_one_sensor(r.stamp_ns[kept], np.arange(61) * 181, r.points[~blind], r.hit[~blind])
    other = replace(seen, recording=without, what=seen.what[~blind]).e_step()
    np.testing.assert_array_equal(found.p_static[~blind], other.p_static)


def test_scans_without_a_return_count_in_the_open():
    """Objects that pass one after another are dynamic, since scans without a return miss them."""
    passing = [Ball(3.0, 0.2 * k, 10 + k, 11 + k) for k in range(8)]
    seen = watch([*passing, Ball(4.0, -2.0, 40, 60)], 90)
    assert seen.of(seen.e_step().p_static, *range(len(passing) + 1)).max() < 0.5
