"""Existence of objects and their visibility to each sensor, against the hidden Markov model with all its states."""

import math
from itertools import permutations, product

import numpy as np
import pytest

from fgtrack.core.types import FloatArray
from fgtrack.tracking.visibility import LOG_ODDS, DetectionShares, Histories, Looks

LIFETIME_S, VISIBLE_S = 7.0, 3.0
S = 1_000_000_000
ONE, CELL = np.array([0]), np.array([0])
#: Stamp [s], sensor, share of visible objects, likelihood ratio if visible: matches, misses, one out of view.
EVIDENCE = [
    *[(0.5, 0, 0.8, 0.1), (0.7, 1, 0.3, 5.0), (1.5, 0, 0.8, 0.1), (2.5, 0, 0.6, 30.0)],
    *[(2.6, 1, 0.3, 0.1), (4.0, 0, 0.5, math.nan), (4.4, 1, 0.9, 0.1), (5.0, 0, 0.7, 0.1)],
]


def history(log_odds: float = 0.3) -> Histories:
    histories = Histories(2, LIFETIME_S, VISIBLE_S)
    histories.begin(0, 0, log_odds)
    return histories


def learn(histories: Histories, time_s: float, sensor: int, share: float, ratio: float, row: int = 0) -> None:
    numbers = np.array([share]), np.array([ratio])
    histories.learn(np.array([row]), round(time_s * S), sensor, *numbers, CELL)


def by_all_states(log_odds: float, until_s: float) -> tuple[float, FloatArray]:
    """Existence probability and visibilities by the forward algorithm over {not there, two by two visibilities}."""
    r = 1.0 / (1.0 + math.exp(-log_odds))
    belief = {None: 1.0 - r, **dict.fromkeys(product((0, 1), repeat=2), 0.0)}
    belief[(1, 0)] = r  # sensor 0 has started it; what sensor 1 sees begins with its first list
    now_s, viewed_s = 0.0, [0.0, math.nan]
    for time_s, sensor, share, ratio in EVIDENCE:
        stay, now_s = math.exp(-(time_s - now_s) / LIFETIME_S), time_s
        new = dict.fromkeys(belief, 0.0)
        new[None] = belief[None]
        keep = math.exp(-(time_s - viewed_s[sensor]) / VISIBLE_S) if not math.isnan(viewed_s[sensor]) else 0.0
        for state, p in belief.items():
            if state is None:
                continue
            new[None] += p * (1.0 - stay)
            for v in (0, 1):
                to_visible = share + (state[sensor] - share) * keep
                after = tuple(v if s == sensor else state[s] for s in (0, 1))
                if math.isnan(ratio):
                    new[after] += p * stay * (v == 0)
                else:
                    new[after] += p * stay * (to_visible if v else 1.0 - to_visible) * (ratio if v else 1.0)
        viewed_s[sensor] = math.nan if math.isnan(ratio) else time_s
        belief = {state: p / sum(new.values()) for state, p in new.items()}
    r = (1.0 - belief[None]) * math.exp(-(until_s - now_s) / LIFETIME_S)
    seen = [sum(p for state, p in belief.items() if state is not None and state[s]) for s in (0, 1)]
    return r, np.array(seen) / (1.0 - belief[None])


def test_existence_and_visibility_are_those_of_the_hidden_markov_model_with_all_states() -> None:
    histories = history()
    for evidence in EVIDENCE:
        learn(histories, *evidence)
    r, visible = by_all_states(0.3, 6.0)
    assert histories.present(ONE, 6 * S) == pytest.approx([r], rel=1e-9)
    assert histories.last(ONE)[0][0] == pytest.approx(visible, rel=1e-9)


def test_evidence_counts_at_its_own_stamp_in_whatever_order_it_arrives() -> None:
    found = set()
    for order in list(permutations(EVIDENCE))[::97]:
        histories = history()
        for evidence in order:
            learn(histories, *evidence)
        found.add((float(histories.present(ONE, 6 * S)[0]), *histories.last(ONE)[0][0].tolist()))
    assert len(found) == 1


def test_what_is_forgotten_changes_nothing_and_what_is_older_counts_as_the_oldest() -> None:
    one, other = history(), history()
    for each in (one, other):
        for evidence in EVIDENCE[:4]:
            learn(each, *evidence)
    looks = other.forget(2 * S)
    assert looks.stamps_ns.tolist() == [S // 2, 7 * S // 10, 3 * S // 2]
    assert looks.shown.tolist() == [False, True, False]
    learn(other, 1.0, 1, 0.3, 0.1)
    learn(one, 1.5, 1, 0.3, 0.1)
    assert one.present(ONE, 3 * S) == pytest.approx(other.present(ONE, 3 * S), rel=1e-12)


def test_misses_in_a_row_cost_little_more_than_the_first_and_another_sensor_is_not_concerned() -> None:
    histories = history(5.0)
    lost = []
    for k in range(6):
        before = histories.numbers[0, histories.counts[0] - 1, LOG_ODDS]
        learn(histories, 0.1 * (k + 1), 0, 0.5, 0.1)
        lost.append(before - histories.numbers[0, histories.counts[0] - 1, LOG_ODDS])
    assert lost[0] > 1.5
    assert max(lost[3:]) < 0.1
    visible, _ = histories.last(ONE)
    learn(histories, 1.0, 1, 0.9, 20.0)
    assert histories.last(ONE)[0][0, 0] == visible[0, 0] < 0.05
    assert histories.last(ONE)[0][0, 1] > 0.99


def test_many_tracks_with_long_histories_are_as_each_alone() -> None:
    together = Histories(2, LIFETIME_S, VISIBLE_S)
    rows = np.array([together.begin(0, k % 2, 0.1 * k) for k in range(20)])
    together.end(7)
    assert together.begin(0, 1, 3.0) == 7
    rng = np.random.default_rng(4)
    alone = history(0.4)
    for k in range(60):
        ratios, shares = rng.uniform(0.1, 4.0, 20), rng.uniform(0.1, 0.9, 20)
        together.learn(rows, (k + 1) * S // 10, k % 2, shares, ratios, np.zeros(20, dtype=np.int64))
        learn(alone, 0.1 * (k + 1), k % 2, shares[4], ratios[4])
    assert together.present(rows, 6 * S)[4] == alone.present(ONE, 6 * S)[0]


def looks(stamp_s: float, shown: bool, count: int, cell: int = 0, weight: float = 1.0) -> Looks:
    several = np.full(count, round(stamp_s * S)), np.zeros(count, dtype=np.int64), np.full(count, cell)
    return Looks(np.zeros(count, dtype=np.int64), *several, np.full(count, shown), np.full(count, weight))


def test_a_share_is_learned_where_the_looks_are_and_at_other_bearings_of_that_range() -> None:
    shares = DetectionShares(5 * S, [0.6])
    near, far = (shares.cells(np.full(2, range_m), np.array([0.1, 3.0])) for range_m in (30.0, 100.0))
    assert shares.at(0, 0, near).tolist() == [0.6, 0.6]
    shares.learn(looks(1.0, False, 50, int(far[0])))
    shares.learn(looks(1.0, True, 50, int(near[0])))
    in_view = shares.at(0, 10 * S, np.concatenate([near, far]))
    assert in_view[0] > in_view[1] > 0.9
    assert in_view[2] < in_view[3] < 0.1
    beyond = shares.cells(np.array([1e6]), np.array([0.1]))
    assert shares.at(0, 10 * S, beyond).tolist() == [0.6]


@pytest.mark.parametrize("stamp_s", [5.0, 9.9])
def test_a_list_is_judged_by_what_no_late_list_changes(stamp_s: float) -> None:
    early, late = DetectionShares(5 * S, [0.6]), DetectionShares(5 * S, [0.6])
    for shares in (early, late):
        shares.at(0, 2 * S, CELL)
    before = early.at(0, round(stamp_s * S), CELL)
    late.learn(looks(4.0, False, 10))
    late.at(0, 14 * S, CELL)
    assert late.at(0, round(stamp_s * S), CELL) == before == [0.6]
    assert late.at(0, 14 * S, CELL) < 0.2


def test_what_was_learned_is_forgotten_within_minutes() -> None:
    shares = DetectionShares(5 * S, [0.6])
    shares.learn(looks(1.0, False, 20))
    found = [float(shares.at(0, t * S, CELL)[0]) for t in (12, 300, 3000)]
    assert found[0] < found[1] < found[2]
    assert found[2] == pytest.approx(0.6, abs=0.01)
