"""Check for later data: after which arrivals a problem is cut off, and the queries there."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fgtrack.core.time import NS_PER_S
from fgtrack.ranking.crowds import CrowdProblem, CrowdQuery
from fgtrack.ranking.problem import LAGS_S, Problem, Query

_NUM_CUTS = 8
"""Least number of arrivals after which a problem is cut off, if it has as many."""
_NUM_LATE = 3
"""Number of the latest arrivals before which a problem is cut off."""


def with_more_queries(problem: Problem) -> tuple[Problem, list[int]]:
    """Return a problem with more queries, and the numbers of arrivals after which it is cut off.

    The cuts lie after the arrivals at which a method is judged, before the latest
    arrivals, and between them. At each cut there are queries for the present and for the
    past. A query asks for the stamp of the next late arrival, which is not yet known.
    """
    arrivals = problem.arrivals
    stamps_ns = [each.true_stamp_ns for each in arrivals]
    judged = {query.num_known for query in problem.queries}
    late = [number for number in _latest(stamps_ns) if not _is_copy(problem, number)]
    wanted = {*judged, *late[:_NUM_LATE]} - {0, len(arrivals)}
    cuts = _filled(wanted, range(1, len(arrivals)))
    queries = list(problem.queries)
    for num_known in cuts:
        newest_ns = max(stamps_ns[:num_known])
        coming_ns = [each for each in stamps_ns[num_known:] if each < newest_ns]
        asked_ns = [newest_ns - round(lag_s * NS_PER_S) for lag_s in LAGS_S]
        if num_known in judged:
            asked_ns = []
        queries += [
            Query(num_known, stamp_ns, (newest_ns - stamp_ns) / NS_PER_S)
            for stamp_ns in [*asked_ns, *coming_ns[:1]]
            if stamp_ns >= problem.start.stamp_ns
        ]
    queries.sort(key=lambda query: query.num_known)
    return replace(problem, queries=tuple(queries)), cuts


def with_more_scan_queries(problem: CrowdProblem) -> tuple[CrowdProblem, list[int]]:
    """Return a problem with more queries, and the numbers of scans after which it is cut off.

    The cuts lie at queries before the latest scans, and between them. At each cut a query
    asks for the stamp of the next late scan, which is not yet known.
    """
    stamps_ns = [scan.stamp_ns for scan in problem.scans]
    asked = sorted({query.num_known for query in problem.queries})
    asked = [each for each in asked if 0 < each < len(stamps_ns)]
    late = _latest(stamps_ns)[:_NUM_LATE]
    before = [[each for each in asked if each <= number] for number in late]
    cuts = _filled({each[-1] for each in before if each}, asked)
    queries = list(problem.queries)
    for num_known in cuts:
        newest_ns = max(stamps_ns[:num_known])
        coming_ns = [each for each in stamps_ns[num_known:] if each < newest_ns]
        queries += [
            CrowdQuery(num_known, stamp_ns, (newest_ns - stamp_ns) / NS_PER_S)
            for stamp_ns in coming_ns[:1]
        ]
    queries.sort(key=lambda query: query.num_known)
    return replace(problem, queries=tuple(queries)), cuts


def _latest(stamps_ns: Sequence[int]) -> list[int]:
    """Return the numbers of the arrivals that are older than the newest stamp, the latest first."""
    stamps = np.array(stamps_ns)
    behind_ns = np.maximum.accumulate(stamps) - stamps
    order = np.argsort(-behind_ns, kind="stable")
    return [number for number in order.tolist() if behind_ns[number] > 0]


def _is_copy(problem: Problem, number: int) -> bool:
    """True if an arrival has arrived before."""
    key = problem.arrivals[number].key
    return any(each.key == key for each in problem.arrivals[:number])


def _filled(wanted: set[int], choices: Sequence[int]) -> list[int]:
    """Return `wanted` in ascending order, filled with evenly spread `choices`."""
    found = set(wanted)
    if choices:
        places = np.linspace(0, len(choices) - 1, _NUM_CUTS).round().astype(np.int64)
        for place in places.tolist():
            if len(found) < _NUM_CUTS:
                found.add(choices[place])
    return sorted(found)
