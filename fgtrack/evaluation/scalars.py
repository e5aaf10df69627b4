"""Scalars of the metrics of a run by path, as in the columns of a sweep."""

from collections.abc import Iterator, Mapping, Sequence

from fgtrack.evaluation.metrics import Metrics

Scalar = str | bool | int | float | None


def scalars_of(metrics: Metrics) -> Iterator[tuple[str, Scalar]]:
    """Yield path and value of every scalar of `metrics`; an entry of a list with a lag is named by its lag."""
    return _scalars(metrics.as_dict(), "")


def _scalars(value: object, path: str) -> Iterator[tuple[str, Scalar]]:
    if isinstance(value, Mapping):
        for name, entry in value.items():
            yield from _scalars(entry, f"{path}.{name}" if path else name)
    elif isinstance(value, Sequence) and not isinstance(value, str):
        for index, entry in enumerate(value):
            name = entry.get("lag_s", index) if isinstance(entry, Mapping) else index
            yield from _scalars(entry, f"{path}.{name}")
    elif value is None or isinstance(value, (str, int, float)):
        yield path, value
