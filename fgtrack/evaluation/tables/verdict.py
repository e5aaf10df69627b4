"""Verdict of a comparison: sentences with intervals on the best run, the noise, and the benefit of waiting."""

from collections.abc import Iterator, Mapping, Sequence

from fgtrack.evaluation.comparison import Comparison, Entry
from fgtrack.evaluation.diagnostics.noise import FEWEST, is_far_off
from fgtrack.evaluation.intervals import UNKNOWN
from fgtrack.evaluation.metrics import Metrics
from fgtrack.evaluation.scores.lagged import WINDOW
from fgtrack.evaluation.tables import PERCENT, short, two_digits

_POSITION = "position_rmse_m"


def verdict(
    metrics: Mapping[str, Metrics], compared: Sequence[Comparison]
) -> tuple[str, ...]:
    """Return sentences on the runs of `metrics`, which are given by label.

    Empty for runs without errors and innovations.
    """
    sentences = [
        who_is_best(one.quantities[_POSITION], "at the newest stamp")
        if _POSITION in one.quantities
        else f"{_listed(one.runs)} never track the same object at the same stamp, so they cannot be compared."
        for one in compared
    ]
    alone = [
        label for label in metrics if not any(label in one.runs for one in compared)
    ]
    if len(metrics) > 1 and (len(compared) > 1 or alone):
        sentences.append(
            "Without truth there are no errors to compare."
            if all(one.truth is None for one in metrics.values())
            else "The runs differ in recording, truth or evaluation settings: only runs that share these three are "
            "ranked by their differences."
        )
    best = [
        one.quantities[_POSITION][0].name
        if _POSITION in one.quantities
        else one.runs[0]
        for one in compared
    ]
    for label in (*best, *alone):
        sentences += _noise(label, metrics[label])
    for label, one in metrics.items():
        lags = [
            lag
            for lag in one.lagged
            if lag.is_lagged and lag.lag_s != WINDOW and lag.position_reduction.is_known
        ]
        shares = {
            lag.lag_s: lag.position_reduction for lag in (*lags[:1], *lags[1:][-1:])
        }
        parts = [
            f"{lag_s:g} s by {PERCENT * share.mean:.0f} % ({PERCENT * share.low:.0f} to {PERCENT * share.high:.0f})"
            for lag_s, share in shares.items()
        ]
        if parts:
            sentences.append(
                f"Waiting lowers the position RMSE of {label}: {', '.join(parts)}."
            )
    return tuple(sentences)


def who_is_best(entries: Sequence[Entry], when: str) -> str:
    """Return a sentence on the position RMSE `when`: the best run, and how much worse the other runs are.

    A difference is not resolved if its interval contains 0. Runs tie if they differ
    only by rounding.
    """
    best, *others = entries
    near = [entry for entry in others if entry.standing in ("tie", "unresolved")]
    worse = [entry for entry in others if entry.standing == "worse"]
    value = f"position RMSE {short(best.value)} m"
    names = _listed([best.name, *(one.name for one in near)])
    if not near:
        first = f"{best.name} is best {when} ({value})"
    elif all(entry.standing == "tie" for entry in near):
        first = f"{names} tie {when} ({value})"
    elif len(near) == 1:
        difference = f"{near[0].name} is worse by {_metres(near[0])}"
        first = f"The difference between {names} {when} is not resolved ({value}, {difference})"
    else:
        difference = f"the largest is {_metres(near[-1])}"
        first = f"The differences between {names} {when} are not resolved ({value}, {difference})"
    named = ", ".join(f"{entry.name} is {_metres(entry, ' worse')}" for entry in worse)
    return f"{first}; {named}." if named else f"{first}."


def _metres(entry: Entry, what: str = "") -> str:
    """Return the amount by which `entry` is worse, with its interval; `what` follows the unit."""
    worse = entry.worse_by or UNKNOWN
    scale, unit = (1e3, "mm") if abs(worse.mean) < 0.01 else (1.0, "m")
    mean, low, high = (
        two_digits(scale * value) for value in (worse.mean, worse.low, worse.high)
    )
    amount = f"{mean} {unit}{what}"
    if not worse.is_known:
        return f"{amount}, the run is too short for an interval"
    return (
        f"{amount} ({low} to {high})"
        if what
        else f"{amount}, 95 % interval {low} to {high}"
    )


def _noise(label: str, one: Metrics) -> Iterator[str]:
    """Yield sentences on the consistency of a run's covariances: position NEES and NIS of every sensor."""
    result = one.consistency
    squares = (
        [("NEES of the position", result.position_nees, result.position_nees_interval)]
        if result.position_nees.count
        else []
    )
    squares += [
        (f"NIS of {name}", nis, UNKNOWN)
        for name, nis in result.nis.items()
        if nis.count >= FEWEST
    ]
    texts = {
        name: f"{name} {short(square.mean)} (expected {square.dof:.3g}"
        + (
            f", 95 % interval {two_digits(interval.low)} to {two_digits(interval.high)})"
            if interval.is_known
            else ")"
        )
        for name, square, interval in squares
    }
    far = [
        (name, square, interval)
        for name, square, interval in squares
        if is_far_off(square)
    ]
    off = {
        name: square
        for name, square, interval in far
        if not interval.low <= square.dof <= interval.high
    }
    if off:
        small = [square.mean > square.dof for square in off.values()]
        size = (
            "too small"
            if all(small)
            else "partly too small, partly too large"
            if any(small)
            else "too large"
        )
        yield (
            f"The configured noise is {size} (judged by {label}): {', '.join(texts[name] for name in off)}. "
            "`fgtrack advise --tune` fits the noise, or reports the problem to solve first; this may change the order "
            "of the runs."
        )
    elif far:
        names = ", ".join(texts[name] for name, *_ in far)
        yield f"The run is too short to assess the noise (judged by {label}): {names}."
    elif squares:
        yield f"The noise is consistent (judged by {label}): {', '.join(texts.values())}."


def _listed(names: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
