"""What scans say of the priors they are registered with."""

import dataclasses

import numpy as np
import pytest

from stillmap.core import se2
from stillmap.sim.walls import box
from stillmap.slam.front_end import FrontEnd
from stillmap.slam.motion_model import gaussian_prior
from stillmap.slam.options import OdometryOptions
from stillmap.slam.scan_hits import make_scan
from stillmap.slam.scan_matching import accept_prior


@pytest.mark.parametrize(
    ("explained", "std", "confirms"),
    [(0.85, 0.3, True), (0.75, 0.3, False), (0.75, 0.1, True), (0.60, 0.1, False)],
)
def test_a_scan_confirms_where_its_prior_leads(explained, std, confirms):
    front_end = FrontEnd(OdometryOptions())
    front_end.usual[0] = 0.9
    prior = gaussian_prior(se2.matrix(3.0, 0.0, 0.5), std, 0.1, is_odometry=True)
    match = dataclasses.replace(accept_prior(prior), explained=explained)
    assert front_end.confirms(prior, match, 0) == confirms


@pytest.mark.parametrize("is_late", [True, False])
def test_odometry_that_was_late_leads_to_its_next_scan(mapped, scan, is_late):
    # in a room that looks alike from both ends, 2 rad to the left or 1.14 to the right
    walls = np.array(box(0.0, 0.0, 7.0, 4.0))
    ends = scan(walls, (0.0, 0.0, 2.0))
    turned, still, hits = se2.matrix(0.0, 0.0, 2.0), np.eye(3), np.ones(len(ends), np.float32)
    front_end = FrontEnd(OdometryOptions())
    # what odometry says of the step before, which the robot makes now
    front_end.follow_odometry(turned if is_late else still, learned=False)
    front_end.advance(still, is_fault=is_late)
    prior = front_end.follow_odometry(still, learned=False)
    seen, grid, before = make_scan(ends, hits, np.eye(3)), mapped(walls), front_end.predict()
    match, poor = front_end.match(grid, seen, 0, prior, prior, before)
    assert poor
    match, _ = front_end.search_wider(grid, seen, 0, prior, before, match)
    x, y, heading = se2.parameters(match.T_map_base)
    assert np.hypot(x, y) < 0.05
    assert heading == pytest.approx(2.0 if is_late else 2.0 - np.pi, abs=0.02)
