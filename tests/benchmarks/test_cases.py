import math

import pytest
from cases import (
    CASES,
    EMPTY,
    FAST_OR_FAR,
    GROUPS,
    MOVED,
    ONCE,
    POPULATED,
    STOPS,
    TRAJECTORY,
    chosen,
    scaled_odometry,
)

from stillmap.sim import OdometryOptions


def test_names_are_unique_and_every_world_can_be_built() -> None:
    assert len({case.name for case in CASES}) == len(CASES)
    for case in CASES:
        assert case.group in GROUPS
        case.build()


def test_catalogue_covers_what_is_wanted() -> None:
    people = {case.build().crowd.people for case in CASES if case.group == POPULATED}
    assert min(people) == 5
    assert max(people) == 80
    lasers = [case.build().laser for case in CASES]
    assert {90, 180, 270, 360} == {round(math.degrees(laser.fov)) for laser in lasers}
    assert max(laser.beams for laser in lasers) == 1440
    assert {laser.range_noise for laser in lasers} >= {0.01, 0.02, 0.03, 0.05}
    assert {laser.max_range for laser in lasers} >= {5.0, 80.0}
    for case in CASES:
        crowd = case.build().crowd
        if case.group == STOPS:
            assert (crowd.stopping_share, crowd.min_stop, crowd.max_stop) == (1.0, 15.0, 60.0)
        if case.group != TRAJECTORY:
            assert (crowd.people == 0) == (case.group == EMPTY)


def test_names_and_groups_choose_cases() -> None:
    assert {case.group for case in chosen([])} == {*GROUPS} - {MOVED, FAST_OR_FAR, TRAJECTORY}
    assert chosen(GROUPS) == list(CASES)
    assert {case.group for case in chosen([ONCE, "hall-15"])} == {ONCE, POPULATED}
    with pytest.raises(SystemExit, match="no case nowhere"):
        chosen(["nowhere"])


def test_odometry_errors_are_scaled_and_geometry_is_not() -> None:
    changes = scaled_odometry(3.0, slip_rate=0.1)["odometry"]
    assert changes["drift_noise"] == pytest.approx(3 * OdometryOptions().drift_noise)
    assert changes["slip_rate"] == 0.1
    assert "wheel_base" not in changes
