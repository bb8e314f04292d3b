"""The end of a drive: what was mapped is kept somewhere, whatever became of the disk."""

import errno
import os
import shlex
from pathlib import Path

import numpy as np
import pytest

import stillmap
from stillmap.cli.main import main
from stillmap.core.errors import InputError
from stillmap.live import drive_folder, last_save, saving
from stillmap.live.drive_folder import keep_drive, read_drive, remove_drive
from stillmap.live.history import History
from stillmap.live.last_save import save_last
from stillmap.live.mapper import LiveMapper

SCANS = 120


@pytest.fixture
def drive(corridor, tmp_path, monkeypatch):
    """A drive that has ended, and the folder of the system's temporary files."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    (tmp_path / "tmp/stillmap-scratch").mkdir(parents=True)
    with LiveMapper({"threads": 1}, scratch=tmp_path / "tmp/stillmap-scratch") as mapper:
        for t, beams in enumerate(corridor.beams[:SCANS]):
            mapper.push(beams, corridor.recording.T_odom_base[t])
        yield mapper.snapshot()


def contents(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in ("run.json", "report.html")
    }


def refuse(monkeypatch, *folders, times=10**9):
    """Let results be written nowhere in some folders, as if their disks were full; how often it
    was tried."""
    write, count = saving.LiveResult.write, [0]

    def write_or_fail(self, path, overwrite=False):
        if any(folder in Path(path).parents for folder in folders):
            count[0] += 1
            if count[0] <= times:
                raise InputError("cannot be written: No space left on device", where=str(path))
        write(self, path, overwrite)

    monkeypatch.setattr(saving.LiveResult, "write", write_or_fail)
    return count


def kept_drives(tmp_path):
    return list((tmp_path / "tmp").glob("stillmap-drive-*"))


def test_a_result_that_has_no_room_is_kept_among_temporary_files(drive, tmp_path, monkeypatch):
    refuse(monkeypatch, tmp_path / "full")
    with pytest.raises(InputError, match="No space left") as failed:
        save_last(drive, tmp_path / "full/out")
    (spare,) = (tmp_path / "tmp").glob("stillmap-live-*")
    assert failed.value.hint == f"the result is kept in {spare}"
    drive.save(tmp_path / "out")
    assert contents(spare) == contents(tmp_path / "out")


def test_a_drive_is_kept_and_saved_by_the_command_that_is_told(
    drive, tmp_path, monkeypatch, capsys
):
    drive.save(tmp_path / "whole")
    with monkeypatch.context() as full:
        refuse(full, tmp_path)
        with pytest.raises(InputError, match="No space left") as failed:
            save_last(drive, tmp_path / "out")
    (folder,) = kept_drives(tmp_path)
    assert list((tmp_path / "tmp").glob("stillmap-live-*")) == []
    words = shlex.split(failed.value.hint.partition(": ")[2])
    assert words == ["stillmap", "live", "--drive", str(folder), "-o", str(tmp_path / "out")]
    assert main([*words[1:], "--threads", "1"]) == 0
    assert "wrote" in capsys.readouterr().err
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")
    warnings = [stillmap.load(tmp_path / name).run["warnings"] for name in ("out", "whole")]
    assert warnings[0] == warnings[1]
    assert not folder.exists()


def test_beams_get_a_name_without_a_copy(corridor, tmp_path, limit_files):
    """A disk of which nothing is left but what small files need."""
    drive = corridor.mapper.snapshot()
    limit_files(200_000)
    folder = keep_drive(drive, tmp_path)
    limit_files(None)
    assert (folder / "p_static-0").stat().st_size == 4 * drive.kept.counts.sum() > 200_000
    for one, two in zip(drive.kept.load(None), read_drive(folder).kept.load(None), strict=True):
        for name in ("points", "hit", "stamp_ns", "T_odom_base", "poses", "anchor", "p_static"):
            if hasattr(one, name):
                np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


def test_it_is_tried_again_while_there_is_no_room_anywhere(drive, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(last_save, "_PAUSE", 0.01)
    monkeypatch.setattr(last_save, "keep_drive", _no_room)
    built, prepare = [], type(drive)._prepare
    monkeypatch.setattr(type(drive), "_prepare", lambda *given: built.append(1) or prepare(*given))
    tried = refuse(monkeypatch, tmp_path, times=6)
    save_last(drive, tmp_path / "out")
    assert tried[0] == 7
    assert len(built) == 1
    assert len(stillmap.load(tmp_path / "out").poses) == SCANS
    assert len(caplog.records) == 1
    assert "Ctrl-C" in caplog.text
    assert list((tmp_path / "tmp").iterdir()) == [tmp_path / "tmp/stillmap-scratch"]


def test_patience_has_an_end(drive, tmp_path, monkeypatch):
    monkeypatch.setattr(last_save, "_PAUSE", 0.01)
    monkeypatch.setattr(last_save, "_PATIENCE", 0.0)
    monkeypatch.setattr(last_save, "keep_drive", _no_room)
    refuse(monkeypatch, tmp_path)
    with pytest.raises(InputError, match="No space left") as failed:
        save_last(drive, tmp_path / "out")
    assert failed.value.hint == ""


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_an_interruption_keeps_the_drive(drive, tmp_path, monkeypatch, caplog, error):
    def interrupt(*_, **__):
        raise error

    monkeypatch.setattr(saving, "map_recording", interrupt)
    with pytest.raises(error):
        save_last(drive, tmp_path / "out")
    (folder,) = kept_drives(tmp_path)
    assert f"stillmap live --drive {folder}" in caplog.text
    assert len(read_drive(folder).kept.number) == SCANS
    assert not (tmp_path / "out").exists()


def test_half_a_drive_is_not_left(drive, tmp_path, limit_files):
    limit_files(1000)
    with pytest.raises(OSError, match="large"):
        keep_drive(drive, tmp_path)
    limit_files(None)
    assert [path.name for path in tmp_path.iterdir()] == ["tmp"]


def test_scratch_that_is_full_at_the_end_is_replaced(drive, tmp_path, monkeypatch):
    load, where = type(drive.kept).load, []

    def load_or_fail(self, folder):
        where.append(folder)
        if folder == drive.scratch:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return load(self, folder)

    monkeypatch.setattr(type(drive.kept), "load", load_or_fail)
    save_last(drive, tmp_path / "out")
    assert where == [drive.scratch, tmp_path]
    assert (tmp_path / "out/run.json").is_file()


def test_a_damaged_drive_is_refused(drive, tmp_path, capsys):
    folder = keep_drive(drive, tmp_path)
    (folder / "mine.txt").write_text("mine")
    words = ["live", "--drive", str(folder), "-o", str(tmp_path / "out")]
    with (folder / "points-0").open("r+b") as file:
        file.truncate(8)
    assert main(words) == 2
    assert "points-0: is too short" in capsys.readouterr().err
    np.save(folder / "counts.npy", np.zeros(3))
    assert main(words) == 2
    assert "is damaged" in capsys.readouterr().err
    assert main([*words, "--map", str(tmp_path)]) == 2
    assert "--map" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    remove_drive(folder)
    assert [path.name for path in folder.iterdir()] == ["mine.txt"]


def test_rows_in_memory_are_copied(corridor, tmp_path, limit_files):
    """While the disk of temporary files is full scans are in memory; another one has room."""
    history = History(2, tmp_path)
    limit_files(200_000)
    for t in range(SCANS):
        beams, pose = corridor.beams[t], corridor.updates[t].pose
        history.append(beams, corridor.updates[t].p_static, None, pose, pose, -1, np.zeros(3))
    kept = history.snapshot()
    assert any(file is None for files in kept.files for file in files)
    limit_files(None)
    for parts, files in zip(kept.parts, kept.files, strict=True):
        for k, (part, file) in enumerate(zip(parts, files, strict=True)):
            drive_folder._put(part, file, tmp_path / f"part-{k}")
            assert (tmp_path / f"part-{k}").read_bytes() == np.ascontiguousarray(part).tobytes()
            (tmp_path / f"part-{k}").unlink()
    history.close()


def _no_room(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
