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
    first, n = int(nodes.first[track]), nodes.dim
    numbers = nodes.numbers[track, : first + 1]
    stamps_ns = nodes.stamps_ns[track, : first + 1].tolist()
    ring = [
        Conditional(
            stamp_ns,
            nodes.origin[number].copy(),
            nodes.back[number, :, :n].copy(),
            nodes.back[number, :, n].copy(),
            nodes.C[number].copy(),
        )
        for stamp_ns, number in zip(stamps_ns[:first], numbers[:first].tolist(), strict=True)
    ]
    oldest = numbers[first]
    origin, known = nodes.origin[oldest].copy(), nodes.predicted[oldest]
    prior = Prior(origin + known[:, n], known[:, :n].copy())
    past = MarginalisedPast.resumed(motion, ring, stamps_ns[first], origin, prior)
    found = past.fuse(measurement)
    for place, conditional in enumerate(past.ring):
        if nodes.stamps_ns[track, place] != conditional.stamp_ns:
            nodes.insert_at(np.array([track]), np.array([place]), conditional.stamp_ns, conditional.mean[None])
            nodes.first[track] += 1
        number = nodes.numbers[track, place]
        nodes.back[number, :, :n], nodes.back[number, :, n] = conditional.A, conditional.b
        nodes.C[number] = conditional.C
    return found
