"""What the shell offers for names: those that are shipped, and the estimators."""

from collections.abc import Callable, Iterable

Completion = Callable[[str], list[str]]


def _shipped(kind: str) -> Completion:
    def names(incomplete: str) -> list[str]:
        from fgtrack.pipeline.shipped import shipped  # loads much, and is only needed here

        return _beginning(shipped(kind), incomplete)  # type: ignore[arg-type]  # a kind of `shipped`

    return names


configurations, scenarios, sweeps = map(_shipped, ("configuration", "scenario", "sweep"))


def estimators(incomplete: str) -> list[str]:
    """Names of estimators, of several with commas between them the last."""
    from fgtrack.estimation.registry import ESTIMATORS

    before, comma, last = incomplete.rpartition(",")
    return [f"{before}{comma}{name}" for name in _beginning(ESTIMATORS, last)]


def _beginning(names: Iterable[str], start: str) -> list[str]:
    return [name for name in names if name.startswith(start)]
