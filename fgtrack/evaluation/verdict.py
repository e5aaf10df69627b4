"""What a comparison says, in plain sentences with their intervals: the best run, the noise, the worth of waiting."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from fgtrack.evaluation.cautions import FEWEST, is_far_off
from fgtrack.evaluation.contest import Contest, Quantity
from fgtrack.evaluation.lagged import WINDOW
from fgtrack.evaluation.metrics import Metrics
from fgtrack.evaluation.paired import UNKNOWN, Estimate
from fgtrack.evaluation.ranking import Entry
from fgtrack.evaluation.tables import short, two_digits

_MOST_NAMED = 3
_MM = 1e3
_CM_M = 0.01
_PERCENT = 100.0


@dataclass(frozen=True)
class _Square:
    """A mean NEES or NIS."""

    name: str
    mean: float
    expected: float
    is_far_off: bool
    interval: Estimate = UNKNOWN
    """Of the mean, where the values are correlated."""

    @property
    def may_be_chance(self) -> bool:
        """Whether what is expected is within the interval."""
        return self.interval.is_known and self.interval.low <= self.expected <= self.interval.high


def verdict(metrics: Mapping[str, Metrics], contests: Sequence[Contest]) -> tuple[str, ...]:
    """Sentences on the runs of `metrics`, by label; nothing on runs without errors and innovations."""
    sentences = [found for contest in contests for found in _positions(contest)]
    alone = [label for label in metrics if not any(label in contest.runs for contest in contests)]
    if len(metrics) > 1 and (len(contests) > 1 or alone):
        sentences.append(_unpaired(metrics, alone))
    for contest in contests:
        sentences += _noise({label: metrics[label] for label in _ranked(contest)})
    for label in alone:
        sentences += _noise({label: metrics[label]})
    sentences += [found for label, one in metrics.items() for found in _waiting(label, one)]
    return tuple(sentences)


def _positions(contest: Contest) -> Iterator[str]:
    """Who is best at the newest stamp."""
    quantity = _position(contest)
    if quantity is None:
        yield f"{_listed(contest.runs)} never track the same object at the same stamp: there is nothing to pair."
        return
    yield who_is_best(quantity.entries, "at the newest stamp")


def who_is_best(entries: Sequence[Entry], when: str) -> str:
    """A sentence on a position RMSE: who is best or ties `when`, and how much worse the others are."""
    best, *others = entries
    ties = [entry for entry in others if entry.standing == "tie"]
    worse = [entry for entry in others if entry.standing == "worse"]
    value = f"position RMSE {short(best.value)} m"
    if ties:
        last = ties[-1]
        difference = f"{'difference' if len(ties) == 1 else 'largest difference'} {_metres(last)}"
        names = _listed([best.name, *(one.name for one in ties)])
        first = f"{names} tie {when} ({value}, {difference})"
    else:
        first = f"{best.name} is best {when} ({value})"
    return f"{first}{'; ' if worse else ''}{_worse(worse)}."


def _worse(entries: Sequence[Entry]) -> str:
    most = _MOST_NAMED if len(entries) > _MOST_NAMED + 1 else len(entries)
    named = [f"{entry.name} is {_metres(entry, ' worse')}" for entry in entries[:most]]
    left = len(entries) - len(named)
    return ", ".join([*named, *([f"{left} more are worse"] if left else [])])


def _metres(entry: Entry, what: str = "") -> str:
    """How much worse `entry` is, with the interval and `what` behind the unit."""
    found = entry.worse_by
    assert found is not None
    scale, unit = (_MM, "mm") if abs(found.mean) < _CM_M else (1.0, "m")
    amount = f"{two_digits(scale * found.mean)} {unit}{what}"
    if not found.is_known:
        return f"{amount}, too short a run for an interval"
    interval = f"{two_digits(scale * found.low)} to {two_digits(scale * found.high)}"
    return f"{amount} ({interval})" if what else f"{amount}, 95 % interval {interval}"


def _unpaired(metrics: Mapping[str, Metrics], alone: Sequence[str]) -> str:
    without = [label for label in alone if metrics[label].truth is None]
    if len(without) == len(metrics):
        return "Without truth there are no errors to compare."
    return (
        "Not all runs are of the same recording with truth (or they are judged by different settings): "
        "only those that are can be told apart by their differences."
    )


def _noise(metrics: Mapping[str, Metrics]) -> Iterator[str]:
    """Whether the covariances of the first run, the best one, fit what happened; who else's do not."""
    (label, one), *others = metrics.items()
    found = list(_squares(one))
    if not found:
        return
    far = [square for square in found if square.is_far_off]
    off = [square for square in far if not square.may_be_chance]
    if off:
        small = [square.mean > square.expected for square in off]
        size = "too small" if all(small) else "partly too small, partly too large" if any(small) else "too large"
        yield (
            f"The configured noise is {size} (judged by {label}): {_named(off)}. "
            "`fgtrack advise --tune` fits it, or says what comes first; the order of the runs may change then."
        )
        return
    if far:
        yield f"Whether the noise fits (judged by {label}) so short a run does not tell: {_named(far)}."
        return
    yield f"The noise fits (judged by {label}): {_named(found)}."
    wrong = {
        other: [square for square in _squares(its) if square.is_far_off and not square.may_be_chance]
        for other, its in others
    }
    runs = [other for other, squares in wrong.items() if squares]
    if runs:
        yield f"Not so of {_listed(runs)}: {_ranges([square for other in runs for square in wrong[other]])}."


def _named(squares: Sequence[_Square]) -> str:
    return ", ".join(map(_text, squares))


def _ranges(squares: Sequence[_Square]) -> str:
    """The names of `squares`, each with its lowest and highest mean."""
    texts = []
    for name in dict.fromkeys(one.name for one in squares):
        mine = [one for one in squares if one.name == name]
        means = dict.fromkeys(short(of(one.mean for one in mine)) for of in (min, max))
        texts.append(f"{name} {' to '.join(means)} (expected {mine[0].expected:.3g})")
    return ", ".join(texts)


def _text(square: _Square) -> str:
    interval = square.interval
    known = f", 95 % interval {two_digits(interval.low)} to {two_digits(interval.high)}" if interval.is_known else ""
    return f"{square.name} {short(square.mean)} (expected {square.expected:.3g}{known})"


def _squares(one: Metrics) -> Iterator[_Square]:
    """NEES of the position, and NIS of every sensor with enough of them."""
    nees, interval = one.consistency.position_nees, one.consistency.position_nees_interval
    if nees.count:
        yield _Square("NEES of the position", nees.mean, nees.dof, is_far_off(nees), interval)
    for sensor, nis in one.consistency.nis.items():
        if nis.count >= FEWEST:
            yield _Square(f"NIS of {sensor}", nis.mean, nis.dof, is_far_off(nis))


def _waiting(label: str, one: Metrics) -> Iterator[str]:
    """What the first and the last lag bring."""
    lags = [
        entry for entry in one.lagged if entry.is_lagged and entry.lag_s != WINDOW and entry.position_reduction.is_known
    ]
    if lags:
        ends = lags if len(lags) == 1 else [lags[0], lags[-1]]
        parts = [f"{entry.lag_s:g} s by {_percent(entry.position_reduction)}" for entry in ends]
        yield f"Waiting lowers the position RMSE of {label}: {', '.join(parts)}."


def _percent(share: Estimate) -> str:
    return f"{_PERCENT * share.mean:.0f} % ({_PERCENT * share.low:.0f} to {_PERCENT * share.high:.0f})"


def _position(contest: Contest) -> Quantity | None:
    return next((one for one in contest.quantities if one.name == "position_rmse_m"), None)


def _ranked(contest: Contest) -> Sequence[str]:
    """The runs, the best one first."""
    quantity = _position(contest)
    return contest.runs if quantity is None else [entry.name for entry in quantity.entries]


def _listed(names: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
