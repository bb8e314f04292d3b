"""Which recordings are parts of one run, decided by their facts alone."""

from dataclasses import replace

import numpy as np
import pytest
from cut_recordings import START, cut, make_recording

from stillmap.core import se2
from stillmap.io.parts.facts import measure_facts
from stillmap.io.parts.grouping import group_parts
from stillmap.io.parts.seams import compare


def facts_of(recording, *spans):
    return [
        measure_facts(cut(recording, first, last), f"part_{number}")
        for number, (first, last) in enumerate(spans)
    ]


def members(facts):
    return [group.members for group in group_parts(facts)]


def moved(recording, xyt):
    """The same recording with odometry that begins elsewhere."""
    return replace(recording, T_odom_base=se2.matrix(*xyt) @ recording.T_odom_base)


def test_parts_are_found_in_any_order(drive):
    spans = ((0.0, 1.9), (2.0, 3.9), (4.0, 5.9))
    facts = facts_of(drive, *spans)
    for order in ((0, 1, 2), (2, 0, 1), (1, 2, 0)):
        [group] = group_parts([facts[k] for k in order])
        assert [order[k] for k in group.members] == [0, 1, 2]
        assert group.kind == "parts"
    assert group.why == (
        "part_1 begins 0.10 s after part_0 ends, odometry 0.05 m apart; "
        "part_2 begins 0.10 s after part_1 ends, odometry 0.05 m apart"
    )


@pytest.mark.parametrize("odometry", [True, False])
def test_a_pause_of_a_second_is_bridged_and_one_of_a_day_is_not(odometry):
    whole = make_recording(odometry=odometry)
    assert members(facts_of(whole, (0.0, 1.9), (2.9, 5.9))) == [(0, 1)]
    today, tomorrow = (
        measure_facts(make_recording(odometry=odometry, start=start), name)
        for start, name in ((START, "today"), (START + 86400, "tomorrow"))
    )
    assert members([today, tomorrow]) == [(0,), (1,)]
    assert compare(today, tomorrow) == "begins 24.0 h after today ends"


def test_a_pause_as_long_as_those_within_is_bridged(drive):
    pausing = drive.stamp_ns + 8 * 10**9 * (np.arange(drive.n_scans) // 20)
    late = replace(drive, stamp_ns=pausing)
    first, second, third = (cut(late, *span) for span in ((0, 5), (5, 15), (15, 99)))
    assert first.n_scans == second.n_scans == third.n_scans == 20
    without = [
        measure_facts(one.without_odometry(), str(k)) for k, one in enumerate((first, second))
    ]
    assert members(without) == [(0,), (1,)]  # neither has a pause
    both = cut(late, 0.0, 15.0)
    again = [measure_facts(one, str(k)) for k, one in enumerate((both, third))]
    assert members([replace(one, T_odom_base=None) for one in again]) == [(0, 1)]


@pytest.mark.parametrize("pause", [30.0, 90.0])
def test_odometry_bridges_a_pause_of_sparse_scans(drive, pause):
    stamp_ns = drive.stamp_ns[0] + 2 * 10**9 * np.arange(60)
    later = np.arange(60) >= 30
    sparse = replace(drive, stamp_ns=stamp_ns + int(1e9 * (pause - 2.0)) * later)
    first, second = cut(sparse, 0.0, 59.0), cut(sparse, 60.0, 999.0)
    both = [measure_facts(one, name) for one, name in ((first, "a"), (second, "b"))]
    assert (len(members(both)) == 1) == (pause < 60.0)
    assert len(members([replace(one, T_odom_base=None) for one in both])) == 2
    far = replace(both[1], T_odom_base=se2.matrix(20.0, 0.0, 0.0) @ both[1].T_odom_base)
    assert len(members([both[0], far])) == 2


def test_odometry_that_starts_anew_begins_a_session(drive):
    first, second = cut(drive, 0.0, 2.9), cut(drive, 3.0, 5.9)
    anew = replace(second, T_odom_base=se2.inverse(second.T_odom_base[:1]) @ second.T_odom_base)
    facts = [measure_facts(one, name) for one, name in ((first, "a"), (anew, "b"))]
    assert members(facts) == [(0,), (1,)]
    assert group_parts(facts)[1].why.startswith("b has odometry that begins 1.4")
    facts = facts_of(drive, (0.0, 0.3), (0.4, 5.9))  # the robot could have come back
    assert members(facts) == [(0, 1)]
    zero = se2.inverse(facts[1].T_odom_base[:1]) @ facts[1].T_odom_base
    anew = replace(facts[1], T_odom_base=zero)
    assert members([facts[0], anew]) == [(0,), (1,)]
    still = replace(facts[0], T_odom_base=np.tile(np.eye(3), (4, 1, 1)))
    assert members([still, anew]) == [(0, 1)]
    facts = [measure_facts(first, "a"), facts[1]]
    turned = replace(second, T_odom_base=second.T_odom_base @ se2.matrix(0.0, 0.0, 2.0))
    facts[1] = measure_facts(turned, "b")
    assert group_parts(facts)[1].why == "b has odometry turned by 115 degrees against the end of a"


def test_a_fast_robot_goes_farther_in_a_pause():
    whole = make_recording(speed=20.0)  # m/s
    assert members(facts_of(whole, (0.0, 1.9), (2.9, 5.9))) == [(0, 1)]
    slow = make_recording()
    first, second = cut(slow, 0.0, 1.9), moved(cut(slow, 2.9, 5.9), (20.0, 0.0, 0.0))
    assert members([measure_facts(one, "") for one in (first, second)]) == [(0,), (1,)]


def test_repeated_scans_join_and_other_scans_of_the_same_time_do_not(drive):
    facts = facts_of(drive, (0.0, 3.9), (2.0, 5.9))
    [group] = group_parts(facts)
    assert group.why == "part_1 repeats the last 20 scans of part_0, odometry 0.00 m apart"
    other = make_recording(seed=4)  # another robot, with the same clock
    for way in (other, moved(other, (5.0, 0.0, 0.0)), other.without_odometry()):
        mine = drive if way.T_odom_base is not None else drive.without_odometry()
        pair = [measure_facts(one, name) for one, name in ((mine, "mine"), (way, "other"))]
        assert members(pair) == [(0,), (1,)]
        assert group_parts(pair)[1].why == "other is of the same time as mine, with other scans"
    late = measure_facts(cut(other, 2.0, 5.9), "other")
    assert members([facts[0], late]) == [(0,), (1,)]


def test_the_same_scans_with_another_odometry_are_no_parts(drive):
    corrected = moved(cut(drive, 2.0, 5.9), (3.0, 0.0, 0.0))
    pair = [measure_facts(cut(drive, 0.0, 3.9), "a"), measure_facts(corrected, "b")]
    assert members(pair) == [(0,), (1,)]


def test_a_part_within_another_and_the_same_one_twice(drive):
    assert members(facts_of(drive, (0.0, 3.9), (1.0, 2.0), (4.0, 5.9))) == [(0, 1, 2)]
    assert members(facts_of(drive, (0.0, 5.9), (0.0, 5.9))) == [(0, 1)]


def test_two_robots_of_two_parts_each(drive):
    other = moved(make_recording(seed=4), (8.0, 3.0, 1.0))
    facts = [
        *facts_of(drive, (0.0, 2.9), (3.0, 5.9)),
        *facts_of(other, (0.0, 2.9), (3.0, 5.9)),
    ]
    assert members([facts[k] for k in (3, 0, 2, 1)]) == [(2, 0), (1, 3)]


def test_what_differs_in_kind_is_a_session(drive):
    first, second = cut(drive, 0.0, 2.9), cut(drive, 3.0, 5.9)
    a = measure_facts(first, "a")
    space = measure_facts(cut(make_recording(3), 3.0, 5.9), "b")
    assert compare(a, space) == "is 3D, a is 2D"
    bare = measure_facts(second.without_odometry(), "b")
    assert compare(a, bare) == "has no odometry, a has"
    assert compare(replace(a, T_odom_base=None), measure_facts(second, "b")) == (
        "has odometry, a has none"
    )
    noted = {"sensors": [{"name": "/front"}]}
    named = measure_facts(replace(second, source=noted), "b")
    assert "scans of /front" in compare(a, named)
    mounted = replace(second, T_base_sensor=se2.matrix(0.3, 0.0, 0.0)[None])
    assert "at another place on the robot" in compare(a, measure_facts(mounted, "b"))
    # a default is no statement of the recording
    guessed = {"sensors": [{"extrinsics": {"how": "the robot's center"}}]}
    assert not isinstance(compare(a, measure_facts(replace(mounted, source=guessed), "b")), str)
    fewer = replace(
        second,
        offset=np.arange(second.n_scans + 1) * 8,
        points=second.points[: second.n_scans * 8],
        hit=second.hit[: second.n_scans * 8],
    )
    assert compare(a, measure_facts(fewer, "b")) == "has 8 beams per scan, a has 16"


def test_single_scans_without_stamps_are_no_parts():
    whole = make_recording(3, scans=1, start=0, odometry=False)
    other = make_recording(3, scans=1, start=0, odometry=False, seed=5)
    assert members([measure_facts(one, "") for one in (whole, other)]) == [(0,), (1,)]
    assert [group.why for group in group_parts([measure_facts(whole, "")])] == ["the only input"]
