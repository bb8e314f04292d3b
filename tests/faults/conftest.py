"""What all tests of faults share: modules beside them, and an end in time."""

import signal
from collections.abc import Iterator

import pytest

_PATIENCE = 60  # s


class Stuck(BaseException):
    """A command does not end."""


@pytest.fixture(autouse=True)
def end_in_time() -> Iterator[None]:
    def stop(*_: object) -> None:
        raise Stuck

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(_PATIENCE)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)
