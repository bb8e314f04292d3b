"""SE(2) against complex numbers and 3 x 3 algebra."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from stillmap.core import se2

angles = st.floats(-50.0, 50.0)
lengths = st.floats(-1e3, 1e3)
poses = st.tuples(lengths, lengths, angles)


@given(poses, st.tuples(lengths, lengths))
def test_a_matrix_turns_then_shifts(pose, point):
    # a pose acts on z = x + iy as z -> e^(i theta) z + t
    x, y, theta = pose
    expected = np.exp(1j * theta) * complex(*point) + complex(x, y)
    got = se2.matrix(x, y, theta) @ [*point, 1.0]
    np.testing.assert_allclose(got, [expected.real, expected.imag, 1.0], atol=1e-9)


@given(poses)
def test_parameters_undo_matrix(pose):
    x, y, theta = se2.parameters(se2.matrix(*pose))
    assert (x, y) == (pose[0], pose[1])
    assert -np.pi <= theta <= np.pi
    assert np.exp(1j * theta) == pytest.approx(np.exp(1j * pose[2]))


@given(lengths, lengths, st.floats(-3.1, 3.1))
def test_log_undoes_the_exponential(x, y, theta):
    twist = np.array([[0.0, -theta, x], [theta, 0.0, y], [0.0, 0.0, 0.0]])
    got = se2.log(expm(twist))
    np.testing.assert_allclose(got, [x, y, theta], rtol=1e-9, atol=1e-8)


@given(angles)
def test_wrap_keeps_the_direction(angle):
    wrapped = se2.wrap(angle)
    assert -np.pi <= wrapped <= np.pi
    assert np.exp(1j * wrapped) == pytest.approx(np.exp(1j * angle))


def test_leading_axes_broadcast():
    T = se2.matrix(np.arange(6.0).reshape(2, 3), 1.0, [0.1, 0.2, 0.3])
    assert T.shape == (2, 3, 3, 3)
    assert se2.parameters(T).shape == (2, 3, 3)
    np.testing.assert_allclose(se2.inverse(T) @ T, np.broadcast_to(np.eye(3), T.shape), atol=1e-12)
    np.testing.assert_allclose(se2.parameters(T)[1, 2], [5.0, 1.0, 0.3])
    assert se2.matrix([], [], []).shape == (0, 3, 3)
    assert se2.inverse(np.zeros((0, 3, 3))).shape == (0, 3, 3)


def test_inverse_in_space():
    c, s = np.cos(0.7), np.sin(0.7)
    T = np.eye(4)
    T[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ [[1, 0, 0], [0, c, -s], [0, s, c]]
    T[:3, 3] = [1.0, -2.0, 3.0]
    np.testing.assert_allclose(se2.inverse(T) @ T, np.eye(4), atol=1e-12)
