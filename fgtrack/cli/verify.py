"""`fgtrack verify`: the contract suite over the estimators and motion models that are installed."""

from collections.abc import Callable, Mapping
from typing import Annotated

from typer import Option

from fgtrack.cli.arguments import Json, estimators
from fgtrack.cli.show import progress, say, show
from fgtrack.estimation.registry import ESTIMATORS, MOTION_MODELS, Claims
from fgtrack.evaluation.tables import Column, Table
from fgtrack.testing import BrokenPromiseError, estimator_checks, motion_model_checks

_NUM_STREAMS = 2
_BAD = 1
_COLUMNS = (
    Column("name", left=True),
    Column("exact for late measurements", "exact", left=True),
    Column("promises"),
    Column("broken"),
)


def verify(
    as_json: Json = False,
    name: Annotated[str | None, Option("-e", "--estimator", help="This one alone.", autocompletion=estimators)] = None,
) -> int:
    """Check the contract of estimators, in any order of arrival.

    All estimators and motion models that are installed, plug-ins included, on simulated streams, against plain
    calculations. Exit code 1 where a promise is broken.
    """
    names = list(ESTIMATORS.loaded()) if name is None else [ESTIMATORS.resolve(name)]
    with progress("verify"):
        suites = {
            each: (Claims.of(ESTIMATORS.load(each)).exact, estimator_checks(each, num_streams=_NUM_STREAMS))
            for each in names
        }
        if name is None:
            models = MOTION_MODELS.loaded().items()
            suites |= {each: ("motion model", motion_model_checks(model())) for each, model in models}
        found_broken = {each: _broken(checks) for each, (_, checks) in suites.items()}
    records = [
        {"name": each, "exact": claim or "-", "promises": len(checks), "broken": len(found_broken[each])}
        for each, (claim, checks) in suites.items()
    ]
    broken = {each: found for each, found in found_broken.items() if found}
    promises = sum(len(checks) for _, checks in suites.values())
    values = {"met": not broken, "promises": promises, "checked": list(suites), "broken": broken}
    show(
        Table("Contract of estimators and motion models", records, _COLUMNS, ("name",)),
        "json" if as_json else None,
        values,
    )
    if not as_json:
        for each, found in broken.items():
            for promise, what in found.items():
                say(f"{each}: broken promise: it {promise}\n{what}\n")
        num_broken = sum(map(len, broken.values()))
        say(f"{num_broken} of {promises} promises broken" if broken else f"all {promises} promises kept")
    return _BAD if broken else 0


def _broken(checks: Mapping[str, Callable[[], None]]) -> dict[str, str]:
    """Return what is wrong, by promise."""
    broken: dict[str, str] = {}
    for check in checks.values():
        try:
            check()
        except BrokenPromiseError as error:
            broken.update(error.promises)
    return broken
