"""The contract suites: what every estimator and every motion model must do, as checks that name the broken promise."""

from fgtrack.testing.estimators import check_estimator, estimator_checks
from fgtrack.testing.motion_models import check_motion_model, motion_model_checks
from fgtrack.testing.promise import BrokenPromiseError

__all__ = ["BrokenPromiseError", "check_estimator", "check_motion_model", "estimator_checks", "motion_model_checks"]
