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


@pytest.mark.parametrize(
    ("things", "is_lost", "is_trusted", "free", "unseen"),
    [
        # a lone one shows nothing; its neighbours see the cells before the wall too
        (ROOM, lambda _, beam: beam == 90, False, [(2.05, 0.05)], [(5.05, 0.05), (20.05, 0.05)]),
        # in the open neighbouring ones show free space, but for the last 0.3 m
        (
            [Wall((0, 1), 3.0)],
            lambda _, beam: beam < 0,
            True,
            [(2.05, -1.05), (20.05, 0.05), (5.05, -12.05)],
            [(29.85, 0.05)],
        ),
        # a few miss their return at a wall, most are in the open
        (
            [Wall((1, 0), 4.0, width=0.6), Wall((0, 1), 3.0)],
            lambda scan, beam: (scan % 20 == 3) & (np.abs(beam - 90) < 4),
            True,
            [(20.05, -5.05)],
            [(6.05, 0.05), (20.05, 0.05)],
        ),
        # glass: half of those on the wall ahead have no return, as those in the gap beside it
        (
            [Wall((1, 0), 4.0, width=2.0), *ROOM[1:]],
            lambda scan, beam: (scan % 2 == 0) & (np.abs(beam - 90) < 24),
            False,
            [(1.05, 0.05), (3.55, 0.05), (2.05, -1.05)],
            [(6.05, 0.05), (20.05, 0.05)],
        ),
    ],
)
def test_beams_without_a_return(things, is_lost, is_trusted, free, unseen):
    seen = watch(things, 40)
    lost = is_lost(*np.divmod(np.arange(len(seen.what)), 181))
    p_occupied, beta, trust, _ = known(with_lost(seen, lost))
    assert (trust > 0.5) == is_trusted
    assert (p_occupied(*free) < 0.1).all()
    assert np.isnan(p_occupied(*unseen)).all()
    assert (beta(*unseen) > 0).all()


@pytest.mark.parametrize(("threads", "beams"), [(1, 1), (3, 500)])
def test_chunks_and_threads_change_no_bit(monkeypatch, threads, beams):
    seen = room_with()
    seen = with_lost(seen, np.random.default_rng(1).random(len(seen.what)) < 0.2)
    once = known(seen)[3].p_occupied
    monkeypatch.setattr(chunks, "CHUNK_BEAMS", beams)
    np.testing.assert_array_equal(known(seen, threads)[3].p_occupied, once)


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
