"""Settings and fixtures of all tests; tests/reference and tests/marks.py can be imported."""

import gc
import sys
from pathlib import Path

import pytest

# thousands of collected tests are alive: walking them at every collection costs 8 % of the time
gc.set_threshold(50_000, 50, 50)
sys.path.append(str(Path(__file__).resolve().parent))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real recordings with references, which lie beside the checkout where there are any."""
    path = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not path.is_dir():
        pytest.skip("no folder of real recordings beside the checkout (../shared/data)")
    return path
