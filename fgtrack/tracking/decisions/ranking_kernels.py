"""Compiled ranking of assignments, the likeliest one first."""

import math

import numpy as np

from fgtrack.core.compiled import check, check_rows, inlined, merged, njit, shared
from fgtrack.core.types import BoolArray, FloatArray, IntArray

Pairs = tuple[IntArray, IntArray, FloatArray]
"""Row i has the pairs `first[i]` to `first[i + 1]`, with `columns` (p,) and `costs` (p,)."""
Options = tuple[BoolArray, BoolArray]
"""True for each pair that may be used (p,), and for each row that may take no column (n,)."""
Choice = tuple[IntArray, IntArray]
"""Pair of each row, `MISSED` without one (n,), and the row that holds each column (m + n,)."""
Prices = tuple[FloatArray, FloatArray]
"""Prices of rows (n,) and columns (m + n,)."""
Work = tuple[FloatArray, IntArray]
"""Lengths of paths (m + n,), infinite before and after a call, and memory (4, m + n), 0 before and after a call."""

FREE, BLOCKED = -1, -2
"""Holders of a column that no row has, and of a column that no row may take."""
MISSED, ABSENT = -1, -2
"""Pair of a row that takes no column, and of a row that is not in the problem."""
_SOLVED = -1
_ROUNDING = 1e-9
_PAIRS = "Tuple((int64[::1], int64[::1], float64[::1]))"
_OPTIONS = "UniTuple(b1[::1], 2)"
_CHOICE = "UniTuple(int64[::1], 2)"
_PRICES = "UniTuple(float64[::1], 2)"
_WORK = "Tuple((float64[::1], int64[:, ::1]))"


@merged
def _insert(
    start: int,
    pairs: Pairs,
    options: Options,
    choice: Choice,
    prices: Prices,
    work: Work,
) -> bool:
    """Assign one more row along the shortest path of changes; return False without a path."""
    first, columns, costs = pairs
    is_allowed, is_missable = options
    chosen, holders = choice
    row_prices, column_prices = prices
    lengths, memory = work
    reached, is_done, via_row, via_pair = memory[0], memory[1], memory[2], memory[3]
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


@shared(f"b1(int64[::1], {_PAIRS}, {_OPTIONS}, {_CHOICE}, {_PRICES}, {_WORK})")
def _assign(
    rows: IntArray,
    pairs: Pairs,
    options: Options,
    choice: Choice,
    prices: Prices,
    work: Work,
) -> bool:
    """Assign `rows` to columns at least cost; return False if no assignment exists.

    A row may take no column, at cost 0: this is column m + i, which no other row can take. The prices are 0 before
    the call. A pair that is not chosen raises the cost by its cost less both prices, or more.

    Source: Crouse, "On implementing 2D rectangular assignment algorithms", IEEE T-AES 52(4), 2016.
    """
    is_solved = True
    for row in rows:
        is_solved = is_solved and _insert(row, pairs, options, choice, prices, work)
    return is_solved


@inlined
def _label(
    rows: IntArray,
    pairs: Pairs,
    is_allowed: BoolArray,
    holders: IntArray,
    labels: IntArray,
    following: IntArray,
) -> None:
    """Write the least row of the cluster of each row to `labels` (n,), and its next row to `following` (n,).

    Clusters share no column. The last row of a cluster is followed by -1. `holders` (m + n,) is `FREE` before the call.
    """
    first, columns, _ = pairs
    for i in rows:
        labels[i], following[i] = i, -1
        for pair in range(first[i], first[i + 1]):
            if not is_allowed[pair]:
                continue
            if holders[columns[pair]] == FREE:
                holders[columns[pair]] = i
                continue
            one, other = i, holders[columns[pair]]
            while labels[one] != one:
                one = labels[one]
            while labels[other] != other:
                other = labels[other]
            labels[max(one, other)] = min(one, other)
    for i in rows:
        labels[i] = labels[labels[i]]  # labels of lesser rows are final
    for k in range(len(rows) - 1, -1, -1):
        i = rows[k]
        if labels[i] != i:
            following[i], following[labels[i]] = following[labels[i]], i


@inlined
def _restrict(
    rows: IntArray,
    pairs: Pairs,
    options: Options,
    prices: Prices,
    limit: float,
    likeliest: IntArray,
    second_losses: FloatArray,
) -> None:
    """Allow only the pairs whose losses are at most `limit`.

    Written are the pair with the least loss of each row, and the least loss of its other pairs.
    """
    first, columns, costs = pairs
    is_allowed, is_missable = options
    row_prices, column_prices = prices
    m = len(column_prices) - len(row_prices)
    for i in rows:
        least = second = math.inf
        likeliest[i] = MISSED
        for pair in range(first[i], first[i + 1] + 1):
            if pair < first[i + 1]:
                own, column = pair, columns[pair]
                loss = costs[pair] - row_prices[i] - column_prices[column]
                is_allowed[pair] = loss <= limit
                if not is_allowed[pair]:
                    continue
            else:
                own, loss = MISSED, -row_prices[i] - column_prices[m + i]
                is_missable[i] = loss <= limit
            if loss < least:
                least, second = loss, least
                likeliest[i] = own
            elif loss < second:
                second = loss
        second_losses[i] = second


@inlined
def _open(
    rows: IntArray,
    pairs: Pairs,
    options: Options,
    labels: IntArray,
    following: IntArray,
    positions: IntArray,
    opened: IntArray,
) -> int:
    """Write the rows that have a choice to `opened`, cluster by cluster, and their `positions`; return their number.

    The position of a row without a choice is n.
    """
    first = pairs[0]
    is_allowed, is_missable = options
    count = 0
    for start in rows:
        i = start if labels[start] == start else -1
        while i >= 0:
            num_options = 1 if is_missable[i] else 0
            for pair in range(first[i], first[i + 1]):
                num_options += 1 if is_allowed[pair] else 0
            positions[i] = len(positions)
            if num_options > 1:
                positions[i], opened[count] = count, i
                count += 1
            i = following[i]
    return count


@inlined
def _likeliest(keys: FloatArray, items: IntArray, count: int) -> int:
    """Return the index of the largest key. Of equal keys the earliest one counts: `items` begin with a number."""
    best = 0
    for k in range(1, count):
        if keys[k] > keys[best] or (
            keys[k] == keys[best] and items[k, 0] < items[best, 0]
        ):
            best = k
    return best


@inlined
def _note(gains: FloatArray, gain: float) -> None:
    """Insert `gain` into `gains`, which descend; the last one is dropped."""
    k = len(gains) - 1
    if gain <= gains[k]:
        return
    while k > 0 and gains[k - 1] < gain:
        gains[k] = gains[k - 1]
        k -= 1
    gains[k] = gain


@njit(
    "(int64[::1], int64[::1], float64[::1], int64, float64[::1], int64[::1], int64[::1], int64, float64)"
)
def rank(
    first: IntArray,
    columns: IntArray,
    gains: FloatArray,
    num_columns: int,
    bases: FloatArray,
    rows: IntArray,
    starts: IntArray,
    most: int,
    largest_loss: float,
) -> tuple[FloatArray, IntArray, IntArray]:
    """Return the `most` likeliest assignments of all problems: gains (r,), problems (r,), and pairs of rows (r, n).

    Problem g has the gain `bases[g]` and the rows from `starts[g]` up to the next start, which ascend. Row i has the
    pairs `first[i]` to `first[i + 1]`, with `columns` (p,) and `gains` (p,). The pair of a row is `MISSED` if it takes
    no column, `ABSENT` if the problem does not have the row.

    Source: Murty, "An algorithm for ranking all the assignments in order of increasing cost", Operations Research
    16(3), 1968. The prices of the best assignment bound the loss of each pair, so most rows have one pair left.
    """
    n, m, num_problems, p = len(first) - 1, num_columns, len(bases), len(columns)
    check(n >= 0 and m >= 0 and most > 0 and num_problems > 0)
    check(first[0] == 0 and first[n] == p and len(gains) == p)
    check_rows(columns, 0, m)
    check_rows(rows, 0, n)
    check(len(starts) == num_problems + 1 and starts[0] == 0)
    check(starts[num_problems] == len(rows))
    for g in range(num_problems):
        check(starts[g] <= starts[g + 1])
    for i in range(n):
        check(first[i] <= first[i + 1])
    costs = np.empty(p)
    for k in range(p):
        costs[k] = -gains[k]
    pairs = (first, columns, costs)
    work = (np.full(m + n, math.inf), np.zeros((4, m + n), np.int64))
    holders, todo = np.empty(m + n, np.int64), np.empty(n, np.int64)
    # Of each problem:
    row_prices, column_prices = (
        np.zeros((num_problems, n)),
        np.zeros((num_problems, m + n)),
    )
    is_allowed = np.ones((num_problems, p), np.bool_)
    is_missable = np.ones((num_problems, n), np.bool_)
    likeliest = np.empty((num_problems, n), np.int64)
    second_losses = np.empty((num_problems, n))
    labels = np.empty((num_problems, n), np.int64)
    following = np.empty((num_problems, n), np.int64)
    positions = np.empty((num_problems, n), np.int64)
    opened = np.empty((num_problems, n), np.int64)
    num_open = np.zeros(num_problems, np.int64)
    # Of each solution; the first ones are the best of the problems:
    most_solutions = num_problems + most * n + 1
    chosen = np.empty((most_solutions, n), np.int64)
    totals = np.empty(most_solutions)
    owners, parents = np.empty((2, most_solutions), np.int64)
    decided = np.zeros(most_solutions, np.int64)
    # Solutions, and bounds of branches of solutions, that wait: number, solution, row that takes another pair.
    keys = np.empty(num_problems + 2 * most * n + 1)
    items = np.empty((len(keys), 3), np.int64)
    best_totals = np.full(most, -math.inf)
    num_solutions = num_waiting = number = num_found = 0
    found = np.empty(most, np.int64)
    for g in range(num_problems):
        own = rows[starts[g] : starts[g + 1]]
        for i in range(n):
            chosen[g, i] = ABSENT
        for i in own:
            chosen[g, i] = MISSED
        for k in range(m + n):
            holders[k] = FREE
        _assign(
            own,
            pairs,
            (is_allowed[g], is_missable[g]),
            (chosen[g], holders),
            (row_prices[g], column_prices[g]),
            work,
        )
        totals[g], owners[g], parents[g] = bases[g], g, -1
        for i in own:
            if chosen[g, i] >= 0:
                totals[g] += gains[chosen[g, i]]
        _note(best_totals, totals[g])
    lowest = best_totals[0] - largest_loss
    num_solutions = num_problems
    for g in range(num_problems):
        if totals[g] >= lowest:
            keys[num_waiting] = totals[g]
            items[num_waiting, 0] = number
            items[num_waiting, 1], items[num_waiting, 2] = g, _SOLVED
            num_waiting, number = num_waiting + 1, number + 1
    blank_rows, blank_columns = np.zeros(n), np.zeros(m + n)
    while num_waiting > 0 and num_found < most:
        k = _likeliest(keys, items, num_waiting)
        bound, solution, position = keys[k], items[k, 1], items[k, 2]
        num_waiting -= 1
        keys[k] = keys[num_waiting]
        for a in range(3):
            items[k, a] = items[num_waiting, a]
        g = owners[solution]
        own = rows[starts[g] : starts[g + 1]]
        options = (is_allowed[g], is_missable[g])
        least = max(lowest, best_totals[most - 1])
        if position == _SOLVED:
            found[num_found] = solution
            num_found += 1
            if solution == g:
                limit = totals[g] - lowest + _ROUNDING
                prices = (row_prices[g], column_prices[g])
                _restrict(
                    own, pairs, options, prices, limit, likeliest[g], second_losses[g]
                )
                for c in range(m + n):
                    holders[c] = FREE
                _label(own, pairs, is_allowed[g], holders, labels[g], following[g])
                num_open[g] = _open(
                    own,
                    pairs,
                    options,
                    labels[g],
                    following[g],
                    positions[g],
                    opened[g],
                )
            for place in range(decided[solution], num_open[g]):
                i = opened[g, place]
                is_likeliest = chosen[solution, i] == likeliest[g, i]
                loss = second_losses[g, i] if is_likeliest else 0.0
                largest = min(totals[solution], totals[g] - loss)
                if largest >= least - _ROUNDING:
                    keys[num_waiting] = largest
                    items[num_waiting, 0] = number
                    items[num_waiting, 1], items[num_waiting, 2] = solution, place
                    num_waiting, number = num_waiting + 1, number + 1
            continue
        if bound < least - _ROUNDING:
            continue
        # The best assignment with the pairs of the solution for the open rows before this one, and another pair here.
        new, track = num_solutions, opened[g, position]
        for i in range(n):
            chosen[new, i] = chosen[solution, i]
        for c in range(m + n):
            holders[c], blank_columns[c] = FREE, 0.0
        num_todo, i = 0, labels[g, track]
        while i >= 0:
            blank_rows[i] = 0.0
            if positions[g, i] >= position:
                todo[num_todo] = i
                num_todo += 1
            elif chosen[new, i] >= 0:
                holders[columns[chosen[new, i]]] = BLOCKED
            i = following[g, i]
        # Pairs that this row has in the solution and its ancestors are excluded.
        was_missable, ancestor = is_missable[g, track], solution
        while True:
            pair = chosen[ancestor, track]
            if pair >= 0:
                is_allowed[g, pair] = False
            else:
                is_missable[g, track] = False
            if ancestor == g or decided[ancestor] != position:
                break
            ancestor = parents[ancestor]
        is_solved = _assign(
            todo[:num_todo],
            pairs,
            options,
            (chosen[new], holders),
            (blank_rows, blank_columns),
            work,
        )
        is_missable[g, track], ancestor = was_missable, solution
        while True:
            pair = chosen[ancestor, track]
            if pair >= 0:
                is_allowed[g, pair] = True
            if ancestor == g or decided[ancestor] != position:
                break
            ancestor = parents[ancestor]
        if not is_solved:
            continue
        total = bases[g]
        for i in own:
            if chosen[new, i] >= 0:
                total += gains[chosen[new, i]]
        if total < least:
            continue
        totals[new], owners[new], parents[new] = total, g, solution
        decided[new] = position
        num_solutions += 1
        _note(best_totals, total)
        keys[num_waiting] = total
        items[num_waiting, 0] = number
        items[num_waiting, 1], items[num_waiting, 2] = new, _SOLVED
        num_waiting, number = num_waiting + 1, number + 1
    result = np.empty((num_found, n), np.int64)
    problems, own_totals = np.empty(num_found, np.int64), np.empty(num_found)
    for k in range(num_found):
        own_totals[k], problems[k] = totals[found[k]], owners[found[k]]
        for i in range(n):
            result[k, i] = chosen[found[k], i]
    return own_totals, problems, result
