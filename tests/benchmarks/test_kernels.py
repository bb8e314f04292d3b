import numpy as np
import pytest
from kernels import (
    THREADS,
    Kernel,
    cells_crossed,
    kernels_of,
    median_seconds,
    speeds,
    wide_hall,
)

from stillmap import em
from stillmap.sim import simulate


def cells_of(table: str) -> dict[str, list[str]]:
    lines = [[cell.strip() for cell in text.split("|")[1:-1]] for text in table.splitlines()]
    return {name: rest for name, *rest in lines}


def test_hall_is_seen_all_around_and_every_kernel_runs() -> None:
    sim = simulate(wide_hall(40, 72), 0)
    bearing = np.arctan2(*sim.recording.points[:72].T[::-1])
    assert np.degrees(np.ptp(bearing[np.isfinite(bearing)])) > 340
    kernels = kernels_of(sim.recording, sim.truth.T_world_base)
    assert any("M-step" in name for name in kernels)
    assert any("element" in name for name in kernels)
    once, again = ([kernels["E-step"](n) for n in THREADS] for _ in range(2))
    for expectations in (*once, *again):
        assert isinstance(expectations, em.EStepResult)
        np.testing.assert_array_equal(expectations.p_static, once[0].p_static)
    likelihood, _ = kernels["E-step: element pass"](1)
    later, _ = kernels["E-step: element pass"](2)
    assert np.ptp(likelihood) > 0.5  # looks told the classes apart
    np.testing.assert_array_equal(likelihood, later)  # nothing is left of the call before
    seconds = median_seconds(kernels, 1)
    assert set(seconds) == {(name, n) for name in kernels for n in THREADS}
    assert min(seconds.values()) > 0


def test_rounds_are_interleaved_and_medians_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    called: list[tuple[str, int]] = []
    now = 0.0

    def kernel(name: str, seconds: float) -> Kernel:
        def run(threads: int) -> None:
            nonlocal now
            called.append((name, threads))
            disturbed = 1.0 if len(called) <= 4 else 0.0  # in the first round
            now += seconds / threads + disturbed

        return run

    monkeypatch.setattr("kernels.time.perf_counter", lambda: now)
    seconds = median_seconds({"a": kernel("a", 0.5), "b": kernel("b", 0.25)}, 3)
    assert called == [("a", 1), ("a", 2), ("b", 1), ("b", 2)] * 3
    assert seconds == {("a", 1): 0.5, ("a", 2): 0.25, ("b", 1): 0.25, ("b", 2): 0.125}


def test_speed_at_two_threads_is_held_against_what_is_wanted() -> None:
    seconds = {("fast", 1): 2.0, ("fast", 2): 1.0, ("slow", 1): 1.0, ("slow", 2): 1.01}
    table = cells_of(speeds(seconds, 200_000_000))
    assert table["fast"] == ["100", "200", ">= 200", "met"]
    assert table["slow"] == ["200", "198", ">= 200", "MISSED"]


@pytest.mark.parametrize(
    ("end", "cells"), [((1.0, 0.0), 20), ((0.0, -0.5), 10), ((1.0, 1.0), 40), ((np.nan, 0.0), 0)]
)
def test_cells_are_counted_up_to_the_end(end: tuple[float, float], cells: int) -> None:
    pose = np.eye(3)
    pose[:2, 2] = 0.02
    points = np.array([end], np.float32)
    assert cells_crossed(points, np.array([0, 1]), pose[None]) == cells
