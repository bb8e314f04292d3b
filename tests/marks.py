"""Parameters of tests that only `make check` runs."""

import pytest


def slow_params(*values):
    """The values, single or tuples, as parameters that are marked slow."""
    rows = (value if isinstance(value, tuple) else (value,) for value in values)
    return [pytest.param(*row, marks=pytest.mark.slow) for row in rows]
