"""What scans say of the priors they are registered with."""

import dataclasses

import pytest

from stillmap.core import se2
from stillmap.slam.front_end import FrontEnd
from stillmap.slam.motion_model import gaussian_prior
from stillmap.slam.options import OdometryOptions
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
