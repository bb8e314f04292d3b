"""Progress for those who ask for it, and what an interruption leaves behind."""

import signal

import numpy as np
import pytest
import threadpoolctl

import stillmap

FAST = {"threads": 2, "em.max_iterations": 2}


def test_a_bar_on_stderr(folder, capfd, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    stillmap.build(folder, FAST, resolution=0.2, progress=True)
    out, err = capfd.readouterr()
    assert out == ""
    assert "matching scans, iteration 1/2" in err


def test_a_function_is_told(folder):
    told = []
    stillmap.build(folder, FAST, resolution=0.2, progress=lambda *at: told.append(at))
    assert ("matching scans", 1, 60, 60) in told
    assert told[-1][0] != "matching scans"


@pytest.mark.parametrize("stage", ["matching scans", "labelling beams", "tracking objects"])
def test_ctrl_c_leaves_the_session_usable(folder, built, stage):
    def press(what, *_):
        if what == stage:
            signal.raise_signal(signal.SIGINT)

    before = threadpoolctl.threadpool_info()
    handler = signal.getsignal(signal.SIGINT)
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        with pytest.raises(KeyboardInterrupt):
            stillmap.build(folder, FAST, progress=press)
    finally:
        signal.signal(signal.SIGINT, handler)
    assert threadpoolctl.threadpool_info() == before
    again = stillmap.build(folder, {"threads": 2, "em.max_iterations": 2}, resolution=0.1)
    np.testing.assert_array_equal(again.p_static, built.p_static)


@pytest.mark.parametrize("earlier", [False, True])
def test_ctrl_c_while_saving_leaves_no_half_result(built, tmp_path, monkeypatch, earlier):
    out = tmp_path / "out"
    if earlier:
        built.save(out)
    files = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}

    def press(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("stillmap.results.writer.write_map_npz", press)
    with pytest.raises(KeyboardInterrupt):
        built.save(out, overwrite=earlier)
    assert sorted(tmp_path.iterdir()) == ([out] if earlier else [])
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == files
