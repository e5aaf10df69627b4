"""Where the windows are linearised: segments, measurements and linearisation points in the arrays of `Nodes`."""

import numpy as np

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.banded.nodes import Nodes, Place
from fgtrack.estimation.banded.whitening import whitened_term
from fgtrack.estimation.terms import curved
from fgtrack.models.motion import MotionModel


def move(nodes: Nodes, at: Place, steps: FloatArray) -> None:
    """Move linearisation points by `steps`, (m, n): what is relative to them follows."""
    nodes.origin[at] += steps
    nodes.predicted[at] -= steps
    nodes.step[at] -= steps
    first = nodes.first[at.tracks]
    oldest = (first > 0) & (at.slots == nodes.slots[at.tracks, first])
    if oldest.any():  # what is known of the node behind it is relative to its linearisation point
        behind = nodes.at(at.tracks[oldest], first[oldest] - 1)
        nodes.b[behind] += np.vecdot(nodes.A[behind], steps[oldest][:, None])
    nodes.y[at] -= np.vecdot(nodes.G[at], steps[:, None])
    for track, slot in zip(at.tracks.tolist(), at.slots.tolist(), strict=True):
        if any(curved(term) for term in nodes.terms[track][slot]):
            linearise_terms(nodes, track, slot)


def linearise_segments(nodes: Nodes, motion: MotionModel, tracks: IntArray, places: IntArray) -> None:
    """Linearise the motion from the nodes at `places` to the next ones, where there are any."""
    inner = places < nodes.count[tracks] - 1
    if not inner.any():
        return
    tracks, places = tracks[inner], places[inner]
    dt_s = (nodes.stamps_ns[tracks, places + 1] - nodes.stamps_ns[tracks, places]) / NS_PER_S
    at = nodes.at(tracks, places)
    nodes.ahead[at], nodes.F[at], nodes.Q[at] = motion.steps(nodes.origin[at], dt_s)


def linearise_terms(nodes: Nodes, track: int, slot: int) -> None:
    """Linearise all that is measured at a node where it stands."""
    at = Place(np.array([track]), np.array([slot]))
    nodes.num_rows[at] = 0
    nodes.G[at], nodes.y[at] = 0.0, 0.0
    for term in nodes.terms[track][slot]:
        y, G = whitened_term(term, nodes.origin[track, slot])
        nodes.measure(at, G[None], y[None])
