"""Confidence intervals of 95 %: of differences paired over seeds, and of correlated errors within one run."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fgtrack.core.types import FloatArray, IntArray

# Quantile of a two-sided 95 % interval.
_UPPER = 0.975
# Largest number of pieces of a run. With finer pieces the correlation length would depend on the tick rate.
_MOST_PIECES = 400
_FEWEST_PIECES = 8
_FEWEST_COSINES = 4
# A run has one cosine per this number of correlation lengths.
_LENGTHS = 5.0
# Number of successive insignificant correlations that ends the search for significant ones.
_IN_A_ROW = 5
# Relative difference of the numerical gradient.
_STEP = 1e-5
#: Function that computes a number from sums over time, (k, ...) -> (...).
Statistic = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class Estimate:
    """A number and its 95 % confidence interval; unknown numbers are NaN."""

    mean: float
    low: float
    high: float
    count: int
    """Number of independent samples: the number of seeds, or the degrees of freedom of a run plus 1."""

    @property
    def is_significant(self) -> bool:
        """True if the interval is known and excludes 0."""
        return self.low > 0.0 or self.high < 0.0

    @property
    def is_known(self) -> bool:
        """True if the interval is known."""
        return math.isfinite(self.low) and math.isfinite(self.high)

    def __format__(self, spec: str) -> str:
        """Return the mean, and the interval in brackets; `spec` formats each number."""
        return f"{self.mean:{spec}} ({self.low:{spec}} to {self.high:{spec}})"


UNKNOWN = Estimate(math.nan, math.nan, math.nan, 0)


def paired(
    values_a: Sequence[float] | FloatArray, values_b: Sequence[float] | FloatArray
) -> Estimate:
    """Mean of `values_a` minus `values_b` and its 95 % interval, see `average`.

    Entry k of both belongs to the same seed.
    """
    a = np.asarray(values_a, dtype=np.float64)
    b = np.asarray(values_b, dtype=np.float64)
    return average((a - b)[np.isfinite(a) & np.isfinite(b)])


def average(values: Sequence[float] | FloatArray) -> Estimate:
    """Mean of `values`, one per seed, and its 95 % interval mean +- t(n - 1) std / sqrt(n).

    NaN is ignored.
    """
    known = np.asarray(values, dtype=np.float64)
    known = known[~np.isnan(known)]
    if not len(known):
        return UNKNOWN
    error = (
        float(known.std(ddof=1)) / math.sqrt(len(known)) if len(known) > 1 else math.nan
    )
    return _t_interval(float(known.mean()), error, len(known))


def within_run(ticks: FloatArray, statistic: Statistic) -> Estimate:
    """Return `statistic` of the sums of `ticks` over time, with its 95 % interval.

    `ticks`, shape (n, k), are in order of time. `statistic` takes sums of shape (k, m),
    and returns shape (m,). For instance a root mean square is sqrt(S[0] / S[1]), with
    the sums S of squared errors and counts.

    To first order, tick t adds x_t to the statistic; these numbers are correlated. The
    variance of their sum is the mean of 2 (sum of x_t cos(pi j (t + 1/2) / n))^2 over j
    = 1 ... B (equal-weighted cosines). The interval uses Student's t with B degrees of
    freedom. B is a fifth of the number of correlation lengths (`correlation_length`) in the run, at
    least 4, and at most a quarter of the number of ticks. So the spectrum is flat over
    these frequencies. More than 400 ticks are first summed in pieces. The interval is
    unknown for fewer than eight ticks.

    Sources: Lazarus, Lewis, Stock and Watson 2018 (Journal of Business & Economic
    Statistics 36(4)); Mueller 2007 (Journal of Econometrics 141(2)).
    """
    sums = ticks.sum(axis=0)
    size = max(1, math.ceil(len(ticks) / _MOST_PIECES))
    pieces = (
        np.add.reduceat(ticks, np.arange(0, len(ticks), size), axis=0)
        if len(ticks)
        else ticks
    )
    n = len(pieces)
    with np.errstate(divide="ignore", invalid="ignore"):  # an empty mean is NaN
        value = float(statistic(sums))
        if n < _FEWEST_PIECES or not math.isfinite(value):
            return Estimate(value, math.nan, math.nan, n)
        # The change is 0 for a sum of 0, which consists of zeros.
        steps = np.diag(_STEP * sums)
        change = statistic((sums + steps).T) - statistic((sums - steps).T)
    x = pieces @ np.divide(
        change, 2.0 * _STEP * sums, out=np.zeros_like(sums), where=sums != 0.0
    )
    freedom = min(
        max(int(n / (_LENGTHS * correlation_length(x))), _FEWEST_COSINES), n // 4
    )
    cosines = np.cos(
        math.pi / n * np.outer(np.arange(1, freedom + 1), np.arange(n) + 0.5)
    )
    return _t_interval(
        value, math.sqrt(2.0 * float(np.square(cosines @ x).mean())), freedom + 1
    )


def mean_square(ticks: FloatArray) -> Estimate:
    """Ratio S[0] / S[1] of the sums S of `ticks`, see `within_run`.

    The interval is computed for the logarithm, so it is positive.
    """
    log = within_run(ticks, lambda S: np.log(S[0] / S[1]))
    with np.errstate(over="ignore"):
        mean, low, high = np.exp([log.mean, log.low, log.high]).tolist()
    return Estimate(mean, low, high, log.count)


def sums_by_stamp(stamps_ns: IntArray, samples: FloatArray) -> FloatArray:
    """Return the sums of the `samples` (n, k) of each stamp, and their number in the last column, shape (m, k + 1).

    The rows are in ascending order of the m distinct stamps. Samples with NaN are ignored.
    """
    known = np.isfinite(samples).all(axis=1)
    distinct, index = np.unique(stamps_ns, return_inverse=True)
    columns = [*samples[known].T, np.ones(int(known.sum()))]
    return np.stack(
        [np.bincount(index[known], column, len(distinct)) for column in columns],
        axis=-1,
    )


def correlation_length(values: FloatArray) -> float:
    """Sum of the autocorrelations of `values`, shape (n,), over positive and negative lags; from 1 to n.

    The correlations are weighted by the flat-top window of Politis and White 2004
    (Econometric Reviews 23). The window is twice as wide as the first lag after which
    five successive correlations are insignificant. The result is n if this lag is not
    below n / 4.
    """
    n = len(values)
    centred = values - values.mean()
    spectrum = np.fft.rfft(centred, 2 * n)
    R = np.fft.irfft(spectrum.real**2 + spectrum.imag**2)[:n] / n
    if not R[0] > 0.0:
        return 1.0
    small = (np.abs(R[1:]) < 2.0 * math.sqrt(math.log10(n) / n) * R[0]).tolist()
    last = next((k for k in range(n // 4) if all(small[k : k + _IN_A_ROW])), None)
    if last is None:
        return float(n)
    width = min(2 * max(last, 1), n // 2)
    lags = np.arange(1, width + 1)
    weighted = 2.0 * np.minimum(1.0, 2.0 * (1.0 - lags / width)) * R[1 : width + 1]
    return min(max(1.0 + float(weighted.sum() / R[0]), 1.0), float(n))


def _t_interval(mean: float, error: float, count: float) -> Estimate:
    """Estimate with the t interval of `mean`.

    `error` is its standard error, from `count` independent pieces.
    """
    from scipy.special import stdtrit

    half = float(stdtrit(count - 1.0, _UPPER)) * error if count > 1.0 else math.nan
    return Estimate(mean, mean - half, mean + half, int(count))
