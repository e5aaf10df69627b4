"""Detections older than the window, fused through the conditionals of the nodes that have left it."""

import numpy as np

from fgtrack.estimation.banded.nodes import Nodes
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.marginalised_past import Conditional, MarginalisedPast, Prior
from fgtrack.estimation.terms import EquivalentMeasurement
from fgtrack.models.motion import MotionModel


def fuse_behind(nodes: Nodes, motion: MotionModel, track: int, measurement: Measurement) -> EquivalentMeasurement:
    """Take a detection older than the window of `track` into the nodes behind it, and give what it says of the oldest.

    It adds a node at a stamp of its own. Raises `numpy.linalg.LinAlgError` for one that cannot be fused; all is as it
    was then.
    """
    first = int(nodes.first[track])
    slots = nodes.slots[track, : first + 1]
    stamps_ns = nodes.stamps_ns[track, : first + 1].tolist()
    ring = [
        Conditional(stamp_ns, *(values[track, slot].copy() for values in (nodes.origin, nodes.A, nodes.b, nodes.C)))
        for stamp_ns, slot in zip(stamps_ns[:first], slots[:first].tolist(), strict=True)
    ]
    at = track, slots[first]
    origin = nodes.origin[at].copy()
    prior = Prior(origin + nodes.predicted[at], nodes.P_predicted[at].copy())
    past = MarginalisedPast.resumed(motion, ring, stamps_ns[first], origin, prior)
    found = past.fuse(measurement)
    for place, conditional in enumerate(past.ring):
        if nodes.stamps_ns[track, place] != conditional.stamp_ns:
            stamp_ns = np.array([conditional.stamp_ns])
            nodes.insert(np.array([track]), np.array([place]), stamp_ns, conditional.mean[None])
            nodes.first[track] += 1
        at = track, nodes.slots[track, place]
        nodes.A[at], nodes.b[at], nodes.C[at] = conditional.A, conditional.b, conditional.C
    return found
