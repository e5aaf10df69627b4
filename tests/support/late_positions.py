"""A plan of late positions: what sensors measure, and when it arrives."""

import numpy as np

from fgtrack.evaluation.bounds import ScheduledMeasurement
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import MotionModel

STEP_NS = 50_000_000


def late_positions(motion: MotionModel, start_ns: int, num_steps: int) -> list[ScheduledMeasurement]:
    """Good positions 151 ms late at every other step, bad ones 62 ms late in between, in order of receipt."""
    position = measurement_model(("x_m", "y_m"), motion)
    found = []
    for k in range(1, num_steps + 1):
        stamp_ns = start_ns + k * STEP_NS
        late_ns, std_m = (151_000_000, 0.3) if k % 2 else (62_000_000, 1.0)
        found.append(ScheduledMeasurement(stamp_ns, stamp_ns + late_ns, position, std_m**2 * np.eye(2)))
    return sorted(found, key=lambda item: item.receipt_ns)
