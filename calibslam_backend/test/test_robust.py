"""The outlier model: loss and weight by hand, and against each other."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibslam_backend.graph.robust import robust_loss, robust_scales

scales = st.floats(0.1, 100.0)


@pytest.mark.parametrize(
    ("q", "k", "rho", "weight"),
    [
        (0.0, 2.0, 0.0, 1.0),
        (3.0, 2.0, 3.0, 1.0),  # below k^2 = 4: as it is
        (4.0, 2.0, 4.0, 1.0),
        (4.0 * np.e, 2.0, 8.0, 1.0 / np.e),  # 4 (1 + log e)
        (400.0, 2.0, 4.0 * (1.0 + np.log(100.0)), 0.01),
        (1.0, 0.5, 0.25 * (1.0 + np.log(4.0)), 0.25),
    ],
)
def test_by_hand(q: float, k: float, rho: float, weight: float) -> None:
    assert robust_loss(q, k) == pytest.approx((rho, weight), rel=1e-12)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(k=scales, share=st.floats(1e-3, 1e4))
def test_the_weight_is_the_derivative(k: float, share: float) -> None:
    q = share * k * k
    h = 1e-5 * q
    numerical = (robust_loss(q + h, k)[0] - robust_loss(q - h, k)[0]) / (2.0 * h)
    assert robust_loss(q, k)[1] == pytest.approx(numerical, rel=2e-5)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(k=scales)
def test_continuous_where_doubt_begins(k: float) -> None:
    """Loss and weight; the loss only grows, the weight only falls."""
    below, above = robust_loss(k * k * (1.0 - 1e-9), k), robust_loss(k * k * (1.0 + 1e-9), k)
    assert below == pytest.approx(above, rel=1e-8)
    found = np.array([robust_loss(q, k) for q in k * k * np.geomspace(1e-2, 1e6, 200)])
    assert (np.diff(found[:, 0]) > 0.0).all() and (np.diff(found[:, 1]) <= 0.0).all()


@settings(max_examples=100, deadline=None, derandomize=True)
@given(k=scales, share=st.floats(0.0, 1e6))
def test_scales_make_error_and_linearisation(k: float, share: float) -> None:
    """A residual of squared length q times the first has that of rho; the square of the second is the weight."""
    q = share * k * k
    for_error, for_linearisation = robust_scales(q, k)
    rho, weight = robust_loss(q, k)
    assert for_error**2 * q == pytest.approx(rho, rel=1e-12, abs=1e-300)
    assert for_linearisation**2 == pytest.approx(weight, rel=1e-12)


def test_a_gaussian_keeps_its_information() -> None:
    """Of boxes whose covariance is right, the default k doubts few: they keep nearly all of their weight.

    q is chi-squared with 4 degrees of freedom. Cauchy's weight 1 / (1 + q / k^2) would keep 0.56 of it with k = 2.
    """
    q = np.random.default_rng(0).chisquare(4, size=20_000)
    weights = np.array([robust_loss(each, 2.0)[1] for each in q])
    # E[min(1, 4 / q)] = P(q < 4) + 4 E[1 / q; q > 4] = (1 - 3 e^-2) + 2 e^-2, since E[1 / q; q > c] = e^(-c/2) / 2.
    assert weights.mean() == pytest.approx(1.0 - np.exp(-2.0), abs=0.005)
