"""Which code solves the windows: that compiled by numba where it is installed, else that in NumPy."""

import warnings
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from typing import NamedTuple, Protocol

from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.banded.elimination import eliminate
from fgtrack.estimation.banded.nodes import Nodes
from fgtrack.estimation.banded.substitution import Blocks


class Substitution(Protocol):
    """Smoothed means and covariances of the nodes of many tracks, see `Blocks`."""

    def begin(self, track: int) -> None:
        """A new track, with one node."""

    def cut(self, tracks: IntArray, places: IntArray) -> None:
        """The nodes of `tracks` from `places` on, one each, are eliminated anew."""

    def moved(self, tracks: IntArray, numbers: IntArray) -> None:
        """The places of all nodes of `tracks` have changed by `numbers`."""

    def solve_means(self, tracks: IntArray, thresholds: FloatArray, anchored: IntArray) -> None:
        """Find the steps of the nodes in the windows of `tracks`; mark all that are too long."""

    def find_far(self, tracks: IntArray, anchored: IntArray) -> tuple[IntArray, IntArray]:
        """Nodes of `tracks` that are marked as `far`, but for the first `anchored` ones of each window."""

    def smoothed(self, tracks: IntArray, places: IntArray) -> tuple[FloatArray, FloatArray]:
        """Steps (m, n) and covariances (m, n, n) of the nodes at `places` of `tracks`."""

    def steps(self, tracks: IntArray, places: IntArray) -> FloatArray:
        """Steps (m, n) alone, for nodes in the windows."""


class Methods(NamedTuple):
    """How the windows are solved."""

    nodes: Callable[[int], Nodes]
    """The arrays, for states of so many entries."""
    eliminate: Callable[[Nodes, IntArray, IntArray], None]
    """See `elimination.eliminate`."""
    substitution: Callable[[Nodes], Substitution]


IN_NUMPY = Methods(Nodes, eliminate, Blocks)


@cache
def fastest() -> Methods:
    """Those compiled by numba where it can be imported (`pip install fgtrack[fast]`), else those in NumPy.

    Warns where numba is there, but cannot be used.
    """
    if find_spec("numba") is None:
        return IN_NUMPY
    try:
        from fgtrack.estimation.banded import compiled, compiled_nodes
    except (ImportError, RuntimeError) as error:  # of another NumPy; nowhere to keep what is compiled
        warnings.warn(f"smoother-banded runs without numba, which fails: {error}", RuntimeWarning, stacklevel=2)
        return IN_NUMPY
    return Methods(compiled_nodes.CompiledNodes, compiled.eliminate, compiled.Substitution)
