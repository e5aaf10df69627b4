"""Where the windows are linearised: segments, measurements and linearisation points in the arrays of `Nodes`."""

import numpy as np

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.banded.nodes import Nodes
from fgtrack.estimation.terms import curved
from fgtrack.estimation.whitening import whitened_term
from fgtrack.models.motion import MotionModel


def move(nodes: Nodes, tracks: IntArray, numbers: IntArray, steps: FloatArray) -> None:
    """Move linearisation points by `steps`, (m, n): what is relative to them follows."""
    nodes.shift(tracks, numbers, steps)
    for number in numbers.tolist():
        if any(map(curved, nodes.terms[number])):
            linearise_terms(nodes, number)


def linearise_segments(nodes: Nodes, motion: MotionModel, tracks: IntArray, places: IntArray) -> None:
    """Linearise the motion from the nodes at `places` to the next ones, where there are any."""
    inner = places < nodes.count[tracks] - 1
    if not inner.all():
        tracks, places = tracks[inner], places[inner]
        if not tracks.size:
            return
    dt_s = (nodes.stamps_ns[tracks, places + 1] - nodes.stamps_ns[tracks, places]) / NS_PER_S
    numbers = nodes.at(tracks, places)
    ahead, F, Q = motion.transition(nodes.origin[numbers], dt_s)
    nodes.segment[numbers] = np.concatenate([F, Q, ahead[..., None]], axis=-1)


def linearise_terms(nodes: Nodes, number: int) -> None:
    """Linearise all that is measured at a node where it stands."""
    nodes.num_rows[number] = 0
    nodes.rows[number] = 0.0
    for term in nodes.terms[number]:
        nodes.measure(np.array([number]), whitened_term(term, nodes.origin[number])[None])
