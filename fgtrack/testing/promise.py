"""One promise of the contract of estimators, and how it is checked."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Estimator, UpdateResult
from fgtrack.estimation.registry import Claims, Factory, start_estimator
from fgtrack.testing.streams import LAG_S, Stream


class BrokenPromiseError(AssertionError):
    """Error of a broken contract; `promises` holds the fault of each broken promise, by its name."""

    def __init__(self, what: str, promises: Mapping[str, str]) -> None:
        super().__init__(
            "\n\n".join(
                f"{what}: broken promise: it {name}\n{text}"
                for name, text in promises.items()
            )
        )
        self.promises = dict(promises)


def run_all(what: str, checks: Mapping[str, Callable[[], None]]) -> None:
    """Run all `checks`; raise one `BrokenPromiseError` with every promise that they report as broken."""
    broken: dict[str, str] = {}
    for check in checks.values():
        try:
            check()
        except BrokenPromiseError as error:
            broken.update(error.promises)
    if broken:
        raise BrokenPromiseError(what, broken)


class WrongError(Exception):
    """Fault of an estimator. The runner adds the measurements that show the fault."""


def require(condition: object, text: str) -> None:
    """Raise `WrongError` with `text` unless `condition` holds."""
    if not condition:
        raise WrongError(text)


def sound(mean: FloatArray, covariance: FloatArray, what: str) -> None:
    """Raise `WrongError` unless a mean is finite and a covariance symmetric and positive definite."""
    require(np.isfinite(mean).all(), f"the mean of {what} is {mean}")
    require(
        (covariance == covariance.T).all(), f"the covariance of {what} is not symmetric"
    )
    scale = np.sqrt(np.abs(np.diag(covariance)))
    known = np.isfinite(scale).all() and (np.diag(covariance) > 0.0).all()
    least = (
        np.linalg.eigvalsh(covariance / np.outer(scale, scale)).min()
        if known
        else -np.inf
    )
    require(least > 0.0, f"the covariance of {what} is not positive definite")


# Any: a check of an estimator or of a motion model.
def fault(check: Callable[..., None], *arguments: Any) -> str:
    """Return the fault that `check` raises for `arguments`, or an empty text."""
    try:
        check(*arguments)
    except WrongError as error:
        return str(error)
    except Exception as error:  # of a foreign estimator or model: anything
        return f"{type(error).__name__}: {error}"
    return ""


@dataclass(frozen=True)
class Subject:
    """An estimator under test."""

    name: str
    factory: Factory
    claims: Claims
    options: Mapping[str, Any]

    def start(self, stream: Stream) -> Estimator:
        """Return a new estimator of the object of `stream`."""
        return start_estimator(
            self.name, self.factory, stream.motion, stream.start, LAG_S, self.options
        )

    def fed(self, stream: Stream) -> tuple[Estimator, list[UpdateResult]]:
        """Return a new estimator that has fused all measurements of `stream`, and the results."""
        estimator = self.start(stream)
        return estimator, [
            estimator.update(measurement) for measurement in stream.measurements
        ]


Draw = Callable[[np.random.Generator], Stream]


@dataclass(frozen=True)
class Promise:
    """Promise of an estimator on streams of one kind."""

    check: Callable[[Subject, Stream], None]
    draws: tuple[Draw, ...]
    applies: Callable[[Claims], bool] = lambda claims: True
    """True if an estimator with these claims promises it."""
    repeats: bool = False
    """True if the promise is checked on many streams."""

    def run(self, subject: Subject, seed: int, num_streams: int) -> None:
        """Raise `BrokenPromiseError` with the smallest part of a stream that still breaks the promise."""
        for kind, draw in enumerate(self.draws):
            for number in range(num_streams if self.repeats else 1):
                stream = draw(np.random.default_rng([seed, kind, number]))
                wrong = fault(self.check, subject, stream)
                index = 0
                while wrong and index < len(stream.measurements) > 1:
                    fewer = (
                        stream.measurements[:index] + stream.measurements[index + 1 :]
                    )
                    smaller = replace(stream, measurements=fewer)
                    if still := fault(self.check, subject, smaller):
                        stream, wrong = smaller, still
                    else:
                        index += 1
                if wrong:
                    raise BrokenPromiseError(
                        subject.name, {self.name: f"{wrong}\n{stream}"}
                    )

    @property
    def name(self) -> str:
        """Name of the promise: a sentence without its subject."""
        return self.check.__name__.removeprefix("_").replace("_", " ")
