"""What solves the window: one small protocol, two implementations on gtsam."""

from collections.abc import Sequence
from typing import ClassVar, NamedTuple, Protocol

from fgtrack.core.types import FloatArray
from fgtrack.estimation.factor_graph.rows import Factor


class Marginalised(NamedTuple):
    """The oldest variables, to be marginalised."""

    keys: list[int]
    cutoff_s: float
    """Between their stamps and those of the others."""
    prior: Factor
    """What they say about the oldest of the others."""


class Change(NamedTuple):
    """One change of the window."""

    values: dict[int, FloatArray]
    """First estimates (n,) of new variables, by key."""
    stamps_s: dict[int, float]
    """Their stamps, in seconds since the run's first one."""
    factors: Sequence[Factor]
    """Factors to add."""
    removed: list[int]
    """Slots of factors to remove."""
    marginalised: Marginalised | None = None


class Backend(Protocol):
    """Keeps a graph and its solution. Factors stay linearised where they say, until they are replaced."""

    damped: ClassVar[bool]
    """Whether no step makes the fit worse."""

    def update(self, change: Change) -> list[int]:
        """Apply `change` and solve; gives the slots of `change.factors`, in order.

        Raises `RuntimeError` or `numpy.linalg.LinAlgError` where it cannot be solved; then only a new backend helps.
        """

    def means(self, keys: Sequence[int]) -> FloatArray:
        """Estimates of m variables, shape (m, n)."""

    def covariance(self, keys: Sequence[int]) -> FloatArray:
        """Joint covariance of one variable, shape (n, n), or of two neighbours, (2 n, 2 n)."""
