"""The recording that tests cut into parts."""

import pytest
from cut_recordings import make_recording

from stillmap.core.recording import Recording


@pytest.fixture
def drive() -> Recording:
    """60 scans in 2D."""
    return make_recording()
