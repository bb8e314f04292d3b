"""Results, places and truths with every fault; and checkpoints: see `test_readers`."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

for needed in ("pye57", "laspy", "lazrs", "lzf"):  # of other inputs
    pytest.importorskip(needed)

from faulty_inputs import Reader  # noqa: E402
from file_faults import BEFORE, MEANWHILE, be_pipe, run, while_read  # noqa: E402

from stillmap.cli.main import main  # noqa: E402
from stillmap.pipeline import result as result_module  # noqa: E402
from stillmap.pipeline.em_loop import iterate  # noqa: E402

ZONES = """{"type": "FeatureCollection", "features": [{"type": "Feature",
"properties": {"action": "erase"}, "geometry": {"type": "Polygon",
"coordinates": [[[0, 0], [1, 0], [1, 1], [0, 0]]]}}]}"""


def to_bag(home: Path, output: Path) -> list[str]:
    words = ["convert", f"{home}/map1", "--input", f"{home}/day1", "--quiet"]
    return [*words, "-o", f"{output}.mcap"]


def to_nav2(home: Path, output: Path) -> list[str]:
    words = ["convert", f"{home}/map1", "--to", "nav2", "--quiet", "-o", str(output)]
    return [*words, "--mask", f"{home}/zones.geojson", "--keepout-crossings", "9"]


def score_labels(home: Path, output: Path) -> list[str]:  # noqa: ARG001
    return ["eval", "labels", f"{home}/map1", f"{home}/day1"]


def score_map(home: Path, output: Path) -> list[str]:  # noqa: ARG001
    return ["eval", "map", f"{home}/map1", f"{home}/day1"]


def place_to_nav2(home: Path, output: Path) -> list[str]:
    return ["convert", f"{home}/place", "--to", "nav2", "--quiet", "-o", str(output)]


def grow(home: Path, output: Path) -> list[str]:
    words = ["merge", f"{home}/place", f"{home}/map3", "--quiet", "--threads", "1"]
    return [*words, "-o", str(output)]


def merge(home: Path, output: Path) -> list[str]:
    words = ["merge", f"{home}/map1", f"{home}/map2", "--quiet", "--threads", "1"]
    return [*words, "-o", str(output)]


COMMANDS: dict[Callable[[Path, Path], list[str]], tuple[str, ...]] = {
    to_bag: (
        *("map1/run.json", "map1/map.npz", "map1/trajectory.tum", "map1/objects/objects.json"),
        *(f"map1/beams/{name}.npy" for name in ("stamp_ns", "offset", "p_static", "hit")),
    ),
    to_nav2: ("zones.geojson", "map1/traffic.npz"),
    score_labels: ("day1/truth/static.npy",),
    score_map: ("day1/truth/walls.npy", "day1/truth/T_world_base.npy"),
    place_to_nav2: ("place/run.json", "place/map.npz", "place/sessions.json"),
    merge: ("map1/graph.g2o", "map1/objects/0000.ply", "map2/trajectory.tum"),
    grow: (
        *("place/run.json", "place/sessions.json", "place/ties.npz"),
        *(
            f"place/sessions/map1/{name}"
            for name in (
                *("run.json", "beams/hit.npy", "state/measured_at.npy"),
                *("state/nodes.npy", "state/graph.g2o", "state/objects/objects.json"),
                *("state/keyframes/recording.json", "state/keyframes/points.npy"),
            )
        ),
    ),
}
QUICK = ("map1/trajectory.tum", "map1/beams/p_static.npy", "zones.geojson", "day1/truth/walls.npy")


@pytest.fixture
def home(flat_days: Path, flat_place: Path, tmp_path: Path) -> Path:
    """A copy of the days, their results and their place."""
    out = tmp_path / "in"
    shutil.copytree(flat_days, out)
    shutil.copytree(flat_place, out / "place")
    (out / "zones.geojson").write_text(ZONES)
    return out


def rows(faults: tuple[Callable[..., None], ...]) -> list[object]:
    return [
        pytest.param(
            Reader(victim, lambda home: home, victim, command),
            fault,
            id=f"{command.__name__}-{victim.replace('/', '-')}-{fault.__name__}",
            marks=() if victim in QUICK else pytest.mark.slow,
        )
        for command, victims in COMMANDS.items()
        for victim in victims
        for fault in faults
    ]


@pytest.mark.parametrize(("reader", "fault"), rows(BEFORE))
def test_fault_before(home, tmp_path, capsys, reader, fault):
    fault(home / reader.victim)
    run(reader, tmp_path, home, capsys)


@pytest.mark.parametrize(("reader", "fault"), rows(MEANWHILE))
def test_fault_meanwhile(home, tmp_path, capsys, monkeypatch, reader, fault):
    while_read(monkeypatch, home / reader.victim, fault)
    run(reader, tmp_path, home, capsys)


@pytest.mark.parametrize("command", COMMANDS, ids=lambda one: one.__name__)
def test_without_fault(home, tmp_path, capsys, command):
    assert main(command(home, tmp_path / "out")) == 0, capsys.readouterr().err


# checkpoints

MAP = ["--quiet", "--threads", "1", "--set", "em.max_iterations=3", "--set", "em.tolerance=0"]
MAP += ["--set", "em.label_tolerance=0", "--set", "em.patience=9"]


@pytest.fixture(scope="module")
def interrupted(flat_days, tmp_path_factory) -> Path:
    """A folder with the recording `day1` and the checkpoint of a run that was interrupted."""
    out = tmp_path_factory.mktemp("interrupted")
    shutil.copytree(flat_days / "day1", out / "day1")

    def stop(*args, **how):
        for number, iteration in enumerate(iterate(*args, **how)):
            if number == 2:
                raise KeyboardInterrupt
            yield iteration

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(result_module, "iterate", stop)
        assert main(["map", f"{out}/day1", "-o", f"{out}/out", *MAP]) == 130
    return out


def resume(folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """Go on, with the same recording, whatever the checkpoint holds; what is said."""
    status = main(["map", f"{folder}/day1", "-o", f"{folder}/out", "--resume", *MAP])
    said = capsys.readouterr().err
    assert status in (0, 2), said
    assert len(said.splitlines()) <= 1
    assert (folder / "out").exists() == (status == 0)
    assert sorted(os.listdir(folder)) == sorted(
        ["day1", "out"] if status == 0 else ["day1", ".out.resume"]
    )
    return said


@pytest.fixture
def checkpoint(interrupted, tmp_path) -> Path:
    shutil.copytree(interrupted, tmp_path / "in")
    return tmp_path / "in" / ".out.resume" / "iteration-2"


@pytest.mark.parametrize("name", ["checkpoint.json", "0.npy", "1.npy"])
@pytest.mark.parametrize(
    "fault",
    [pytest.param(one, marks=() if one is be_pipe else pytest.mark.slow) for one in BEFORE],
)
def test_checkpoint_with_fault(checkpoint, tmp_path, capsys, name, fault):
    fault(checkpoint / name)
    assert name in resume(tmp_path / "in", capsys)


def test_pipe_as_lock(checkpoint, tmp_path, capsys):
    (checkpoint.parent / "lock").unlink()
    os.mkfifo(checkpoint.parent / "lock")
    assert main(["map", f"{tmp_path}/in/day1", "-o", f"{tmp_path}/in/out", *MAP]) == 2
    assert "lock: is no regular file" in capsys.readouterr().err


CHANGES = {
    "another version": lambda state: state.update(format_version=99),
    "no best": lambda state: state["state"].update(best=None),
    "text for a number": lambda state: state["state"]["records"][0].update(seconds="long"),
    "another file": lambda state: state["state"]["best"].update(weights={"__file__": "../lock"}),
    "no key": lambda state: state.pop("key"),
    "no stages": lambda state: state.update(stages={"read": 3}),
}


# tampered records
