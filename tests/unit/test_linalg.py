import numpy as np
import pytest

from fgtrack.core.linalg import inverse_roots


@pytest.mark.parametrize("shape", [(1, 1, 1), (7, 2, 2), (50, 5, 5), (3, 4, 6, 6)])
def test_inverse_roots_solve_a_stack_of_systems(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(len(shape))
    A = rng.normal(size=shape)
    S = A @ A.mT + 0.1 * np.eye(shape[-1])
    W = inverse_roots(S)
    assert np.abs(W @ S @ W.mT - np.eye(shape[-1])).max() < 1e-10
    np.testing.assert_allclose(W.mT @ (W @ A), np.linalg.solve(S, A), rtol=1e-9, atol=1e-9)


def test_a_stack_with_one_matrix_that_is_not_positive_definite_has_no_inverse_roots() -> None:
    S = np.array([np.eye(2), -np.eye(2)])
    with pytest.raises(np.linalg.LinAlgError):
        inverse_roots(S)
