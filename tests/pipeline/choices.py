"""Options and estimators that tests of the loop run with."""

import pytest

from stillmap.core.config import override
from stillmap.pipeline.options import Options

RESOLUTION = 0.05
ESTIMATORS = ("stillmap", "paper", "hit-ratio", "tracker")
with_any_estimator = pytest.mark.parametrize("estimator", ESTIMATORS)


def options(estimator="stillmap", **loop):
    chosen = {"estimator": estimator, "em": loop, "threads": 1}
    return override(Options(), chosen | {"slam": {"resolution": RESOLUTION}})
