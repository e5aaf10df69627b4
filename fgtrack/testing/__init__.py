"""Contract suites of estimators, models and whole trackers, as checks that name the broken promise."""

from fgtrack.testing.estimators import check_estimator, estimator_checks
from fgtrack.testing.measurement_models import (
    check_measurement_models,
    measurement_model_checks,
)
from fgtrack.testing.motion_models import check_motion_model, motion_model_checks
from fgtrack.testing.promise import BrokenPromiseError
from fgtrack.testing.trackers import check_tracker, tracker_checks

__all__ = [
    "BrokenPromiseError",
    "check_estimator",
    "check_measurement_models",
    "check_motion_model",
    "check_tracker",
    "estimator_checks",
    "measurement_model_checks",
    "motion_model_checks",
    "tracker_checks",
]
