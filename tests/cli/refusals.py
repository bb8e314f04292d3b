"""Check of refused calls."""

import subprocess


def refused(done: subprocess.CompletedProcess[str], *words: object) -> None:
    """Exit status 2, one line on stderr with these words, nothing on stdout."""
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("stillmap")
    assert done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.endswith("\n")
    for word in words:
        assert str(word) in done.stderr
