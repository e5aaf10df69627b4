"""Delays of the messages of a sensor: delay = receipt - stamp.

All delays are drawn together, because bursts of delays have a memory.
"""

import math
from dataclasses import field
from functools import cached_property
from typing import Annotated, Literal

import numpy as np
from pydantic import Discriminator, Field, NonNegativeFloat, PositiveFloat

from fgtrack.core.settings import Probability, require, settings
from fgtrack.core.types import FloatArray


@settings
class NoDelay:
    """Messages arrive without delay."""

    kind: Literal["none"] = "none"


@settings
class ConstantDelay:
    """All messages have the same delay."""

    delay_s: NonNegativeFloat
    """Delay of every message."""
    kind: Literal["constant"] = "constant"


@settings
class UniformDelay:
    """Delays are uniform between two limits."""

    min_s: NonNegativeFloat
    """Smallest delay."""
    max_s: NonNegativeFloat
    """Largest delay."""
    kind: Literal["uniform"] = "uniform"

    def __post_init__(self) -> None:
        require(
            self.max_s >= self.min_s, "max_s", "must not be below min_s", self.max_s
        )


@settings
class GammaDelay:
    """Delays are `min_s` plus a gamma variable, given by the mean and the 90 % quantile of the delay.

    Shape k solves quantile(k, 0.9) / k = (q90_s - min_s) / (mean_s - min_s). The left
    side falls from 2.71 at k = 1/2 towards 1; a shape below 1/2 is not available.
    """

    min_s: NonNegativeFloat
    """Smallest delay."""
    mean_s: float
    """Mean delay."""
    q90_s: float
    """90 % quantile of the delay."""
    kind: Literal["gamma"] = "gamma"

    def __post_init__(self) -> None:
        require(self.mean_s > self.min_s, "mean_s", "must be above min_s", self.mean_s)
        low, high = (_relative_q90(math.log(k)) for k in (_MAX_SHAPE, _MIN_SHAPE))
        ratio = (self.q90_s - self.min_s) / (self.mean_s - self.min_s)
        require(
            low <= ratio <= high,
            "q90_s",
            f"no gamma distribution has this quantile: (q90_s - min_s) / (mean_s - min_s) must lie in "
            f"[{low:.3f}, {high:.3f}]",
            self.q90_s,
        )

    @cached_property
    def shape(self) -> float:
        """Shape k of the gamma distribution."""
        from scipy.optimize import brentq

        ratio = (self.q90_s - self.min_s) / (self.mean_s - self.min_s)
        log_shape = brentq(
            lambda x: _relative_q90(x) - ratio,
            math.log(_MIN_SHAPE),
            math.log(_MAX_SHAPE),
            xtol=1e-13,
        )
        return math.exp(log_shape)

    @property
    def scale_s(self) -> float:
        """Scale of the gamma distribution."""
        return (self.mean_s - self.min_s) / self.shape


@settings
class LossyDelay:
    """Each message is lost with `probability`; the others have delays of the model `base`."""

    probability: Probability
    """Probability that a message is lost."""
    base: "AnyDelay" = field(default_factory=NoDelay)
    kind: Literal["loss"] = "loss"


@settings
class MarkovDelay:
    """A Markov chain with the states good and bad that moves from message to message; each state has its delay model.

    After a message in the good state, the next message is in the bad state with
    probability `to_bad`; back with `to_good` (E. N. Gilbert, Capacity of a burst-noise
    channel, Bell System Technical Journal 39(5), 1960). A share to_bad / (to_bad +
    to_good) of the messages is in the bad state, in bursts of 1 / `to_good` messages on
    average. The first message has the stationary distribution.
    """

    good: "AnyDelay"
    bad: "AnyDelay"
    to_bad: Probability
    """Probability that a bad message follows a good one."""
    to_good: Annotated[float, Field(gt=0.0, le=1.0)]
    """Probability that a good message follows a bad one."""
    kind: Literal["markov"] = "markov"


@settings
class MarkovTimeDelay:
    """`MarkovDelay` in continuous time: the link is good or bad, independently of the rate of messages.

    In the good state it turns bad at the rate `to_bad_per_s` (a), and back at
    `to_good_per_s` (b). It is bad for a share a / (a + b) of the time, for 1 / b on
    average. Over dt, P(bad | good) = a / (a + b) (1 - exp(-(a + b) dt)).
    """

    good: "AnyDelay"
    bad: "AnyDelay"
    to_bad_per_s: NonNegativeFloat
    """Rate at which a good link turns bad."""
    to_good_per_s: PositiveFloat
    """Rate at which a bad link turns good."""
    kind: Literal["markov_time"] = "markov_time"


#: Any delay model, selected by its kind.
AnyDelay = Annotated[
    NoDelay
    | ConstantDelay
    | UniformDelay
    | GammaDelay
    | LossyDelay
    | MarkovDelay
    | MarkovTimeDelay,
    Discriminator("kind"),
]
#: Limits of the shape of a `GammaDelay`.
_MIN_SHAPE = 0.5
_MAX_SHAPE = 1e6


def _relative_q90(log_shape: float) -> float:
    """Return the 90 % quantile of a gamma distribution, divided by its mean."""
    from scipy.special import gammaincinv

    shape = math.exp(log_shape)
    return float(gammaincinv(shape, 0.9)) / shape


def draw_delays(
    model: AnyDelay, rng: np.random.Generator, stamps_s: FloatArray
) -> FloatArray:
    """Draw the delays in s of one sensor's messages, shape (n,); a lost message has NaN.

    `stamps_s`, shape (n,), are the ascending stamps of the messages.
    """
    n = len(stamps_s)
    match model:
        case NoDelay():
            return np.zeros(n)
        case ConstantDelay():
            return np.full(n, model.delay_s)
        case UniformDelay():
            return rng.uniform(model.min_s, model.max_s, n)
        case GammaDelay():
            return model.min_s + rng.gamma(model.shape, model.scale_s, n)
        case LossyDelay():
            delays_s = draw_delays(model.base, rng, stamps_s)
            delays_s[rng.random(n) < model.probability] = math.nan
            return delays_s
        case MarkovDelay():
            share = model.to_bad / (model.to_bad + model.to_good)
            to_bad = np.full(n, model.to_bad)
            to_good = np.full(n, model.to_good)
        case MarkovTimeDelay():
            rate_per_s = model.to_bad_per_s + model.to_good_per_s
            share = model.to_bad_per_s / rate_per_s
            forgotten = -np.expm1(-rate_per_s * np.diff(stamps_s, prepend=stamps_s[:1]))
            to_bad = share * forgotten
            to_good = (1.0 - share) * forgotten
    draws = rng.random(n)
    bad = np.zeros(n, dtype=bool)
    bad[:1] = draws[:1] < share
    for k in range(1, n):  # from message k - 1 to k
        bad[k] = draws[k] >= to_good[k] if bad[k - 1] else draws[k] < to_bad[k]
    # Both models draw for all messages.
    good_s = draw_delays(model.good, rng, stamps_s)
    return np.where(bad, draw_delays(model.bad, rng, stamps_s), good_s)


#: Delays of Karle et al. 2023, section IV-B: mean and 90 % quantile.
LIDAR_DELAY = GammaDelay(min_s=0.09, mean_s=0.151, q90_s=0.191)
RADAR_DELAY = GammaDelay(min_s=0.03, mean_s=0.062, q90_s=0.089)
