"""What the sessions of a place know about themselves."""

from types import SimpleNamespace

import numpy as np
import pytest

from stillmap.places.place import PlacedSession


@pytest.mark.parametrize(("dimension", "dof"), [(2, 3), (3, 6)])
def test_the_first_session_has_a_covariance_of_zero(dimension: int, dof: int) -> None:
    session = SimpleNamespace(dimension=dimension)
    first = PlacedSession(session, np.tile(np.eye(dimension + 1), (2, 1, 1)))  # type: ignore[arg-type]
    np.testing.assert_array_equal(first.known_covariance, np.zeros((dof, dof)))
