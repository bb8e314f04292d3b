"""Detection of formats, and errors of one line."""

import gzip

import pytest

from stillmap.cli.main import main
from stillmap.core.errors import InputError
from stillmap.io import read
from stillmap.io.registry import FORMATS, detect_format


@pytest.mark.parametrize(
    "name", ["a.log", "a.clf", "a.LOG", "a.txt", "a.log.gz", "a.clf.gz", "a.gz", "a.dat", "noname"]
)
@pytest.mark.parametrize("packed", [False, True])
def test_logs_by_suffix_or_content(log, flaser, name, packed):
    text = ("# comment\n" + flaser(1.0) + "\n").encode()
    assert read(log(gzip.compress(text) if packed else text, name)).n_scans == 1


@pytest.mark.parametrize("name", ["a.log", "a.clf.gz", "a.xyz"])
@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"", "is empty"),
        (bytes(range(256)) * 100, "is no recording"),
        (gzip.compress(bytes(4096), mtime=0), "is no recording"),  # workers must agree on its name
        (b"hello\nworld\n", "no "),
        (b"ODOM 0 0 0 0 0 0 1.0 host 0\n", "no laser line"),
        (b"\x1f\x8b", "no "),
    ],
)
def test_other_files(log, name, content, what):
    path = log(content, name)
    with pytest.raises(InputError, match=what) as caught:
        read(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.hint


def test_missing_path(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read(tmp_path / "missing.log")


def test_recordings_in_a_folder_are_listed(tmp_path):
    outer = tmp_path / "sim"
    (outer / "notes").mkdir(parents=True)
    (outer / ".hidden").write_text("")

    def said(*more: str) -> str:
        for name in more:
            (outer / name).mkdir()
            (outer / name / "recording.json").write_text("")
        with pytest.raises(InputError) as caught:
            read(outer)
        return str(caught.value)

    assert "is a folder without a recording" in said()
    alone = said("tilting")
    assert f"holds 1: {outer / 'tilting'} (name one: " in alone
    assert alone.endswith(f"stillmap map {outer / 'tilting'} -o DIR)")
    both = said("horizontal")
    assert both.startswith(f"{outer}: is no recording but holds 2: ")
    assert f"{outer / 'horizontal'}, {outer / 'tilting'} (both: " in both
    assert f"{outer / 'horizontal'} with tilting={outer / 'tilting'}" in both
    (outer / "run.json").write_text("")
    assert "is a result, no recording" in said()  # its clouds are objects
    (outer / "run.json").unlink()
    many = said("a", "b", "c")
    assert f"{outer / 'a'}, {outer / 'b'}, {outer / 'c'}, ... (name one: " in many
    assert many.endswith(f"stillmap map {outer / 'a'} -o DIR)")


def test_unrelated_bags_in_a_folder_are_not_joined(tmp_path):
    """Recorders split one recording into X_0, X_1, ...; other names are other recordings."""
    day = tmp_path / "day"
    day.mkdir()
    for name in ("morning_0.mcap", "evening_0.mcap"):
        (day / name).write_bytes(b"\x89MCAP0\r\n")
    with pytest.raises(InputError, match=r"holds 2: .*evening_0[.]mcap.*morning_0[.]mcap"):
        read(day)
    (day / "evening_0.mcap").rename(day / "morning_1.mcap")
    assert detect_format(day).name == "ROS bag"


def test_formats_are_listed_where_errors_say(tmp_path, capsys):
    (tmp_path / "picture.jpg").write_bytes(b"\xff\xd8\xff\xe0")
    with pytest.raises(InputError, match="is no recording") as caught:
        read(tmp_path / "picture.jpg")
    assert len(str(caught.value)) < 200
    assert "`stillmap info -h` lists the formats" in str(caught.value)
    with pytest.raises(SystemExit):
        main(["info", "--help"])
    told = capsys.readouterr().out
    assert [one.name for one in FORMATS if one.name.partition(" ")[0] not in told] == []


@pytest.mark.parametrize("path", ["a\0b.log", "x" * 5000 + ".log"])
def test_impossible_paths(path):
    with pytest.raises(InputError):
        read(path)
