"""`stillmap fleet --memory`: no task takes more."""

from pathlib import Path

from stillmap.fleet.settings import Settings, info_command, map_command, merge_command

ONE, OTHER = Settings(memory=2.5), Settings()


def test_tasks_are_told():
    assert "--memory=2.5" in map_command(Path("a"), Path("b"), ONE)
    assert "--memory=2.5" in merge_command([Path("a")], Path("b"), ONE)
    assert not any("--memory" in word for word in info_command(Path("a"), ONE))
    assert not any("--memory" in word for word in map_command(Path("a"), Path("b"), OTHER))


def test_results_are_the_same():
    assert ONE.describe() == OTHER.describe()
