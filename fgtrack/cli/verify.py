"""`fgtrack verify`: the contract suite over the estimators and motion models that are installed."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated

import typer

from fgtrack.cli.arguments import FormOption, Json
from fgtrack.cli.completion import estimators
from fgtrack.cli.show import chosen_form, progress, say, show
from fgtrack.estimation.registry import ESTIMATORS, MOTION_MODELS, Claims
from fgtrack.evaluation.tables import Column, Table
from fgtrack.testing import BrokenPromiseError, estimator_checks, motion_model_checks

_NUM_STREAMS = 2
_BAD = 1


@dataclass(frozen=True)
class _Row:
    """The outcome of one suite."""

    name: str
    claim: str
    """For which late measurements it is exact; `motion model` of one."""
    num_promises: int
    broken: Mapping[str, str]
    """What is wrong, by promise."""


def verify(
    as_json: Json = False,
    form: FormOption = None,
    name: Annotated[
        str | None, typer.Option("-e", "--estimator", help="This one alone.", autocompletion=estimators)
    ] = None,
) -> int:
    """Check the contract of estimators, in any order of arrival.

    All estimators and motion models that are installed, plug-ins included, on simulated streams, against plain
    calculations. Exit code 1 where a promise is broken.
    """
    form = chosen_form(as_json, form)
    names = list(ESTIMATORS.loaded()) if name is None else [ESTIMATORS.resolve(name)]
    rows = []
    with progress("verify"):
        for each in names:
            rows.append(
                _row(each, Claims.of(ESTIMATORS.load(each)).exact, estimator_checks(each, num_streams=_NUM_STREAMS))
            )
        if name is None:
            models = MOTION_MODELS.loaded().items()
            rows += [_row(each, "motion model", motion_model_checks(model())) for each, model in models]
    broken = {row.name: dict(row.broken) for row in rows if row.broken}
    promises = sum(row.num_promises for row in rows)
    show(
        _table(rows),
        form,
        {"met": not broken, "promises": promises, "checked": [row.name for row in rows], "broken": broken},
    )
    if form is None:
        for each, found in broken.items():
            for promise, what in found.items():
                say(f"{each}: broken promise: it {promise}\n{what}\n")
        num_broken = sum(map(len, broken.values()))
        say(f"{num_broken} of {promises} promises broken" if broken else f"all {promises} promises kept")
    return _BAD if broken else 0


def _row(name: str, claim: str, checks: Mapping[str, Callable[[], None]]) -> _Row:
    broken: dict[str, str] = {}
    for check in checks.values():
        try:
            check()
        except BrokenPromiseError as error:
            broken.update(error.promises)
    return _Row(name, claim, len(checks), broken)


def _table(rows: list[_Row]) -> Table:
    records = [
        {"name": row.name, "exact": row.claim or "-", "promises": row.num_promises, "broken": len(row.broken)}
        for row in rows
    ]
    columns = [
        Column("name", left=True),
        Column("exact for late measurements", "exact", left=True),
        Column("promises"),
        Column("broken"),
    ]
    return Table("Contract of estimators and motion models", records, columns, ("name",))
