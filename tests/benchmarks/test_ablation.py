"""Which part brings what: every variant is another estimator, and the whole comes first."""

import ablation
import numpy as np
from cases import Case
from common import Run


def run(scene):
    case = Case("short", "populated", scene, {"robot": {"scans": 60}})
    return Run(case, 0, "stillmap", (), true_poses=True)


def test_variants_differ_from_the_whole():
    short = run("hall")
    runs = ablation.scores_of(short)
    assert len(runs) == len(ablation.VARIANTS)
    assert all(s.hits == runs[0].hits and s.dynamic > 50 for s in runs)
    assert runs[0].f1 > 0.9
    differ = [s.log_loss != runs[0].log_loss for s in runs[1:]]
    assert sum(differ) >= len(differ) - 1  # scans farther apart than a look are looks of their own
    assert runs[0].f1 > np.median([s.f1 for s in runs[1:]]) - 0.01


def test_table():
    moving, still = (ablation.scores_of(run(scene)) for scene in ("hall", "hall-empty"))
    lines = ablation.table([moving, still]).splitlines()
    assert len(lines) == 2 + len(ablation.VARIANTS)
    assert "nothing: the whole" in lines[2]
    assert f"{moving[0].f1:.4f} ({moving[0].f1:.4f})" in lines[2]  # nothing moves in the other
    assert lines[2].count("%") == 1
    assert ablation.table([moving]).splitlines()[2].rstrip(" |").endswith("-")
