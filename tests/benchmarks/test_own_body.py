"""How many returns of the robot itself are found."""

import own_body


def test_a_roof_is_found_and_nothing_else():
    lidar = {"channels": 16, "sees_robot": True, "roof_length": 4.0, "roof_width": 1.7}
    found = own_body.outcome("street", 0, lidar, {"scans": 60})
    assert found.found == found.own > 1000
    assert found.lost == 0 < found.others


def test_who_stands_loses_nothing():
    lidar = {"channels": 16, "sees_robot": True, "roof_length": 4.0, "roof_width": 1.7}
    standing = own_body.outcome("street", 0, lidar, {"scans": 30, "speed": 1e-3})
    assert standing.found == standing.lost == 0 < standing.own
