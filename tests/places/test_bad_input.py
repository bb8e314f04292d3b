"""What `merge` refuses: one clear line, nothing written, the inputs as they were."""

import errno
import io
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from flat import OPTIONS, files_of, record_elsewhere

import stillmap
from stillmap.core import array_folder
from stillmap.core.errors import InputError
from stillmap.places import store
from stillmap.results import map_server


def damage(path: Path) -> list[bytes | None]:
    """Other contents of a file; None: it is gone."""
    whole = path.read_bytes()
    noise = np.random.default_rng(1).integers(0, 256, len(whole), dtype=np.uint8).tobytes()
    out = [None, b"", whole[: len(whole) // 2], noise]
    if path.suffix == ".npy":
        array = np.load(path)
        out += [dump(array[:-1]), dump(array.astype("U4"))]
    return out


def dump(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


# written anew by every merge: nobody needs to read them; clouds are read when they are moved
OUTPUTS = ("trajectory.tum", "beams/p_static.npy", "objects/", "state/objects/")


@pytest.fixture
def copy(flat_place: Path, tmp_path: Path) -> Path:
    """A copy of a place, to be damaged."""
    shutil.copytree(flat_place, tmp_path / "place")
    return tmp_path / "place"


def test_damaged_files_are_named(copy: Path) -> None:
    home = copy / "sessions" / "map2"
    paths = [
        path
        for path in sorted(home.rglob("*"))
        if path.is_file() and not path.relative_to(home).as_posix().startswith(OUTPUTS)
    ]
    assert len(paths) > 20
    for path in [*paths, copy / "run.json", copy / "sessions.json", copy / "ties.npz"]:
        whole = path.read_bytes()
        for content in damage(path):
            path.unlink(missing_ok=True)
            if content is not None:
                path.write_bytes(content)
            with pytest.raises(InputError) as caught:
                store.read_place(copy)
            assert str(copy) in str(caught.value), path
            assert "\n" not in str(caught.value)
        path.write_bytes(whole)
    store.read_place(copy)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("state/nodes.npy", lambda a: a + 1.0),
        ("state/poses.npy", lambda a: a[::-1]),
        ("state/beam_cell.npy", lambda a: a + 100_000),
        ("state/cell_node.npy", lambda a: a - 1000),
        ("state/p_static.npy", lambda a: a + np.float16(5)),
        ("state/keyframes/e.npy", lambda a: a + np.float32(2)),
        ("state/keyframes/scans.npy", lambda a: a + 1000),
        ("beams/offset.npy", lambda a: a[::-1]),
        ("beams/offset.npy", lambda a: np.array([0, 2**63 - 1, int(a[-1]) + 1 - 2**63, *a[3:]])),
        ("beams/stamp_ns.npy", lambda a: a[::-1]),
    ],
)
def test_values_that_cannot_be(copy: Path, name, change) -> None:
    path = copy / "sessions" / "map2" / name
    path.write_bytes(dump(np.ascontiguousarray(change(np.load(path)))))
    with pytest.raises(InputError) as caught:
        store.read_place(copy)
    assert "sessions/map2" in str(caught.value)


EDITS = {
    "no list": lambda _: {"name": "map1"},
    "a session less": lambda records: records[:1],
    "a path as name": lambda records: [records[0], {**records[1], "name": "../map1"}],
    "accepted changed": lambda records: [records[0], {**records[1], "accepted": False}],
}


@pytest.mark.parametrize("edit", EDITS)
def test_a_list_of_sessions_that_was_edited(copy: Path, edit: str) -> None:
    path = copy / "sessions.json"
    path.write_text(json.dumps(EDITS[edit](json.loads(path.read_text()))))
    with pytest.raises(InputError, match=r"sessions\.json"):
        store.read_place(copy)


def test_a_session_whose_folder_is_gone(copy: Path, flat_days: Path, tmp_path: Path) -> None:
    shutil.rmtree(copy / "sessions" / "map2")
    with pytest.raises(InputError, match=r"map2.*cannot be read"):
        stillmap.merge([copy, flat_days / "map3"], options=OPTIONS, output=tmp_path / "out")
    assert sorted(os.listdir(tmp_path)) == ["place"]


def refused(sessions: list, folder: Path, **more: object) -> str:
    """What merging says; checks that nothing was written, and the inputs are as they were."""
    names = sorted(os.listdir(folder))
    before = [files_of(Path(one)) for one in sessions if os.path.isdir(one)]
    with pytest.raises(InputError) as caught:
        stillmap.merge(sessions, options=OPTIONS, output=folder / "out", **more)
    assert sorted(os.listdir(folder)) == names
    assert [files_of(Path(one)) for one in sessions if os.path.isdir(one)] == before
    said = str(caught.value)
    assert "\n" not in said
    assert "--" not in said
    return said


def test_inputs_that_cannot_be_merged(flat_place: Path, flat_days: Path, tmp_path: Path) -> None:
    torn = tmp_path / "torn.log"
    torn.write_text("FLASER 3 1.0 2.0\n")
    noise = tmp_path / "noise.bag"
    noise.write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    for bad in (torn, noise, tmp_path / "nowhere"):
        assert bad.name in refused([flat_days / "map1", bad], tmp_path)
        assert bad.name in refused([flat_place, bad], tmp_path)
    said = refused([flat_days / "map1", flat_place], tmp_path)
    assert "is a place, among sessions" in said
    assert "the first" in said
    assert "one session alone" in refused([flat_days / "map1"], tmp_path)
    assert "no session is named" in refused([flat_place], tmp_path)
    assert "no session is named" in refused([], tmp_path)
    said = refused([flat_days / "map1", flat_days / "map2"], tmp_path, frame="monday")
    assert "frame of monday" in said
    assert "map1, map2" in said
    assert "state of a map" in refused(
        [flat_days / "map1", flat_days / "map2"], tmp_path, map_state="new"
    )
    said = refused([flat_days / "map1", flat_days / "map2"], tmp_path, map_state="1970-01-01")
    assert "no session is as old" in said


def test_a_result_that_was_computed_elsewhere(flat_days: Path, tmp_path: Path) -> None:
    moved = tmp_path / "moved"
    shutil.copytree(flat_days / "map2", moved)
    record = json.loads((moved / "run.json").read_text())
    record["local_origin"] = [9e8, 9e8, 9e8]
    (moved / "run.json").write_text(json.dumps(record))
    said = refused([flat_days / "map1", moved], tmp_path)
    assert said == f"{moved}/run.json: local_origin is far from its trajectory"


def test_a_result_whose_recording_is_gone(flat_days: Path, tmp_path: Path) -> None:
    moved = tmp_path / "moved"
    shutil.copytree(flat_days / "map2", moved)
    record = (moved / "run.json").read_text()
    (moved / "run.json").write_text(record.replace(str(flat_days / "day2"), str(tmp_path / "day2")))
    said = refused([flat_days / "day1", moved], tmp_path)  # before the first is mapped
    assert "day2: does not exist" in said
    assert "merge the recording itself" in said
    given = stillmap.load(moved, recording=flat_days / "day2")
    merged = stillmap.merge([flat_days / "map1", given], options=OPTIONS)
    assert [one.accepted for one in merged.sessions] == [True, True]


def test_a_result_that_is_damaged(flat_days: Path, tmp_path: Path) -> None:
    for name in ("beams/p_static.npy", "trajectory.tum", "graph.g2o", "map.npz"):
        copy = tmp_path / "copy"
        shutil.copytree(flat_days / "map2", copy)
        content = (copy / name).read_bytes()
        (copy / name).write_bytes(content[: len(content) // 2])
        assert Path(name).name in refused([flat_days / "map1", copy], tmp_path)
        shutil.rmtree(copy)


def test_two_dimensions_do_not_mix(flat_days: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-8.0, 8.0, (2, 400))
    cloud = np.stack([x, y, np.where(np.arange(400) < 300, -1.0, 1.0)], axis=1)
    recording = stillmap.Recording.from_clouds([0.0, 0.1, 0.2, 0.3], [cloud] * 4)
    built = stillmap.build(recording, OPTIONS)
    with pytest.raises(InputError, match="session: it is in 3D, the place in 2D"):
        stillmap.merge([flat_days / "map1", built], options=OPTIONS, output=tmp_path / "out")
    assert os.listdir(tmp_path) == []


@pytest.mark.slow
def test_an_unrelated_session_is_left_out(
    flat_place: Path, flat_days: Path, tmp_path: Path
) -> None:
    record_elsewhere(tmp_path / "hall")
    stillmap.build(tmp_path / "hall", OPTIONS).save(tmp_path / "elsewhere")
    before = files_of(flat_place)
    assert "elsewhere: " in refused([flat_days / "map1", tmp_path / "elsewhere"], tmp_path)
    grown = stillmap.merge(
        [flat_place, tmp_path / "elsewhere", flat_days / "map3"],
        options=OPTIONS,
        output=tmp_path / "out",
    )
    assert [(one.name, one.accepted) for one in grown.sessions] == [
        ("map1", True),
        ("map2", True),
        ("elsewhere", False),
        ("map3", True),
    ]
    assert grown.sessions[2].why
    assert not (tmp_path / "out" / "sessions" / "elsewhere").exists()
    assert files_of(flat_place) == before
    alone = stillmap.merge([flat_place, flat_days / "map3"], options=OPTIONS)
    for name in ("map.npz", "trajectory.tum"):  # it did not bend the map
        assert (tmp_path / "out" / name).read_bytes() == (alone.path / name).read_bytes()


def _fill_disk(path: Path, *_: object) -> None:
    path.write_bytes(b"half of it")
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


@pytest.mark.parametrize(
    ("module", "name"), [(array_folder, "write_npy"), (map_server, "write_map_npz")]
)
def test_a_full_disk(flat_place, flat_days, tmp_path, monkeypatch, module, name) -> None:
    out = tmp_path / "out"
    shutil.copytree(flat_place, out)
    before, given = files_of(out), [flat_place, flat_days / "map3"]
    monkeypatch.setattr(module, name, _fill_disk)
    with pytest.raises(InputError, match="No space left") as caught:
        stillmap.merge(given, options=OPTIONS, output=out, overwrite=True)
    assert str(out) in str(caught.value)
    assert os.listdir(tmp_path) == ["out"]
    assert files_of(out) == before


def test_the_output_is_no_input(flat_place: Path, flat_days: Path) -> None:
    before = files_of(flat_place)
    for output in (flat_place, flat_place.parent, flat_days / "map3"):
        with pytest.raises(InputError, match="one of the sessions"):
            stillmap.merge(
                [flat_place, flat_days / "map3"], options=OPTIONS, output=output, overwrite=True
            )
    assert files_of(flat_place) == before
