"""Shapes of quadrics against LAPACK."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from calibslam_backend.geometry.ellipsoid import Ellipsoid, matrix_from_vector
from calibslam_backend.geometry.shape import _eigen, shapes
from calibslam_msgs_py.measurements import Array

entries = st.one_of(st.floats(-5.0, 5.0), st.sampled_from([0.0, 1e-12, -1e-8, 1.0, 1.0 + 1e-13]))
logarithmic_shapes = st.lists(entries, min_size=6, max_size=6).map(np.array)


@settings(max_examples=300, deadline=None, derandomize=True)
@given(L=logarithmic_shapes)
def test_eigenvectors_against_lapack(L: Array) -> None:
    """Equal, nearly equal and vanishing eigenvalues included; they come in no order."""
    values, V = np.empty(3), np.empty((3, 3))
    _eigen(np.concatenate([np.zeros(3), L]), values, V)
    matrix = matrix_from_vector(L)
    scale = max(float(np.abs(matrix).max()), 1e-300)
    np.testing.assert_allclose(np.sort(values), np.linalg.eigvalsh(matrix), rtol=0.0, atol=1e-14 * scale * 10)
    np.testing.assert_allclose(V.T @ V, np.eye(3), atol=1e-14)
    np.testing.assert_allclose((V * values) @ V.T, matrix, rtol=0.0, atol=1e-13 * scale)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(Ls=st.lists(logarithmic_shapes, min_size=0, max_size=4))
def test_shapes_are_exponentials(Ls: list[Array]) -> None:
    """S = exp(2 L), through the eigenvalues of LAPACK."""
    vectors = np.array([[1.0, 2.0, 3.0, *L] for L in Ls]).reshape(-1, 9)
    found = shapes(vectors)
    assert found.shape == (len(Ls), 3, 3)
    for S, L in zip(found, Ls, strict=True):
        values, V = np.linalg.eigh(matrix_from_vector(L))
        expected = (V * np.exp(2.0 * values)) @ V.T
        np.testing.assert_allclose(S, expected, rtol=0.0, atol=1e-12 * np.abs(expected).max())


def test_shapes_by_hand() -> None:
    """Radii of 1, 2 and 3 along the axes, and a ball."""
    along = Ellipsoid(np.eye(4), np.array([1.0, 2.0, 3.0])).vector()
    np.testing.assert_allclose(shapes(np.stack([along, np.zeros(9)])), [np.diag([1.0, 4.0, 9.0]), np.eye(3)])
