"""Which values of a message can be worked with."""

import numpy as np

from fgtrack.core.types import Detection
from fgtrack.models.sensors import SensorModel

#: In any unit: beyond what is tracked, and its square is still far from the largest float.
LARGEST = 1e9
_ASYMMETRY = 1e-6  # of the standard deviations' product: what rounding to single precision may leave


def is_number(value: float) -> bool:
    """Whether `value` is finite and at most `LARGEST`."""
    return abs(value) <= LARGEST


def is_covariance(detection: Detection, sensor: SensorModel) -> bool:
    """Whether the covariance that `detection` carries, if it is used at all, is one: symmetric positive definite."""
    if detection.covariance is None or not sensor.message_covariance:
        return True
    measured = detection.measured
    if len(detection.covariance) != len(measured) ** 2:
        return False
    used = [i for i, name in enumerate(measured) if name in sensor.std]
    own = np.array(detection.covariance).reshape(len(measured), len(measured))[np.ix_(used, used)]
    variances = np.diag(own)
    if not np.all((np.abs(own) <= LARGEST**2) & (variances[:, None] > 0.0)):
        return False
    deviations = np.sqrt(variances)
    if not np.all(np.abs(own - own.T) <= _ASYMMETRY * np.outer(deviations, deviations)):
        return False
    try:
        np.linalg.cholesky(own)
    except np.linalg.LinAlgError:
        return False
    return True
