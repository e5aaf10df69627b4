"""Detections older than the window, fused through the conditionals of the nodes that have left it.

A node that leaves keeps its distribution given the next one: x - x0 = A (next - its x0) + b + N(0, C). A detection of
it conditions that on itself, and what it says of the next node is passed on, up to the oldest node of the window. All
is exact in a linear model; else the nodes stay linearised where they were when they left.
"""

import numpy as np

from fgtrack.core.linalg import symmetrise
from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.filters.ekf import joseph, kalman_gain, propagated
from fgtrack.estimation.rts import between
from fgtrack.estimation.smoothing.nodes import Nodes
from fgtrack.estimation.smoothing.terms import EquivalentMeasurement, NearMeasurement, whitened
from fgtrack.models.motion import MotionModel

_Conditional = tuple[FloatArray, FloatArray, FloatArray]
"""A (n, n), b (n,), C (n, n)."""


def fuse_behind(
    nodes: Nodes, motion: MotionModel, track: int, index: int, measurement: Measurement
) -> EquivalentMeasurement:
    """Fuse a detection older than the window of `track` behind it; return its equivalent of the oldest node inside.

    A node is inserted at its stamp, after that at `index`, unless it is one of that node. Raises
    `numpy.linalg.LinAlgError` if it cannot be fused; all is as it was then.
    """
    first, n = int(nodes.first[track]), nodes.dim
    at_node = isinstance(measurement, NearMeasurement) or nodes.stamps_ns[track, index] == measurement.stamp_ns
    split: list[_Conditional] = []
    if at_node:
        origin = nodes.origin[nodes.numbers[track, index]]
    else:
        index += 1
        origin, *split = _split(nodes, motion, track, index, measurement.stamp_ns)
    rows = whitened(measurement, origin)
    H, y, R = rows[:, :n], rows[:, n], np.eye(len(rows))
    path: list[_Conditional] = [*split[1:]]
    for number in nodes.numbers[track, index:first].tolist():
        path.append((nodes.back[number, :, :n], nodes.back[number, :, n], nodes.C[number]))
    updated = [*split[:1]]
    for A, b, C in path:
        K, S = kalman_gain(C, H, R)
        rest, through = y - H @ b, H @ A
        updated.append((A - K @ through, b + K @ rest, joseph(C, K, H, R)))
        y, H, R = rest, through, symmetrise(S)
    if not at_node:
        nodes.insert_at(np.array([track]), np.array([index]), measurement.stamp_ns, origin[None])
        nodes.first[track] += 1
    changed = nodes.numbers[track, index - len(split[:1]) : nodes.first[track]]
    for number, (A, b, C) in zip(changed.tolist(), updated, strict=True):
        nodes.back[number, :, :n], nodes.back[number, :, n], nodes.C[number] = A, b, C
    return EquivalentMeasurement(nodes.origin[nodes.numbers[track, nodes.first[track]]].copy(), H, y, R)


def _split(
    nodes: Nodes, motion: MotionModel, track: int, index: int, stamp_ns: int
) -> tuple[FloatArray, _Conditional, _Conditional]:
    """Origin of a node at `stamp_ns`, before that at `index`; the node before given it, and it given the next one."""
    before, after = nodes.numbers[track, index - 1 : index + 1]
    before_ns, after_ns = nodes.stamps_ns[track, index - 1 : index + 1].tolist()
    n = nodes.dim
    left_A, left_b, left_C = nodes.back[before, :, :n], nodes.back[before, :, n], nodes.C[before]
    times_s = seconds(stamp_ns - before_ns), seconds(after_ns - stamp_ns)
    mean, Lambda, Psi, Sigma = between(motion, nodes.origin[before], nodes.origin[after], *times_s)
    A = Lambda @ left_A + Psi
    C = propagated(Lambda, left_C, Sigma)
    b = Lambda @ left_b
    # Given the state between them the left one no longer depends on the right one: left_A = gain A. Stamps close
    # together leave hardly a digit of the same gain as C_left Lambda' C^-1.
    gain = np.asarray(np.linalg.solve(A.T, left_A.T)).T
    spread = joseph(left_C, gain, Lambda, Sigma)
    return mean, (gain, left_b - gain @ b, spread), (A, b, C)
