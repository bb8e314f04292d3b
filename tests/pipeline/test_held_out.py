"""The figure of quality in every iteration, in run.json and in the report."""

import json
import math

import pytest

import stillmap
from stillmap import em
from stillmap.core.config import override
from stillmap.pipeline import result as results
from stillmap.pipeline.final_map import FinalEstimate
from stillmap.pipeline.options import Options

WITHOUT_LAST = {"change_detection": False}


@pytest.fixture(autouse=True)
def without_final_e_step(monkeypatch):
    """The score is of the loop's labels: the final E-step comes after it."""
    monkeypatch.setattr(results, "final_estimate", lambda *given: FinalEstimate(*given[:2], [], []))


def options(estimator, **changes):
    settings = {"max_iterations": 3, "held_out": 20, **WITHOUT_LAST, **changes}
    return override(Options(), {"em": settings, "estimator": estimator, "threads": 1})


@pytest.mark.parametrize("estimator", ["stillmap", "paper", "hit-ratio", "tracker"])
def test_every_iteration_has_its_figure(room, tmp_path, estimator):
    chosen = options(estimator)
    result = stillmap.build(room.recording, chosen)
    figures = [it.held_out_log_likelihood for it in result.iterations]
    assert all(0 < figure < 10 for figure in figures)
    # it is that of the poses and labels which are written
    expected = em.score_held_out_scans(
        room.recording, result.poses, result.p_static, chosen.slam.resolution, 20
    )
    assert figures[result.best_iteration - 1] == expected
    assert result.stages["held_out"]["seconds"] > 0
    result.save(tmp_path / "out")
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    assert [it["held_out_log_likelihood"] for it in run["iterations"]] == figures
    gain = f"a beam is {math.exp(expected):.3g} times as likely with the map as without one"
    assert gain in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize("every", [0, 61])
def test_without_held_out_scans_there_is_none(room, tmp_path, every):
    result = stillmap.build(room.recording, options("stillmap", held_out=every, max_iterations=1))
    assert [it.held_out_log_likelihood for it in result.iterations] == [None]
    result.save(tmp_path / "out")
    assert "times as likely" not in (tmp_path / "out" / "report.html").read_text()


def test_what_is_mapped_does_not_depend_on_it(room):
    one, other = (
        stillmap.build(room.recording, options("stillmap", held_out=every, max_iterations=2))
        for every in (0, 7)
    )
    assert one.poses.tobytes() == other.poses.tobytes()
    assert one.p_static.tobytes() == other.p_static.tobytes()
    assert one.map.p_occupied.tobytes() == other.map.p_occupied.tobytes()
