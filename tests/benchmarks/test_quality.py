import numpy as np
from quality import TRUTHS, VARIANTS, correlations, jittered

from stillmap.core import se2


def test_there_are_enough_runs() -> None:
    assert len(VARIANTS) >= 12
    assert len({variant.name for variant in VARIANTS}) == len(VARIANTS)


def test_agreement_is_signed_by_what_is_good() -> None:
    rows = [
        {
            "world": "hall",
            "seed": 0,
            "same_beams": True,
            "held_out": own,
            "bound": None,
            **dict.fromkeys(TRUTHS, own),
        }
        for own in (0.1, 0.2, 0.3, 0.4)
    ]
    cells = [c.strip() for c in correlations(rows, "held_out").splitlines()[-1].split("|")[1:-1]]
    good = {"ap", "f1", "walls"}
    assert cells[:2] == ["all", "4"]
    assert cells[2:] == ["+1.00" if key in good else "-1.00" for key in TRUTHS]
    assert "+1.00" not in correlations(rows, "bound")


def test_jitter_is_in_the_robots_own_frame_and_as_large_as_asked() -> None:
    poses = se2.matrix(np.zeros(4000), np.zeros(4000), np.full(4000, 1.0))
    off = se2.parameters(
        se2.inverse(poses) @ jittered(poses, (0.1, 0.02), np.random.default_rng(0))
    )
    np.testing.assert_allclose(off.std(axis=0), [0.1, 0.1, 0.02], rtol=0.05)
    same = jittered(poses, (0.0, 0.0), np.random.default_rng(0))
    np.testing.assert_array_equal(same, poses)
