"""Compiled search for the assignment with the least cost."""

import math

from fgtrack.core.compiled import check, check_rows, inlined, njit
from fgtrack.core.types import BoolArray, FloatArray, IntArray

FREE, BLOCKED = -1, -2
"""Holders of a column that no row has, and of a column that no row may take."""
MISSED = -1
"""Pair of a row that takes no column."""


@inlined
def _insert(
    start: int,
    first: IntArray,
    columns: IntArray,
    costs: FloatArray,
    is_allowed: BoolArray,
    is_missable: BoolArray,
    holders: IntArray,
    chosen: IntArray,
    row_prices: FloatArray,
    column_prices: FloatArray,
    lengths: FloatArray,
    work: IntArray,
) -> bool:
    """Assign one more row along the shortest path of changes; return False without a path."""
    reached, is_done, via_row, via_pair = work[0], work[1], work[2], work[3]
    num_own = len(holders) - len(chosen)
    num_reached = 0
    length, row, sink = 0.0, start, -1
    while sink < 0:
        for pair in range(first[row], first[row + 1] + 1):
            if pair < first[row + 1]:
                if not is_allowed[pair]:
                    continue
                column, cost, via = columns[pair], costs[pair], pair
            else:
                if not is_missable[row]:
                    continue
                column, cost, via = num_own + row, 0.0, MISSED
            if holders[column] == BLOCKED or is_done[column] == 1:
                continue
            own = length + cost - row_prices[row] - column_prices[column]
            if own < lengths[column]:
                if lengths[column] == math.inf:
                    reached[num_reached] = column
                    num_reached += 1
                lengths[column] = own
                via_row[column], via_pair[column] = row, via
        shortest, nearest = math.inf, -1
        for k in range(num_reached):
            column = reached[k]
            if is_done[column] == 0 and lengths[column] < shortest:
                shortest, nearest = lengths[column], column
        if nearest < 0:
            break
        length = shortest
        is_done[nearest] = 1
        if holders[nearest] == FREE:
            sink = nearest
        else:
            row = holders[nearest]
    if sink >= 0:
        row_prices[start] += length
        for k in range(num_reached):
            column = reached[k]
            if is_done[column] == 1 and column != sink:
                row_prices[holders[column]] += length - lengths[column]
                column_prices[column] -= length - lengths[column]
        column = sink
        while True:
            row = via_row[column]
            former = chosen[row]
            chosen[row] = via_pair[column]
            holders[column] = row
            if row == start:
                break
            column = num_own + row if former == MISSED else columns[former]
    for k in range(num_reached):
        column = reached[k]
        lengths[column] = math.inf
        is_done[column] = via_row[column] = via_pair[column] = 0
    for k in range(num_reached):
        reached[k] = 0
    return sink >= 0


@njit(
    "boolean(int64[::1], int64[::1], int64[::1], float64[::1], boolean[::1], boolean[::1], int64[::1], int64[::1],"
    " float64[::1], float64[::1], float64[::1], int64[:, ::1])"
)
def assign(
    rows: IntArray,
    first: IntArray,
    columns: IntArray,
    costs: FloatArray,
    is_allowed: BoolArray,
    is_missable: BoolArray,
    holders: IntArray,
    chosen: IntArray,
    row_prices: FloatArray,
    column_prices: FloatArray,
    lengths: FloatArray,
    work: IntArray,
) -> bool:
    """Assign `rows` to columns at least cost; return False if no assignment exists.

    Row i has the pairs `first[i]` to `first[i + 1]`, with `columns` (p,) and `costs` (p,), of which `is_allowed` (p,)
    may be used. Where `is_missable` (n,), a row may take no column, at cost 0: this is column m + i, which no other
    row can take. `holders` (m + n,) has the row that holds each column, `FREE` or `BLOCKED`. Written are `chosen`
    (n,), the pair of each row, `MISSED` without one, and the prices, which are 0 before the call. A pair that is not
    chosen raises the cost by its cost less both prices, or more. `lengths` (m + n,) is infinite, and `work` (4, m + n)
    is 0, before and after the call.

    Source: Crouse, "On implementing 2D rectangular assignment algorithms", IEEE T-AES 52(4), 2016.
    """
    n, num_columns = len(chosen), len(holders)
    check_rows(rows, 0, n)
    check_rows(columns, 0, num_columns - n)
    check(len(first) == n + 1 and first[0] >= 0 and first[n] <= len(columns))
    check(len(costs) == len(columns) and len(is_allowed) == len(columns))
    check(len(is_missable) == n and len(row_prices) == n)
    check(len(column_prices) == num_columns and len(lengths) == num_columns)
    check(work.shape[0] == 4 and work.shape[1] == num_columns)
    for k in range(len(rows)):
        if not _insert(
            rows[k],
            first,
            columns,
            costs,
            is_allowed,
            is_missable,
            holders,
            chosen,
            row_prices,
            column_prices,
            lengths,
            work,
        ):
            return False
    return True


@njit("void(int64[::1], int64[::1], int64[::1], int64[::1])")
def label_clusters(
    tracks: IntArray, candidates: IntArray, holders: IntArray, labels: IntArray
) -> None:
    """Write the least track of the cluster of each track to `labels` (n,). Clusters share no candidate.

    The pairs `tracks` and `candidates` have the shape (p,). `holders` (m,) is `FREE` before the call.
    """
    check(len(tracks) == len(candidates))
    check_rows(tracks, 0, len(labels))
    check_rows(candidates, 0, len(holders))
    for i in range(len(labels)):
        labels[i] = i
    for k in range(len(tracks)):
        if holders[candidates[k]] == FREE:
            holders[candidates[k]] = tracks[k]
            continue
        first, second = tracks[k], holders[candidates[k]]
        while labels[first] != first:
            first = labels[first]
        while labels[second] != second:
            second = labels[second]
        labels[max(first, second)] = min(first, second)
    for i in range(len(labels)):
        labels[i] = labels[labels[i]]  # labels of lesser tracks are final
