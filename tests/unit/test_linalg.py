"""Roots of inverse covariances."""

import numpy as np
import pytest

from fgtrack.core.linalg import inverse_root


@pytest.mark.parametrize("n", [1, 2, 5])
def test_an_inverse_root_solves_a_system(n: int) -> None:
    A = np.random.default_rng(n).normal(size=(n, n))
    S = A @ A.T + 0.1 * np.eye(n)
    W = inverse_root(S)
    assert np.abs(W @ S @ W.T - np.eye(n)).max() < 1e-10
    np.testing.assert_allclose(
        W.T @ (W @ A), np.linalg.solve(S, A), rtol=1e-9, atol=1e-9
    )
