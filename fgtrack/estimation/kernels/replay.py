"""The extended Kalman filter with replay, of many tracks: arrays (tracks, slots, ...) hold the steps of their windows.

`order[track]` has the slots of a track's steps, oldest first, and then the free ones. A slot of `steps` has in rows of
n, the dimension of the state, mean and covariance after the measurement (n + 1 rows), mean and covariance predicted for
it, and the cross-covariance of the prediction with the step before. A slot of `measured` has z in its first row, and
then R. A slot of `views` has the sensor pose (5 numbers) and the width of the robust loss. A slot of `labels` has the
stamp, the number k of components, the kind of the loss, and the components; k of the first step, which is a prior, is
0. A row of `windows` has the number of the track's steps, and its oldest and newest stamp.
"""

import math

from fgtrack.core.compiled import (
    MATRIX,
    add_congruence,
    check,
    check_rows,
    copy,
    inlined,
    merged,
    njit,
    scratch,
    shared,
    wrapped,
)
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.kernels.kalman import (
    CorrectionSpace,
    correct_state,
    marginal_nis,
    smooth_state,
)
from fgtrack.models.measurement_kernels import (
    POSE_SIZE,
    check_components,
    observe,
    subtract,
)
from fgtrack.models.transitions import ARC, check_noise, transition

FAILED, TOO_OLD, IN_SEQUENCE, OUT_OF_SEQUENCE, NO_ROOM = range(5)
_YAW = 2
#: Columns of `labels`; the components begin at the last one.
STAMP_NS, SIZE, LOSS, CODES = range(4)
#: Column of `views`, behind the pose.
WIDTH = POSE_SIZE

_Space = tuple[FloatArray, ...]


@inlined
def _ahead(
    motion: int,
    noise: FloatArray,
    state: FloatArray,
    late_ns: int,
    F: FloatArray,
    mean: FloatArray,
    P: FloatArray,
    FP: FloatArray,
) -> None:
    """Write F, f(x) (n,), F P F' + Q and F P, (n, n), of the state x, P, (n + 1, n)."""
    transition(motion, state[0], late_ns / NS_PER_S, noise, mean, F, P)
    add_congruence(F, state[1:], FP, P)


@merged
def _innovation(
    motion: int,
    x: FloatArray,
    label: IntArray,
    measured: FloatArray,
    view: FloatArray,
    y: FloatArray,
    H: FloatArray,
) -> None:
    """Write the innovation y (k,) of a measurement at the state x (n,), and its Jacobian H (k, n)."""
    codes = label[CODES : CODES + label[SIZE]]
    observe(codes, motion != ARC, x, view, y, H)
    subtract(codes, measured[0], y, y)


_SPACE = f"UniTuple({MATRIX}, 5)"


@shared(
    f"b1(int64, float64[::1], int64[::1], int64[:, ::1], float64[:, :, ::1], {_SPACE}, {MATRIX})"
)
def _retrodict(
    motion: int,
    noise: FloatArray,
    slots: IntArray,
    labels: IntArray,
    steps: FloatArray,
    space: _Space,
    now: FloatArray,
) -> bool:
    """Smooth `now`, the state after the last of `slots`, back to the prediction of the first, which is new.
    From step to step (Rauch, Tung and Striebel), x_j + C s and P_j + C (P - P_-) C' with the prediction x_-, P_- of the
    step after, the shift s = x - x_- and C = (P_-^-1 F P_j)'. False where some P_- has no root.
    """
    n = steps.shape[2]
    F, root, CD, ahead, smoothed = space
    gain, shift = ahead[n + 1 :], now[0]
    for j in range(len(slots) - 1, 0, -1):
        after, left, start = slots[j], slots[j - 1], 0 if j > 1 else n + 1
        late_ns = labels[after, STAMP_NS] - labels[left, STAMP_NS]
        if late_ns == 0:  # the same state
            continue
        state = steps[left, start : start + n + 1]
        if start:
            _ahead(motion, noise, state, late_ns, F, ahead[0], ahead[1 : n + 1], gain)
        else:
            copy(steps[after, n + 1 :], ahead)
        for a in range(n):
            shift[a] -= ahead[0, a]
        if motion == ARC:
            shift[_YAW] = wrapped(shift[_YAW])
        copy(state, smoothed)
        if not smooth_state(
            smoothed[0], smoothed[1:], ahead[1:], gain, shift, now[1:], root, CD
        ):
            return False
        copy(smoothed, now)
    return True


@merged
def _predict(
    motion: int,
    noise: FloatArray,
    before: FloatArray,
    after: FloatArray,
    late_ns: int,
    F: FloatArray,
) -> None:
    """Predict the step `after` from the step `before`."""
    n = before.shape[1]
    predicted = after[n + 1 :]
    _ahead(
        motion,
        noise,
        before[: n + 1],
        late_ns,
        F,
        predicted[0],
        predicted[1 : n + 1],
        predicted[n + 1 :],
    )
    copy(predicted, after[: n + 1])


@merged
def _correct(
    motion: int,
    after: FloatArray,
    label: IntArray,
    measured: FloatArray,
    view: FloatArray,
    y: FloatArray,
    H: FloatArray,
    space: CorrectionSpace,
) -> bool:
    """Fuse the innovation y (k,), with its Jacobian H (k, n), into a predicted step; False where it cannot be fused."""
    k, n = label[SIZE], after.shape[1]
    weight = correct_state(
        after[0],
        after[1 : n + 1],
        y[:k],
        H[:k],
        measured[1:],
        label[LOSS],
        view[WIDTH],
        space,
    )
    if math.isnan(weight):
        return False
    if motion == ARC:
        after[0, _YAW] = wrapped(after[0, _YAW])
    return True


@merged
def _comes_after(
    label: IntArray,
    measured: FloatArray,
    view: FloatArray,
    new_label: IntArray,
    new: FloatArray,
    new_view: FloatArray,
) -> bool:
    """True if a step comes after a new step: by stamp, and at one stamp by content, whatever came first."""
    k = label[SIZE]
    if label[STAMP_NS] != new_label[STAMP_NS] or k == 0:
        return bool(label[STAMP_NS] > new_label[STAMP_NS])
    if k != new_label[SIZE]:
        return bool(k > new_label[SIZE])
    for a in range(CODES, CODES + k):
        if label[a] != new_label[a]:
            return bool(label[a] > new_label[a])
    for a in range(k + 1):
        for b in range(k):
            if measured[a, b] != new[a, b]:
                return bool(measured[a, b] > new[a, b])
    for a in range(POSE_SIZE):
        if view[a] != new_view[a]:
            return bool(view[a] > new_view[a])
    if label[LOSS] != new_label[LOSS]:
        return bool(label[LOSS] > new_label[LOSS])
    return bool(view[WIDTH] > new_view[WIDTH])


@merged
def _forget(
    oldest_ns: int, slots: IntArray, labels: IntArray, window: IntArray
) -> None:
    """Free the slots of steps before the newest one that is older than `oldest_ns`."""
    gone = 0
    while gone + 1 < window[0] and labels[slots[gone + 1], STAMP_NS] < oldest_ns:
        gone += 1
    window[0] -= gone
    for j in range(window[0] if gone else 0):
        slots[j], slots[j + gone] = slots[j + gone], slots[j]


_STEPS = "int64, float64[::1], int64[:, ::1], int64[:, :, ::1], float64[:, :, :, ::1], int64[:, ::1]"


@inlined
def _check(
    tracks: IntArray,
    least: int,
    order: IntArray,
    labels: IntArray,
    steps: FloatArray,
    windows: IntArray,
    n: int,
) -> None:
    """Raise `IndexError` for tracks, or numbers of steps, beyond the ends of the arrays of states of dimension n."""
    size, slots = order.shape
    check_rows(tracks, least, size)
    check(
        labels.shape[0] == size and steps.shape[0] == size and windows.shape[0] == size
    )
    check(
        labels.shape[1] == slots and steps.shape[1] == slots and windows.shape[1] >= 3
    )
    check(steps.shape[2] == 3 * n + 2 and steps.shape[3] == n)
    for i in range(len(tracks)):
        if tracks[i] >= 0:
            check_rows(windows[tracks[i], :1], 1, slots + 1)
            check_rows(order[tracks[i]], 0, slots)


@inlined
def _check_measured(
    order: IntArray,
    labels: IntArray,
    measured: FloatArray,
    views: FloatArray,
    k: int,
) -> None:
    """Raise `IndexError` unless the arrays of measurements have k components for each step."""
    check(measured.shape[0] == order.shape[0] and measured.shape[1] == order.shape[1])
    check(views.shape[0] == order.shape[0] and views.shape[1] == order.shape[1])
    check(measured.shape[2] > k and measured.shape[3] >= k)
    check(labels.shape[2] >= k + CODES and views.shape[2] > WIDTH)


@merged
def _insert(
    slots: IntArray,
    labels: IntArray,
    measured: FloatArray,
    views: FloatArray,
    count: int,
    stamp_ns: int,
    components: IntArray,
    view: FloatArray,
    loss: int,
    z: FloatArray,
    R: FloatArray,
) -> int:
    """Write a measurement into the first free slot of a track, and move the slot into order; return the index."""
    index, own, k = count, slots[count], len(components)
    label, new = labels[own], measured[own]
    label[STAMP_NS], label[SIZE], label[LOSS] = stamp_ns, k, loss
    for a in range(WIDTH + 1):
        views[own, a] = view[a]
    for a in range(k):
        label[CODES + a], new[0, a] = components[a], z[a]
        for b in range(k):
            new[1 + a, b] = R[a, b]
    while index > 1 and _comes_after(
        labels[slots[index - 1]],
        measured[slots[index - 1]],
        views[slots[index - 1]],
        label,
        new,
        views[own],
    ):
        slots[index] = slots[index - 1]
        index -= 1
    slots[index] = own
    return index


@njit(
    f"int64({_STEPS}, float64[:, :, :, ::1], float64[:, :, ::1], int64[::1], int64, int64, int64, int64[::1], "
    "float64[::1], int64, float64[:, ::1], float64[:, :, ::1], int64[::1], float64[:, ::1], float64[:, :, ::1], "
    "float64[::1], int64[::1])"
)
def fuse(
    motion: int,
    noise: FloatArray,
    order: IntArray,
    labels: IntArray,
    steps: FloatArray,
    windows: IntArray,
    measured: FloatArray,
    views: FloatArray,
    tracks: IntArray,
    lag_ns: int,
    oldest_ns: int,
    stamp_ns: int,
    components: IntArray,
    view: FloatArray,
    loss: int,
    z: FloatArray,
    R: FloatArray,
    rows: IntArray,
    y: FloatArray,
    S: FloatArray,
    nis: FloatArray,
    status: IntArray,
) -> int:
    """Put a measurement of `components`, by their codes, into the steps of `tracks` (m,); re-filter the later steps.

    Writes innovations y (m, k), the NIS of their `rows`, and S (m, k, k), given all that was fused, and the status. A
    failed measurement, and one older than `oldest_ns` or the window of the track, change nothing. Where all slots of a
    track are in use, nothing changes either. Returns the number of these tracks.
    """
    m, k, n, num_without_room = len(tracks), y.shape[1], steps.shape[3], 0
    check_noise(motion, noise, n)
    _check(tracks, 0, order, labels, steps, windows, n)
    _check_measured(order, labels, measured, views, k)
    check(k > 0 and len(components) == k and z.shape[1] >= k and len(view) > WIDTH)
    check(
        len(y) == m
        and len(z) == m
        and len(R) == m
        and len(S) == m
        and len(nis) == m
        and len(status) == m
    )
    check(R.shape[1] >= k and R.shape[2] >= k and S.shape[1] >= k and S.shape[2] >= k)
    check_components(components, n)
    check_rows(rows, 0, k)
    now, most = scratch(n + 1, n), measured.shape[3]
    F, root, CD, ahead, smoothed = (
        scratch(n, n),
        scratch(n, n),
        scratch(n, n),
        scratch(2 * n + 1, n),
        scratch(n + 1, n),
    )
    A, AP, K, KR = scratch(n, n), scratch(n, n), scratch(most, n), scratch(n, most)
    marginal, spread, own_noise, column = (
        scratch(most, most),
        scratch(most, most),
        scratch(most, most),
        scratch(most, 1),
    )
    white, innovation, H = scratch(most), scratch(most), scratch(most, n)
    correction = A, AP, K, KR, marginal, spread, own_noise, column
    for i in range(len(tracks)):
        t = tracks[i]
        slots, window = order[t], windows[t]
        if stamp_ns < max(window[1], oldest_ns):
            status[i] = TOO_OLD
            continue
        if window[0] + 1 >= len(slots):
            _forget(max(window[1], oldest_ns), slots, labels[t], window)
        if window[0] == len(slots):
            status[i], num_without_room = NO_ROOM, num_without_room + 1
            continue
        count = window[0]
        own = slots[count]
        index = _insert(
            slots,
            labels[t],
            measured[t],
            views[t],
            count,
            stamp_ns,
            components,
            view,
            loss,
            z[i],
            R[i],
        )
        label, new = labels[t, own], measured[t, own]
        j, last, fused = index, count, True
        while j <= last:
            s, left = slots[j], slots[j - 1]
            late_ns = labels[t, s, STAMP_NS] - labels[t, left, STAMP_NS]
            _predict(motion, noise, steps[t, left], steps[t, s], late_ns, F)
            _innovation(
                motion,
                steps[t, s, 0],
                labels[t, s],
                measured[t, s],
                views[t, s],
                innovation,
                H,
            )
            ok = _correct(
                motion,
                steps[t, s],
                labels[t, s],
                measured[t, s],
                views[t, s],
                innovation,
                H,
                correction,
            )
            if ok and s == own:
                newest = slots[count]
                copy(steps[t, newest, n + 1 if index == count else 0 :], now)
                ok = _retrodict(
                    motion,
                    noise,
                    slots[index : count + 1],
                    labels[t],
                    steps[t],
                    (F, root, CD, ahead, smoothed),
                    now,
                )
                _innovation(motion, now[0], label, new, views[t, own], y[i], H[:k])
                for a in range(k):
                    for b in range(k):
                        S[i, a, b] = R[i, a, b]
                add_congruence(H[:k], now[1:], K[:k], S[i])
                nis[i] = marginal_nis(S[i], y[i], rows, marginal, white)
                ok = ok and not math.isnan(nis[i])
            j += 1
            if not ok and fused:  # take it out, and re-filter the later ones without it
                for j in range(index, count):
                    slots[j] = slots[j + 1]
                slots[count] = own
                j, last, fused = index, count - 1, False
        status[i] = FAILED
        if fused:
            status[i] = IN_SEQUENCE if stamp_ns >= window[2] else OUT_OF_SEQUENCE
            window[0], window[2] = count + 1, max(window[2], stamp_ns)
            window[1] = max(window[1], window[2] - lag_ns)
    return num_without_room


@njit(
    f"int64({_STEPS}, float64[:, :, :, ::1], float64[:, :, ::1], int64[::1], int64, int64, int64[::1], float64[::1], "
    "int64, float64[::1], float64[:, ::1])"
)
def insert(
    motion: int,
    noise: FloatArray,
    order: IntArray,
    labels: IntArray,
    steps: FloatArray,
    windows: IntArray,
    measured: FloatArray,
    views: FloatArray,
    tracks: IntArray,
    oldest_ns: int,
    stamp_ns: int,
    components: IntArray,
    view: FloatArray,
    loss: int,
    z: FloatArray,
    R: FloatArray,
) -> int:
    """Put a measurement into the steps of the first of `tracks`; return its index, else minus the status.

    With `predict_step`, `correct_step` and `retrodict` this is `fuse` in parts, for one track, between which a plug-in
    linearises its measurement or an initiation replaces the state.
    """
    n, k = steps.shape[3], len(components)
    check_noise(motion, noise, n)
    _check(tracks, 0, order, labels, steps, windows, n)
    _check_measured(order, labels, measured, views, k)
    check_components(components, n)
    check(k > 0 and len(view) > WIDTH and len(z) == k)
    check(len(tracks) > 0 and R.shape == (k, k))
    t = tracks[0]
    slots, window = order[t], windows[t]
    if stamp_ns < max(window[1], oldest_ns):
        return -TOO_OLD
    if window[0] + 1 >= len(slots):
        _forget(max(window[1], oldest_ns), slots, labels[t], window)
    if window[0] == len(slots):
        return -NO_ROOM
    return _insert(
        slots,
        labels[t],
        measured[t],
        views[t],
        window[0],
        stamp_ns,
        components,
        view,
        loss,
        z,
        R,
    )


@njit(f"void({_STEPS}, int64[::1], int64)")
def predict_step(
    motion: int,
    noise: FloatArray,
    order: IntArray,
    labels: IntArray,
    steps: FloatArray,
    windows: IntArray,
    tracks: IntArray,
    index: int,
) -> None:
    """Predict the step at `index` of the first of `tracks` from the step before it."""
    n = steps.shape[3]
    check_noise(motion, noise, n)
    _check(tracks, 0, order, labels, steps, windows, n)
    check(len(tracks) > 0 and 0 < index < order.shape[1])
    F, t = scratch(n, n), tracks[0]
    s, left = order[t, index], order[t, index - 1]
    late_ns = labels[t, s, STAMP_NS] - labels[t, left, STAMP_NS]
    _predict(motion, noise, steps[t, left], steps[t, s], late_ns, F)


@njit(
    f"b1({_STEPS}, float64[:, :, :, ::1], float64[:, :, ::1], int64[::1], int64, b1, float64[::1], {MATRIX})"
)
def correct_step(
    motion: int,
    noise: FloatArray,
    order: IntArray,
    labels: IntArray,
    steps: FloatArray,
    windows: IntArray,
    measured: FloatArray,
    views: FloatArray,
    tracks: IntArray,
    index: int,
    is_linearised: bool,
    y: FloatArray,
    H: FloatArray,
) -> bool:
    """Fuse the measurement of the predicted step at `index` of the first of `tracks`; False where it cannot be fused.

    Innovation y (k,) and Jacobian H (k, n) are given where it `is_linearised`, else they are written.
    """
    n, most = steps.shape[3], measured.shape[3]
    check_noise(motion, noise, n)
    _check(tracks, 0, order, labels, steps, windows, n)
    check(len(tracks) > 0 and 0 < index < order.shape[1])
    t = tracks[0]
    s = order[t, index]
    k = labels[t, s, SIZE]
    _check_measured(order, labels, measured, views, k)
    check(k > 0 and len(y) == k and H.shape == (k, n))
    A, AP, K, KR = scratch(n, n), scratch(n, n), scratch(most, n), scratch(n, most)
    root, spread, own_noise, column = (
        scratch(most, most),
        scratch(most, most),
        scratch(most, most),
        scratch(most, 1),
    )
    correction = A, AP, K, KR, root, spread, own_noise, column
    label, own, view = labels[t, s], measured[t, s], views[t, s]
    if not is_linearised:
        _innovation(motion, steps[t, s, 0], label, own, view, y, H)
    return _correct(motion, steps[t, s], label, own, view, y, H, correction)


@njit(f"b1({_STEPS}, int64[::1], int64, int64, {MATRIX})")
def retrodict(
    motion: int,
    noise: FloatArray,
    order: IntArray,
    labels: IntArray,
    steps: FloatArray,
    windows: IntArray,
    tracks: IntArray,
    index: int,
    last: int,
    now: FloatArray,
) -> bool:
    """Write the state at the new step at `index`, without its measurement, given all steps up to `last`, (n + 1, n)."""
    n = steps.shape[3]
    check_noise(motion, noise, n)
    _check(tracks, 0, order, labels, steps, windows, n)
    check(len(tracks) > 0 and 0 < index <= last < order.shape[1])
    check(now.shape == (n + 1, n))
    F, root, CD, ahead, smoothed = (
        scratch(n, n),
        scratch(n, n),
        scratch(n, n),
        scratch(2 * n + 1, n),
        scratch(n + 1, n),
    )
    t = tracks[0]
    copy(steps[t, order[t, last], n + 1 if index == last else 0 :], now)
    return _retrodict(
        motion,
        noise,
        order[t, index : last + 1],
        labels[t],
        steps[t],
        (F, root, CD, ahead, smoothed),
        now,
    )


@njit(
    f"int64({_STEPS}, int64[::1], int64, int64, b1, float64[:, ::1], float64[:, :, ::1], b1[::1])"
)
def ahead(
    motion: int,
    noise: FloatArray,
    order: IntArray,
    labels: IntArray,
    steps: FloatArray,
    windows: IntArray,
    tracks: IntArray,
    oldest_ns: int,
    stamp_ns: int,
    is_present: bool,
    means: FloatArray,
    covariances: FloatArray,
    known: BoolArray,
) -> int:
    """Write states (m, n) and (m, n, n) of `tracks`, but those below 0, at a stamp: from the last step before.
    Known are, and counted, those whose windows have begun; at the present others have their first state.
    """
    n, count = steps.shape[3], 0
    check_noise(motion, noise, n)
    _check(tracks, -1, order, labels, steps, windows, n)
    check(
        len(means) == len(tracks)
        and len(covariances) == len(tracks)
        and len(known) == len(tracks)
    )
    F, FP = scratch(n, n), scratch(n, n)
    for i in range(len(tracks)):
        t, at_ns = tracks[i], stamp_ns
        if t < 0:
            continue
        start_ns = max(windows[t, 1], oldest_ns)
        if is_present:
            at_ns = max(stamp_ns, start_ns)
        known[i] = start_ns <= at_ns
        if not known[i]:
            continue
        count += 1
        j = windows[t, 0] - 1
        while j > 0 and labels[t, order[t, j], STAMP_NS] > at_ns:
            j -= 1
        s = order[t, j]
        _ahead(
            motion,
            noise,
            steps[t, s, : n + 1],
            at_ns - labels[t, s, STAMP_NS],
            F,
            means[i],
            covariances[i],
            FP,
        )
        if motion == ARC:
            means[i, _YAW] = wrapped(means[i, _YAW])
    return count
