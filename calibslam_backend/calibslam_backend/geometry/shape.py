"""The shape S = exp(2 L) of quadrics, and its derivative by their logarithmic shape L (see `ellipsoid`)."""

from __future__ import annotations

import math

import numba
import numpy as np

# L is stored as (L11, L22, L33, sqrt2 L12, sqrt2 L13, sqrt2 L23): its length is the Frobenius norm of L.
_ROWS, _COLUMNS = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])
ROOT2 = np.sqrt(2.0)


@numba.njit(cache=True)
def _eigen(v, values, V):  # type: ignore[no-untyped-def]
    """Eigenvalues (3,) and vectors (columns of V) of the L of a vector (t, L), by Jacobi's rotations.

    Of a matrix this small they take a tenth of the time of a call into LAPACK.
    """
    L = np.empty((3, 3))
    largest = 0.0
    for n in range(6):
        entry = v[3 + n] if n < 3 else v[3 + n] / ROOT2
        L[_ROWS[n], _COLUMNS[n]] = entry
        L[_COLUMNS[n], _ROWS[n]] = entry
        largest = max(largest, abs(entry))
    V[:] = 0.0
    for i in range(3):
        V[i, i] = 1.0
    for _ in range(20):  # converges quadratically, after four or five
        if abs(L[0, 1]) + abs(L[0, 2]) + abs(L[1, 2]) <= 1e-15 * largest:
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if L[p, q] == 0.0:
                    continue
                theta = 0.5 * (L[q, q] - L[p, p]) / L[p, q]
                t = 1.0 / (abs(theta) + math.sqrt(theta * theta + 1.0))
                if theta < 0.0:
                    t = -t
                c = 1.0 / math.sqrt(t * t + 1.0)
                s = t * c
                r = 3 - p - q
                change = t * L[p, q]
                L[p, p] -= change
                L[q, q] += change
                L[p, q] = 0.0
                L[q, p] = 0.0
                a, b = L[r, p], L[r, q]
                L[r, p] = c * a - s * b
                L[p, r] = L[r, p]
                L[r, q] = s * a + c * b
                L[q, r] = L[r, q]
                for i in range(3):
                    a, b = V[i, p], V[i, q]
                    V[i, p] = c * a - s * b
                    V[i, q] = s * a + c * b
    for i in range(3):
        values[i] = L[i, i]


@numba.njit(cache=True)
def _compose(V, values, S):  # type: ignore[no-untyped-def]
    """S = V diag(values) V^T."""
    for i in range(3):
        for j in range(i, 3):
            S[i, j] = V[i, 0] * values[0] * V[j, 0] + V[i, 1] * values[1] * V[j, 1] + V[i, 2] * values[2] * V[j, 2]
            S[j, i] = S[i, j]


@numba.njit(cache=True)
def shapes(vectors):  # type: ignore[no-untyped-def]
    """S = exp(2 L), (M, 3, 3) [m^2], of quadrics (M, 9)."""
    result = np.empty((len(vectors), 3, 3))
    logarithms, V = np.empty(3), np.empty((3, 3))
    for m in range(len(vectors)):
        _eigen(vectors[m], logarithms, V)
        _compose(V, np.exp(2.0 * logarithms), result[m])
    return result


@numba.njit(cache=True)
def shape_and_derivative(v, S, dS):  # type: ignore[no-untyped-def]
    """S = exp(2 L) for the vector v = (t, L), and its derivative dS (6, 3, 3) by L (Daleckii and Krein)."""
    logarithms, V = np.empty(3), np.empty((3, 3))
    _eigen(v, logarithms, V)
    squares = np.exp(2.0 * logarithms)
    _compose(V, squares, S)
    F = np.empty((3, 3))  # divided differences of exp(2 l)
    for a in range(3):
        for b in range(3):
            d = logarithms[a] - logarithms[b]
            if abs(d) > 1e-5:
                F[a, b] = (squares[a] - squares[b]) / d
            else:
                F[a, b] = 2.0 * np.exp(logarithms[a] + logarithms[b])
    G = np.empty((3, 3))
    for n in range(6):
        r, c = _ROWS[n], _COLUMNS[n]
        for a in range(3):
            for b in range(3):
                if n < 3:
                    G[a, b] = F[a, b] * V[r, a] * V[r, b]
                else:
                    G[a, b] = F[a, b] * (V[r, a] * V[c, b] + V[c, a] * V[r, b]) / ROOT2
        for i in range(3):
            for j in range(i, 3):
                entry = 0.0
                for a in range(3):
                    entry += V[i, a] * (G[a, 0] * V[j, 0] + G[a, 1] * V[j, 1] + G[a, 2] * V[j, 2])
                dS[n, i, j] = entry
                dS[n, j, i] = entry
