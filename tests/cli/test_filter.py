"""`stillmap filter`: recordings without dynamic beams."""

import shutil

import numpy as np
import pytest
from refusals import refused

from stillmap.io import read, stillmap_folder

QUICK = ("--set", "em.max_iterations=1", "--quiet")


@pytest.mark.parametrize("below", [None, 0.9, 0.0])
def test_dynamic_beams_become_misses(call, room, mapped, tmp_path, below):
    more = [] if below is None else ["--below", below]
    done = call("filter", mapped, "-o", tmp_path / "clean", *more)
    assert done.returncode == 0, done.stderr
    before, after = stillmap_folder.read(room), stillmap_folder.read(tmp_path / "clean")
    p = np.load(mapped / "beams/p_static.npy")
    blank = before.hit & (p < (0.5 if below is None else below))
    np.testing.assert_array_equal(after.hit, before.hit & ~blank)
    np.testing.assert_array_equal(after.points, before.points)
    np.testing.assert_array_equal(after.stamp_ns, before.stamp_ns)
    assert blank.any() == (below != 0.0)
    assert f"{np.count_nonzero(blank)} beams blanked" in done.stderr


def test_filtered_log(call, tmp_path):
    """A walker in front of a wall, as a log: the same log comes out, without him."""
    rng = np.random.default_rng(0)
    lines = []
    for t in range(80):
        ranges = 6.0 / np.cos(np.linspace(-1.0, 1.0, 61)) + rng.normal(0.0, 0.01, 61)
        ranges[(t // 2) % 50 : (t // 2) % 50 + 5] = 3.0
        ranges[[0, 30, 60]] = 81.83
        readings = " ".join(f"{r:.2f}" for r in ranges)
        lines.append(f"FLASER 61 {readings} 0 0 0 0 0 0 {0.2 * t:.2f} host {0.2 * t:.2f}\n")
    source, out = tmp_path / "walk.log", tmp_path / "out"
    source.write_text("".join(lines))
    assert call("map", source, "-o", out, *QUICK).returncode == 0
    done = call("filter", out, "-o", tmp_path / "clean.log.gz", "--quiet")
    assert (done.returncode, done.stderr) == (0, "")
    before, after = read(source), read(tmp_path / "clean.log.gz")
    gone = before.hit & ~after.hit
    walker = np.isclose(np.linalg.norm(before.points, axis=1), 3.0, atol=0.02) & before.hit
    assert (gone & walker).sum() > 0.9 * walker.sum()
    assert (gone & ~walker).sum() < 0.02 * before.hit.sum()


def test_filtered_bag(call, room, tmp_path):
    """Another recording than the one that was mapped is refused."""
    assert call("convert", room, "-o", tmp_path / "a.bag", "--quiet").returncode == 0
    done = call("map", tmp_path / "a.bag", "-o", tmp_path / "out", *QUICK)
    assert done.returncode == 0, done.stderr
    done = call("filter", tmp_path / "out", "-o", tmp_path / "clean.bag")
    assert done.returncode == 0, done.stderr
    # what was filtered is another recording than what was mapped
    done = call("filter", tmp_path / "out", "-o", tmp_path / "b", "--input", tmp_path / "clean.bag")
    refused(done, "clean.bag", "is not the recording that was mapped")
    same = ["--input", tmp_path / "a.bag", "--overwrite"]
    assert call("filter", tmp_path / "out", "-o", tmp_path / "clean.bag", *same).returncode == 0


@pytest.mark.parametrize("output", ["c.bag", "c.mcap", "c.db3", "c.log", "c.clf.gz", "c:ros2"])
def test_other_formats_by_name(call, room, mapped, tmp_path, output):
    """Blanked beams become misses."""
    name, _, form = output.partition(":")
    more = ("--to", form) if form else ()
    done = call("filter", mapped, "-o", tmp_path / name, *more)
    assert done.returncode == 0, done.stderr
    before, after = stillmap_folder.read(room), read(tmp_path / name)
    blank = before.hit & (np.load(mapped / "beams/p_static.npy") < 0.5)
    np.testing.assert_array_equal(after.hit, before.hit & ~blank)
    np.testing.assert_allclose(after.points[after.hit], before.points[after.hit], atol=1e-3)
    assert f"{blank.sum()} beams blanked" in done.stderr


def test_refusals(call, room, mapped, tmp_path):
    refused(call("filter", tmp_path / "nothing", "-o", tmp_path / "c"), "nothing/run.json")
    refused(call("filter", mapped, "-o", room, "--overwrite"), "the recording itself")
    refused(call("filter", mapped, "-o", tmp_path / "c", "--below", "7"), "--below wants 0 to 1")
    (tmp_path / "full").mkdir()
    (tmp_path / "full/file").write_text("")
    # only recordings are overwritten
    for more, said in ((), "already holds something"), (("--overwrite",), "holds other things"):
        refused(call("filter", mapped, "-o", tmp_path / "full", *more), said)
    assert (tmp_path / "full/file").exists()
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "not JSON"),
        ("[]", "run.json"),
        ('{"format_version": 1, "input": {}}', "names no recording"),
        ('{"format_version": 1, "input": {"path": null}}', "names no recording"),
        ('{"format_version": 1, "input": {"path": "x"}}', "names no options"),
        (
            '{"format_version": 1, "input": {"path": "x"}, "options": {"read": {"no_such": 1}}}',
            "options that cannot be",
        ),
    ],
)
def test_damaged_run_json(call, mapped, tmp_path, content, words):
    result = tmp_path / "result"
    shutil.copytree(mapped, result)
    (result / "run.json").write_text(content)
    refused(call("filter", result, "-o", tmp_path / "c"), words)
