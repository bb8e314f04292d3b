from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from small_bags import KINDS, Messages, write_bag


@pytest.fixture(params=KINDS)
def kind(request: pytest.FixtureRequest) -> str:
    """Every kind of bag."""
    return str(request.param)


@pytest.fixture
def messages(kind: str) -> Messages:
    """Makes messages for bags of this kind."""
    return Messages("ros1" if kind == "bag" else "cdr")


@pytest.fixture
def bag(tmp_path: Path, kind: str, messages: Messages) -> Callable[..., Path]:
    """Writes (topic, log time, (type, message or bytes)) as a bag of this kind; gives its path."""

    def write(content: list[tuple[str, int, tuple[str, Any]]], name: str = "tiny") -> Path:
        return write_bag(tmp_path, kind, messages, content, name)

    return write
