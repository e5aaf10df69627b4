"""`fgtrack verify`: the certificate of exactness."""

import math
from typing import Annotated

import numpy as np
import typer

from fgtrack.cli.arguments import All, FormOption, Json
from fgtrack.cli.completion import estimators
from fgtrack.cli.show import chosen_form, progress, say, show
from fgtrack.evaluation.tables import Column, Table, Value
from fgtrack.pipeline import verify as pipeline
from fgtrack.pipeline.certificate import Certificate, Check

_SEED = 1
_BAD = 1


def verify(
    as_json: Json = False,
    form: FormOption = None,
    everything: All = False,
    name: Annotated[
        str | None, typer.Option("-e", "--estimator", help="This one, exact or not.", autocompletion=estimators)
    ] = None,
) -> int:
    """Certify that estimates are right in any order of arrival.

    Of all estimators that claim to be exact, plug-ins included, against a calculation that shares no code with them.
    Exit code 1 where one is not.
    """
    form = chosen_form(as_json, form)
    subjects = pipeline.exact_estimators() if name is None else pipeline.one_estimator(name)
    with progress("verify"):
        certificate = pipeline.verify(np.random.default_rng(_SEED), subjects)
    checks = _table(certificate)
    show(checks.in_full() if everything else checks, form, certificate.as_dict())
    if form is None:
        say(_closing(certificate))
    return _BAD if certificate.missed else 0


def _table(certificate: Certificate) -> Table:
    def known(check: Check) -> tuple[Value, ...] | None:
        return None if check.tolerance is None else (check.tolerance,)

    columns: list[Column[Check]] = [
        Column("stream", ("stream",), lambda check: (check.stream,), left=True),
        Column("estimator", ("estimator",), lambda check: (check.estimator,), left=True),
        Column("order", ("order",), lambda check: (check.order,), left=True, when="full"),
        Column("against", ("against",), lambda check: (check.against,), left=True, when="full"),
        Column("mean\n[sigma]", ("mean_sigma",), lambda check: (check.mean_sigma,), text=_power),
        Column("covariance\n[relative]", ("covariance",), lambda check: (check.covariance,), text=_power),
        Column("tolerance", ("tolerance",), known, text=lambda value: f"{value:.0e}"),
        Column("verdict", ("verdict",), lambda check: (_verdict(check),), left=True),
    ]
    nearest: dict[tuple[str, str], Check] = {}
    for check in certificate.checks:
        key = check.stream, check.estimator
        nearest[key] = max(nearest.get(key, check), check, key=_share)
    shown = [*map(id, nearest.values()), *(id(check) for check in certificate.checks if not check.met)]
    return Table(
        "Largest differences from what is right, in any order of arrival",
        columns,
        certificate.checks,
        row_keys=("stream", "estimator", "order", "against"),
        detail_rows=lambda check: id(check) not in shown,
    )


def _share(check: Check) -> float:
    """How much of its tolerance a check takes up."""
    return max(check.mean_sigma, check.covariance) / (check.tolerance or math.inf)


def _power(value: Value) -> str:
    return f"{value:.1e}"


def _verdict(check: Check) -> str:
    if check.tolerance is None:
        return "no promise"
    if check.num_refused:
        return f"{check.num_refused} not fused"
    return "met" if check.met else "missed"


def _closing(certificate: Certificate) -> str:
    num_missed = len(certificate.missed)
    if not num_missed:
        return f"all {certificate.num_promises} tolerances met: estimates are right, in whatever order of arrival"
    return f"{num_missed} of {certificate.num_promises} tolerances missed: estimates are wrong, or not in every order"
