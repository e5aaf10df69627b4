"""The steps of the extended Kalman filter with replay: predict, correct, and smooth back to a late measurement.

Arrays of tracks and their slots are those of `fgtrack.estimation.kernels.replay_arrays`.
"""

import math

from fgtrack.core.compiled import (
    MATRIX,
    add_congruence,
    copy,
    inlined,
    merged,
    scratch,
    shared,
    wrapped,
)
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.kernels.kalman import (
    CorrectionSpace,
    correct_state,
    correction_space,
    smooth_state,
)
from fgtrack.estimation.kernels.replay_arrays import (
    CODES,
    LOSS,
    SIZE,
    STAMP_NS,
    WIDTH,
    Track,
)
from fgtrack.models.measurement_kernels import observe, subtract
from fgtrack.models.short_bends import ARC
from fgtrack.models.transitions import transition

YAW = 2
_SMOOTHING_SPACE = f"UniTuple({MATRIX}, 5)"
SmoothingSpace = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]
"""Scratch of `smooth_back`: F, root and product (n, n), prediction (2 n + 1, n), smoothed state (n + 1, n)."""
Space = tuple[FloatArray, FloatArray, FloatArray, SmoothingSpace, CorrectionSpace]
"""Scratch of one replay: innovation (k,), Jacobian H (k, n), state (n + 1, n); of smoothing, and of a correction."""


@merged
def smoothing_space(n: int) -> SmoothingSpace:
    """Return scratch for smoothing states of dimension n."""
    return (
        scratch(n, n),
        scratch(n, n),
        scratch(n, n),
        scratch(2 * n + 1, n),
        scratch(n + 1, n),
    )


@merged
def replay_space(n: int, most: int) -> Space:
    """Return scratch for replaying states of dimension n with measurements of at most `most` components."""
    return (
        scratch(most),
        scratch(most, n),
        scratch(n + 1, n),
        smoothing_space(n),
        correction_space(n, most),
    )


@inlined
def predict_state(
    kind: int,
    noise: FloatArray,
    state: FloatArray,
    dt_ns: int,
    F: FloatArray,
    mean: FloatArray,
    P: FloatArray,
    FP: FloatArray,
) -> None:
    """Write the prediction of `state` (n + 1, n), mean and covariance, after a time.

    The prediction is F, the mean f(x), shape (n,), and P = F P F' + Q and F P, shapes (n, n).
    """
    transition(kind, state[0], dt_ns / NS_PER_S, noise, mean, F, P)
    add_congruence(F, state[1:], FP, P)


@merged
def predict_at(
    kind: int, noise: FloatArray, track: Track, index: int, F: FloatArray
) -> None:
    """Predict the step at `index` of a track from the step before."""
    slots, labels, steps, _, _, _ = track
    n = steps.shape[2]
    slot, before = slots[index], slots[index - 1]
    predicted = steps[slot, n + 1 :]
    predict_state(
        kind,
        noise,
        steps[before, : n + 1],
        labels[slot, STAMP_NS] - labels[before, STAMP_NS],
        F,
        predicted[0],
        predicted[1 : n + 1],
        predicted[n + 1 :],
    )
    copy(predicted, steps[slot, : n + 1])


@merged
def innovate(
    kind: int, x: FloatArray, track: Track, slot: int, y: FloatArray, H: FloatArray
) -> None:
    """Write the innovation y (k,) of the measurement in a slot at the state x (n,), and its Jacobian H (k, n)."""
    _, labels, _, _, measured, views = track
    codes = labels[slot, CODES : CODES + labels[slot, SIZE]]
    observe(codes, kind != ARC, x, views[slot], y, H)
    subtract(codes, measured[slot, 0], y, y)


@merged
def correct_slot(
    kind: int,
    track: Track,
    slot: int,
    y: FloatArray,
    H: FloatArray,
    space: CorrectionSpace,
) -> bool:
    """Fuse the innovation y (k,), with its Jacobian H (k, n), into the predicted step in a slot.

    False if the innovation cannot be fused.
    """
    _, labels, steps, _, measured, views = track
    k, n, after = labels[slot, SIZE], steps.shape[2], steps[slot]
    weight = correct_state(
        after[0],
        after[1 : n + 1],
        y[:k],
        H[:k],
        measured[slot, 1:],
        labels[slot, LOSS],
        views[slot, WIDTH],
        space,
    )
    if math.isnan(weight):
        return False
    if kind == ARC:
        after[0, YAW] = wrapped(after[0, YAW])
    return True


@shared(
    f"b1(int64, float64[::1], int64[::1], int64[:, ::1], float64[:, :, ::1], {_SMOOTHING_SPACE}, {MATRIX})"
)
def smooth_back(
    kind: int,
    noise: FloatArray,
    slots: IntArray,
    labels: IntArray,
    steps: FloatArray,
    space: SmoothingSpace,
    now: FloatArray,
) -> bool:
    """Smooth `now`, the state after the last of `slots`, back to the prediction of the new step in the first slot.

    From step to step (Rauch, Tung and Striebel) a state x_j, P_j becomes x_j + C s and P_j + C (P - P_-) C'. The step
    after has the prediction x_-, P_- and the smoothed state x, P. So s = x - x_-, and C = (P_-^-1 F P_j)'. False if a
    P_- is not positive definite.
    """
    n = steps.shape[2]
    F, root, CD, ahead, smoothed = space
    gain, shift = ahead[n + 1 :], now[0]
    for j in range(len(slots) - 1, 0, -1):
        after, left, start = slots[j], slots[j - 1], 0 if j > 1 else n + 1
        dt_ns = labels[after, STAMP_NS] - labels[left, STAMP_NS]
        if dt_ns == 0:  # the same state
            continue
        state = steps[left, start : start + n + 1]
        if (
            start
        ):  # the step after the new step was predicted before the new step was there
            predict_state(
                kind, noise, state, dt_ns, F, ahead[0], ahead[1 : n + 1], gain
            )
        else:
            copy(steps[after, n + 1 :], ahead)
        for a in range(n):
            shift[a] -= ahead[0, a]
        if kind == ARC:
            shift[YAW] = wrapped(shift[YAW])
        copy(state, smoothed)
        if not smooth_state(
            smoothed[0], smoothed[1:], ahead[1:], gain, shift, now[1:], root, CD
        ):
            return False
        copy(smoothed, now)
    return True
