"""The end of a drive: what was mapped is written somewhere, whatever happens to its folder."""

from pathlib import Path

import pytest

from stillmap.core.errors import InputError
from stillmap.core.profiling import no_progress
from stillmap.live.ros.run import _save


class _Live:
    """Stands for the node: writes to no folder but those that it is told at the end."""

    def __init__(self, spare_fails: bool = False) -> None:
        self.spare_fails, self.saved = spare_fails, list[Path]()

    def save(self, _: object, output: Path | None = None) -> None:
        if output is None or self.spare_fails:
            raise InputError("cannot be written: No space left on device", where="out")
        self.saved.append(output)


def test_result_is_kept_among_temporary_files(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    live = _Live()
    with pytest.raises(InputError, match="No space left") as failed:
        _save(live, no_progress)
    (spare,) = live.saved
    assert spare.parent == tmp_path
    assert failed.value.hint == f"the result is kept in {spare}"


def test_no_place_at_all_is_the_first_error(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(InputError, match="No space left") as failed:
        _save(_Live(spare_fails=True), no_progress)
    assert failed.value.hint == ""
    assert list(tmp_path.iterdir()) == []
