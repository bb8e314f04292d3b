"""What an editor, `help` and `inspect` show of the package, whose parts load when first used."""

import inspect

import pytest

import stillmap


def test_every_name_is_there_and_listed():
    assert set(stillmap.__all__) <= set(dir(stillmap))
    assert [name for name in stillmap.__all__ if not hasattr(stillmap, name)] == []
    assert stillmap.__all__ == sorted(stillmap.__all__)
    with pytest.raises(AttributeError, match="no attribute 'buidl'"):
        stillmap.buidl  # noqa: B018


def test_build_says_what_it_takes():
    signature = inspect.signature(stillmap.build)
    assert list(signature.parameters)[:2] == ["recording", "options"]
    keywords = [p.name for p in signature.parameters.values() if p.kind is p.KEYWORD_ONLY]
    assert keywords == ["resolution", "odometry", "poses", "progress", "scratch"]
