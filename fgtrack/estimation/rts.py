"""The backward step of the smoother of Rauch, Tung and Striebel."""

from fgtrack.core.linalg import applied, congruence, psd_solve, symmetrise
from fgtrack.core.types import FloatArray
from fgtrack.estimation.filters.ekf import Prediction


def rts_step(
    mean: FloatArray, covariance: FloatArray, predicted: Prediction, shift: FloatArray, after: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a state, or a stack of them, after the smoothing of the next one, and C = Cov(x, x_next) P_next^-1.

    Of `mean` (..., n) and `covariance` (..., n, n): x + C s and P + C (P_s - P_next) C' with the prediction P_next of
    the next state, by how much it was moved in the smoothing, s = `shift` (..., n), and its covariance then, P_s =
    `after` (..., n, n). Rauch, Tung and Striebel, Maximum likelihood estimates of linear dynamic systems, AIAA Journal
    3(8), 1965. Raises `numpy.linalg.LinAlgError` for a singular P_next.
    """
    C = psd_solve(predicted.covariance, predicted.cross).mT
    P = covariance + congruence(C, after - predicted.covariance)
    return mean + applied(C, shift), symmetrise(P), C
