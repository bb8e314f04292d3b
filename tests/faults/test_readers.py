"""Every reader with every fault: exit status 0, or 2 with one line; and an end, soon."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

for needed in ("pye57", "laspy", "lazrs", "lzf"):
    pytest.importorskip(needed)

from faulty_inputs import RECORDINGS, Reader  # noqa: E402
from file_faults import BEFORE, MEANWHILE, run, while_read  # noqa: E402

from stillmap.cli.main import main  # noqa: E402


def rows(faults: tuple[Callable[[Path], None], ...]) -> list[object]:
    return [
        pytest.param(
            reader,
            fault,
            id=f"{reader.name.replace('/', '-')}-{fault.__name__}",
            marks=() if reader.is_quick else pytest.mark.slow,
        )
        for reader in RECORDINGS
        for fault in faults
    ]


def made(reader: Reader, tmp_path: Path) -> Path:
    (tmp_path / "in").mkdir()
    return reader.make(tmp_path / "in")


@pytest.mark.parametrize(("reader", "fault"), rows(BEFORE))
def test_fault_before(tmp_path, capsys, reader, fault):
    path = made(reader, tmp_path)
    fault(tmp_path / "in" / reader.victim)
    run(reader, tmp_path, path, capsys)


@pytest.mark.parametrize(("reader", "fault"), rows(MEANWHILE))
def test_fault_meanwhile(tmp_path, capsys, monkeypatch, reader, fault):
    path = made(reader, tmp_path)
    while_read(monkeypatch, tmp_path / "in" / reader.victim, fault)
    run(reader, tmp_path, path, capsys)


@pytest.mark.parametrize("reader", [pytest.param(one, id=one.name) for one in RECORDINGS])
def test_without_fault(tmp_path, capsys, reader):
    path = made(reader, tmp_path)
    output = tmp_path / "out"
    assert main(reader.command(path, output)) == 0, capsys.readouterr().err
    shutil.rmtree(output, ignore_errors=True)
