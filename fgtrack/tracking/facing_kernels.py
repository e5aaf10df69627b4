"""Compiled loops over the ways to read a yaw; see `fgtrack.tracking.facing`."""

import math

import numpy as np

from fgtrack.core.compiled import (
    add_congruence,
    check,
    check_rows,
    copy,
    inlined,
    njit,
    whiten,
)
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.tracking.facing import (
    HALF_TURN,
    MEMORY,
    MOST_EVIDENCE,
    REVERSED,
    WITHOUT_YAW,
)

#: No reading of the pair lies inside the gate.
OUTSIDE = -1
#: Columns of the evidence of a pair.
LOG_RATIO, FLIPPED, OTHER = range(3)
#: Defects of a yaw.
NO_DEFECT, IS_FLIPPED, IS_UNUSED = range(3)
#: A moving object moves backwards with this probability.
BACKWARDS = 0.05
#: Far below this speed the direction of motion is no evidence: an object at rest may creep either way.
SLOW_MPS = 1.0
#: Twice the log-odds from which the sign of a speed counts as known. The nearer one of two signs would bias the speed
#: of an object at rest.
SURE = 2.0 * math.log(20.0)
_LARGEST_LOG_ODDS = 30.0
_NUM_YAW = 3
_LOG_TURN = math.log(2.0 * math.pi)


@inlined
def _forwards(speed_mps: float, variance: float) -> float:
    """Return the log-likelihood ratio of the speed: the yaw points forwards, against the yaw points backwards.

    With f = P(speed > 0) it is log (f (1 - b) + (1 - f) b) / (f b + (1 - f) (1 - b)), b = `BACKWARDS`.
    """
    f = 0.5 * math.erfc(-speed_mps / math.sqrt(2.0 * (variance + SLOW_MPS * SLOW_MPS)))
    front = f * (1.0 - BACKWARDS) + (1.0 - f) * BACKWARDS
    return math.log(front / (1.0 - front))


@inlined
def _weigh(shares: FloatArray, is_signed: bool, weights: FloatArray) -> None:
    """Write the weights of the readings of a yaw, if the yaw of the state is that of the front (row 0) or rear (row
    1).

    The columns are the readings 0, `HALF_TURN` and `WITHOUT_YAW`, then the same readings with `REVERSED`. A detector
    that takes the rear for the front may report the speed along the supposed front, or along the front.
    """
    right, flip, other = shares[0], shares[1], shares[2]
    if not is_signed:
        weights[0, 0], weights[0, 1], weights[0, 2] = right, flip, other
        weights[1, 0], weights[1, 1], weights[1, 2] = flip, right, other
        return
    half = 0.5 * flip
    weights[0, 0], weights[0, 1], weights[0, 2], weights[0, 4] = (
        right,
        half,
        other,
        half,
    )
    weights[1, 4], weights[1, 3], weights[1, 5], weights[1, 0] = (
        right,
        half,
        other,
        half,
    )


@inlined
def _compare(
    logs: FloatArray,
    weights: FloatArray,
    front: float,
    rear: float,
    has_yaw: bool,
    signs: int,
    evidence: FloatArray,
) -> None:
    """Write the log-likelihood ratio of the front, and the probabilities that the yaw is half a turn off, or
    arbitrary.

    `logs` are the log-likelihoods of the readings, in the columns of `weights`.
    """
    highest = -np.inf
    for entry in range(_NUM_YAW * signs):
        if weights[0, entry] + weights[1, entry] > 0.0:
            highest = max(highest, logs[entry])
    ahead, behind, flipped, other = 0.0, 0.0, 0.0, 0.0
    for entry in range(_NUM_YAW * signs):
        if weights[0, entry] + weights[1, entry] <= 0.0:
            continue
        likelihood = math.exp(logs[entry] - highest)
        by_front, by_rear = (
            likelihood * weights[0, entry],
            likelihood * weights[1, entry],
        )
        ahead += by_front
        behind += by_rear
        way = entry % _NUM_YAW
        if way == 2:
            other += front * by_front + rear * by_rear
        else:
            flipped += front * by_front if way == 1 else rear * by_rear
    total = front * ahead + rear * behind
    evidence[LOG_RATIO] = math.log(max(ahead, 1e-300) / max(behind, 1e-300))
    if has_yaw and total > 0.0:
        evidence[FLIPPED], evidence[OTHER] = flipped / total, other / total


@njit("b1[::1](float64[:, ::1], float64[:, :, ::1], float64[::1], b1[::1], float64)")
def turned(
    means: FloatArray,
    covariances: FloatArray,
    log_odds: FloatArray,
    before: BoolArray,
    sure: float,
) -> BoolArray:
    """Return True for each kinematic state, (m, n) and (m, n, n), whose yaw is that of the rear, shape (m,).

    The log-odds of the front are `log_odds` (m,) plus the evidence of the speed. If their magnitude is at most `sure`,
    the value `before` (m,) stays.
    """
    m = len(means)
    check(min(len(covariances), len(log_odds), len(before)) >= m and means.shape[1] > 3)
    check(covariances.shape[1] > 3 and covariances.shape[2] > 3)
    result = before.copy()
    for i in range(len(means)):
        belief = log_odds[i] + _forwards(means[i, 3], covariances[i, 3, 3])
        if abs(belief) > sure:
            result[i] = belief < 0.0
    return result


@njit(
    "(float64[:, ::1], float64[:, ::1], Array(float64, 3, 'C', readonly=True), float64[:, ::1],"
    " Array(float64, 3, 'C', readonly=True), int64[:], Array(float64, 3, 'C', readonly=True), int64, b1[::1], b1,"
    " float64[::1], float64[::1], b1, float64[::1], float64[::1])"
)
def read(
    y: FloatArray,
    z: FloatArray,
    H: FloatArray,
    x: FloatArray,
    P: FloatArray,
    tracks: IntArray,
    R: FloatArray,
    yaw: int,
    signed: BoolArray,
    cartesian: bool,
    log_odds: FloatArray,
    shares: FloatArray,
    learns: bool,
    more: FloatArray,
    limits: FloatArray,
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return the likeliest readings (m,), their costs (m,) and the evidence (m, 3) of pairs of detections and tracks.

    Innovations are y and values z (m, k), Jacobians H (m, k, n) or (1, k, n), states x (tracks, n) with covariances P,
    covariances R (m, k, k). `yaw` is the index of the yaw, -1 without a yaw. `signed` (k,) marks components that are
    opposite if front and rear are exchanged. `log_odds` (tracks,) are the log-odds of the front without the speed.
    `shares` (3,) are the shares of yaws that are right, half a turn off, and arbitrary. Without `learns` there is no
    evidence.

    The cost is NIS + log det S - 2 log of the weight over the weight of a right yaw. A pair is inside if the NIS of one
    reading plus `more` (m,) is at most the limit for its number of components, `limits` (k + 1,).
    """
    m, k = y.shape
    check_rows(tracks, 0, min(len(x), len(P), len(log_odds)))
    check(
        min(len(z), len(tracks), len(R), len(more)) >= m
        and (len(H) == 1 or len(H) >= m)
    )
    check(
        z.shape[1] >= k
        and H.shape[1] == k
        and H.shape[2] == P.shape[1]
        and P.shape[2] == P.shape[1]
    )
    check(R.shape[1] == k and R.shape[2] == k and x.shape[1] > 3 and P.shape[1] > 3)
    check(-1 <= yaw < k and len(signed) >= k and len(shares) >= 3 and len(limits) > k)
    readings, costs, evidence = (
        np.full(m, OUTSIDE),
        np.full(m, np.inf),
        np.zeros((m, 3)),
    )
    order, S, root = np.empty(k, np.int64), np.empty((k, k)), np.empty((k, k))
    HP, white, weights, logs = (
        np.empty((k, P.shape[1])),
        np.empty(k),
        np.zeros((2, 2 * _NUM_YAW)),
        np.empty(6),
    )
    count, signs, usual = 0, 1, 1.0
    for a in range(k):
        if signed[a]:
            signs = 2
        if a != yaw:
            order[count] = a
            count += 1
    if yaw >= 0:
        order[count] = yaw
        usual = shares[0]
        _weigh(shares, signs == 2, weights)
        if k == 1:  # nothing is left without the yaw
            weights[0, 2] = weights[1, 2] = weights[1, 5] = 0.0
    else:
        weights[0, 0], weights[1, _NUM_YAW if signs == 2 else 0] = 1.0, 1.0
    for i in range(m):
        t, least, least_logdet, inside = tracks[i], np.inf, 0.0, False
        speed, variance = x[t, 3], P[t, 3, 3]
        if cartesian:
            speed = math.sqrt(x[t, 2] ** 2 + x[t, 3] ** 2)
            cos, sin = (x[t, 2] / speed, x[t, 3] / speed) if speed > 0.0 else (1.0, 0.0)
            variance = (
                cos * cos * P[t, 2, 2]
                + 2.0 * cos * sin * P[t, 2, 3]
                + sin * sin * P[t, 3, 3]
            )
        belief = min(
            max(log_odds[t] + _forwards(speed, variance), -_LARGEST_LOG_ODDS),
            _LARGEST_LOG_ODDS,
        )
        front = 1.0 / (1.0 + math.exp(-belief))
        rear = 1.0 / (1.0 + math.exp(belief))
        copy(R[i], S)
        add_congruence(H[min(i, len(H) - 1)], P[t], HP, S)
        for sign in range(signs):
            if (
                sign == 1
                and inside
                and not learns
                and least < least_logdet + SURE - 2.0 * math.log(rear / usual)
            ):
                break  # no NIS is small enough
            for a in range(k):
                own = order[a]
                white[a] = (
                    y[i, own] - 2.0 * z[i, own]
                    if sign == 1 and signed[own]
                    else y[i, own]
                )
                for b in range(a + 1):
                    other = order[b]
                    root[a, b] = S[own, other]
                    if sign == 1 and signed[own] != signed[other]:
                        root[a, b] -= 2.0 * R[i, own, other]
            nis = whiten(root, white)
            logdet = 0.0
            for a in range(k if yaw < 0 else k - 1):
                logdet += 2.0 * math.log(root[a, a])
            last = white[k - 1]
            rest = nis - last * last if yaw >= 0 else nis
            if not rest + more[i] <= limits[k]:
                for way in range(_NUM_YAW):
                    logs[sign * _NUM_YAW + way] = -np.inf
                continue
            for way in range(_NUM_YAW if yaw >= 0 else 1):
                entry, code, own_nis, own_logdet, limit = (
                    sign * _NUM_YAW + way,
                    sign * REVERSED,
                    nis,
                    logdet,
                    limits[k],
                )
                if yaw >= 0 and way < 2:
                    own_logdet += 2.0 * math.log(root[k - 1, k - 1])
                if entry == 0:
                    least_logdet = own_logdet
                if way == 1:
                    turn = last - math.copysign(math.pi, y[i, yaw]) / root[k - 1, k - 1]
                    code, own_nis = code + HALF_TURN, rest + turn * turn
                elif way == 2:
                    code, own_nis, own_logdet, limit = (
                        code + WITHOUT_YAW,
                        rest,
                        logdet + _LOG_TURN,
                        limits[k - 1],
                    )
                weight = front * weights[0, entry] + rear * weights[1, entry]
                logs[entry] = -0.5 * (own_nis + own_logdet)
                if not (weight > 0.0 and own_nis < np.inf):
                    continue
                cost = own_nis + own_logdet - 2.0 * math.log(weight / usual)
                inside = inside or own_nis + more[i] <= limit
                costs[i] = min(costs[i], cost)
                cost += sign * SURE
                if cost < least:
                    least, readings[i] = cost, code
        if not inside:
            readings[i] = OUTSIDE
            continue
        if learns:
            _compare(logs, weights, front, rear, yaw >= 0, signs, evidence[i])
    return readings, costs, evidence


@njit(
    "int64[::1](int64[::1], int64, int64[::1], float64[:, ::1], b1, float64, float64[::1], int64[::1], float64[::1])"
)
def learn(
    rows: IntArray,
    stamp_ns: int,
    codes: IntArray,
    evidence: FloatArray,
    has_yaw: bool,
    switch_hz: float,
    log_odds: FloatArray,
    stamps_ns: IntArray,
    seen: FloatArray,
) -> IntArray:
    """Add the `evidence` (m, 3) of detections with reading `codes` (m,) to the log-odds of the tracks in `rows`.

    Between two detections front and rear are exchanged with the rate `switch_hz`. With a yaw, the numbers of right,
    flipped and other yaws in `seen` (3,) are updated. Returns the defects of the yaws (m,).
    """
    check_rows(rows, 0, min(len(log_odds), len(stamps_ns)))
    check(
        min(len(codes), len(evidence)) >= len(rows)
        and evidence.shape[1] >= 3
        and len(seen) >= 3
    )
    defects = np.zeros(len(rows), np.int64)
    for i in range(len(rows)):
        row = rows[i]
        dt_s = (stamp_ns - stamps_ns[row]) / NS_PER_S
        if dt_s > 0.0:
            changed = -0.5 * math.expm1(-2.0 * switch_hz * dt_s)
            odds = math.exp(log_odds[row])
            log_odds[row] = math.log(
                (odds * (1.0 - changed) + changed) / (odds * changed + 1.0 - changed)
            )
            stamps_ns[row] = stamp_ns
        belief = log_odds[row] + min(
            max(evidence[i, LOG_RATIO], -MOST_EVIDENCE), MOST_EVIDENCE
        )
        log_odds[row] = min(max(belief, -_LARGEST_LOG_ODDS), _LARGEST_LOG_ODDS)
        if not has_yaw:
            continue
        flipped, other = evidence[i, FLIPPED], evidence[i, OTHER]
        kept = min(1.0, MEMORY / (seen[0] + seen[1] + seen[2] + 1.0))
        seen[0] = seen[0] * kept + 1.0 - flipped - other
        seen[1] = seen[1] * kept + flipped
        seen[2] = seen[2] * kept + other
        if codes[i] & WITHOUT_YAW:
            defects[i] = IS_UNUSED
        elif flipped > 0.5:
            defects[i] = IS_FLIPPED
    return defects
