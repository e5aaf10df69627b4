"""`fgtrack verify`: the certificate of exactness."""

import json
from typing import Annotated

import numpy as np
import typer
from rich.table import Table

from fgtrack.cli.arguments import Json
from fgtrack.cli.show import console, progress, say, table
from fgtrack.pipeline import verify as pipeline
from fgtrack.pipeline.verify import Certificate, Check

_SEED = 1
_BAD = 1


def verify(
    as_json: Json = False,
    name: Annotated[str | None, typer.Option("-e", "--estimator", help="This one, exact or not.")] = None,
) -> int:
    """Certify that estimates are right in any order of arrival.

    Of all estimators that claim to be exact, plug-ins included, against a calculation that shares no code with them.
    Exit code 1 where one is not.
    """
    subjects = pipeline.exact_estimators() if name is None else pipeline.one_estimator(name)
    with progress("verify"):
        certificate = pipeline.verify(np.random.default_rng(_SEED), subjects)
    if as_json:
        print(json.dumps(certificate.as_dict(), indent=2, allow_nan=False))
    else:
        console().print(_table(certificate))
        say(_closing(certificate))
    return _BAD if certificate.missed else 0


def _table(certificate: Certificate) -> Table:
    numbers = (">mean\n[sigma]", ">covariance\n[relative]", ">tolerance")
    rows = table("stream", "estimator", "order", "against", *numbers, "verdict")
    last = None
    for check in certificate.checks:
        if last not in (None, check.stream):
            rows.add_section()
        last = check.stream
        tolerance = "-" if check.tolerance is None else f"{check.tolerance:.0e}"
        differences = (f"{check.mean_sigma:.1e}", f"{check.covariance:.1e}")
        rows.add_row(
            check.stream, check.estimator, check.order, check.against, *differences, tolerance, _verdict(check)
        )
    return rows


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
