"""Real logs, changed such that their truth stays, give maps that are not torn."""

import metamorphic
import pytest

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("log", "changes"),
    [
        ("seattle", ["no-rotation", "pieces-3"]),  # FLASER and ODOM lines, with relations
        ("mines-exp3", ["late-lines", "scale-1.1"]),  # ROBOTLASER1 lines alone, without
    ],
)
def test_a_changed_log_is_not_torn(shared_data, tmp_path, log, changes):
    path = shared_data / "laser2d" / f"{log}.clf.gz"
    if not path.exists():
        pytest.skip(f"no {log} in ../shared/data/laser2d")
    for change in [metamorphic.UNCHANGED, *changes]:
        row = metamorphic.run(metamorphic.Job(path, change, 0, tmp_path))
        assert row["status"] == "done", row
        assert not row["tear"], row
        assert row["scans"] > 0.9 * metamorphic.read_log(path).scan.sum(), row
        assert row["step"] < metamorphic.TEAR_STEP, row
