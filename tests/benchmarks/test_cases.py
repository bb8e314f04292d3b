import pytest
from cases import CASES, FAST_OR_FAR, GROUPS, MOVED, ONCE, POPULATED, TRAJECTORY, chosen


def test_names_are_unique_and_every_world_can_be_built():
    assert len({case.name for case in CASES}) == len(CASES)
    for case in CASES:
        assert case.group in GROUPS
        case.build()


def test_names_and_groups_choose_cases():
    assert {case.group for case in chosen([])} == {*GROUPS} - {MOVED, FAST_OR_FAR, TRAJECTORY}
    assert chosen(GROUPS) == list(CASES)
    assert {case.group for case in chosen([ONCE, "hall-15"])} == {ONCE, POPULATED}
    with pytest.raises(SystemExit, match="no case nowhere"):
        chosen(["nowhere"])
