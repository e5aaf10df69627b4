"""`fgtrack verify`: runs the contract suites over estimators, whole trackers, motion models and measurement models."""

from typing import Annotated

from typer import Option

from fgtrack.cli.arguments import Json
from fgtrack.cli.show import progress, say, show
from fgtrack.core.errors import DataError
from fgtrack.estimation.registry import ESTIMATORS, MOTION_MODELS, Claims
from fgtrack.evaluation.tables import Column, Table
from fgtrack.models.correlated_errors import CorrelatedErrors
from fgtrack.models.measurement import COMPONENTS
from fgtrack.models.motion import CTRV
from fgtrack.testing import (
    BrokenPromiseError,
    estimator_checks,
    measurement_model_checks,
    motion_model_checks,
    tracker_checks,
)

_COLUMNS = (
    Column("name", left=True),
    Column("exact for late measurements", "exact", left=True),
    Column("promises"),
    Column("broken"),
)


def verify(
    as_json: Json = False,
    name: Annotated[
        str | None, Option("-e", "--estimator", help="Check only this estimator.")
    ] = None,
) -> None:
    """Check the contract of estimators, in any order of arrival.

    Checks all installed estimators and motion models, plug-ins included, and all
    measured components. Estimators are compared with direct calculations, shipped
    models with their differential equations and definitions. A whole tracker with each
    exact estimator is compared with itself on messages in order. Exit code 1 if a
    promise is broken.
    """
    names = list(ESTIMATORS.loaded()) if name is None else [ESTIMATORS.resolve(name)]
    broken: dict[str, dict[str, str]] = {}
    with progress("verify"):
        suites = {
            each: (
                Claims.of(ESTIMATORS.load(each)).exact,
                estimator_checks(each, num_streams=2) | tracker_checks(each),
            )
            for each in names
        }
        if name is None:
            models = MOTION_MODELS.loaded().items()
            suites |= {
                each: ("motion model", motion_model_checks(model()))
                for each, model in models
            }
            errors = CorrelatedErrors(
                CTRV(), (("sensor.x_m", 1.0), ("sensor.y_m", 2.0))
            )
            suites["correlated errors"] = ("motion model", motion_model_checks(errors))
            suites |= {
                each: ("measurement", measurement_model_checks(each))
                for each in COMPONENTS
            }
        for each, (_, checks) in suites.items():
            for check in checks.values():
                try:
                    check()
                except BrokenPromiseError as error:
                    broken.setdefault(each, {}).update(error.promises)
    records = [
        {
            "name": each,
            "exact": claim or "-",
            "promises": len(checks),
            "broken": len(broken.get(each, ())),
        }
        for each, (claim, checks) in suites.items()
    ]
    table = Table("Contract of estimators and models", records, _COLUMNS, ("name",))
    promises = sum(len(checks) for _, checks in suites.values())
    values = {
        "met": not broken,
        "promises": promises,
        "checked": list(suites),
        "broken": broken,
    }
    show(table, "json" if as_json else None, values)
    if not as_json:
        for each, result in broken.items():
            for promise, fault in result.items():
                say(f"{each}: broken promise: it {promise}\n{fault}\n")
    if broken:
        raise DataError(
            f"{sum(map(len, broken.values()))} of {promises} promises are broken"
        )
    if not as_json:
        say(f"all {promises} promises are kept")
