"""Existence of objects and their visibility to each sensor, against the hidden Markov model with all its states."""

import math
from itertools import permutations, product

import numpy as np
import pytest

from fgtrack.core.types import FloatArray
from fgtrack.tracking.lives.visibility import LOG_ODDS, VISIBLE, Histories

LIFETIME_S, VISIBLE_S = 7.0, 3.0
S = 1_000_000_000
ONE = np.array([0])
#: Stamp [s], sensor, likelihood ratio if visible: matches, misses, one out of view.
EVIDENCE = [
    *[(0.5, 0, 0.1), (0.7, 1, 5.0), (1.5, 0, 0.1), (2.5, 0, 30.0)],
    *[(2.6, 1, 0.1), (4.0, 0, math.nan), (4.4, 1, 0.1), (5.0, 0, 0.1)],
]


def history(log_odds: float = 0.3, share: float = 0.7) -> Histories:
    histories = Histories(2, LIFETIME_S, share, VISIBLE_S)
    histories.begin(0, 0, 0, log_odds)
    return histories


def learn(histories: Histories, time_s: float, sensor: int, ratio: float) -> None:
    histories.learn(
        ONE, np.array([round(time_s * S)]), np.array([sensor]), np.array([ratio])
    )


def visibility(histories: Histories) -> FloatArray:
    """Probabilities of being visible to each sensor after the newest evidence, shape (1, sensors)."""
    return histories.numbers[ONE, histories.counts[ONE] - 1, VISIBLE:]


def by_all_states(
    log_odds: float, share: float, until_s: float
) -> tuple[float, FloatArray]:
    """Existence probability and visibilities by the forward algorithm over {not there, two by two visibilities}."""
    r = 1.0 / (1.0 + math.exp(-log_odds))
    belief = {None: 1.0 - r, **dict.fromkeys(product((0, 1), repeat=2), 0.0)}
    belief[(1, 0)] = (
        r  # sensor 0 has started it; what sensor 1 sees begins with its first list
    )
    now_s, viewed_s = 0.0, [0.0, math.nan]
    for time_s, sensor, ratio in EVIDENCE:
        stay, now_s = math.exp(-(time_s - now_s) / LIFETIME_S), time_s
        new = dict.fromkeys(belief, 0.0)
        new[None] = belief[None]
        keep = (
            math.exp(-(time_s - viewed_s[sensor]) / VISIBLE_S)
            if not math.isnan(viewed_s[sensor])
            else 0.0
        )
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
                    new[after] += (
                        p
                        * stay
                        * (to_visible if v else 1.0 - to_visible)
                        * (ratio if v else 1.0)
                    )
        viewed_s[sensor] = math.nan if math.isnan(ratio) else time_s
        belief = {state: p / sum(new.values()) for state, p in new.items()}
    r = (1.0 - belief[None]) * math.exp(-(until_s - now_s) / LIFETIME_S)
    seen = [
        sum(p for state, p in belief.items() if state is not None and state[s])
        for s in (0, 1)
    ]
    return r, np.array(seen) / (1.0 - belief[None])


@pytest.mark.parametrize("share", [0.3, 0.8])
def test_existence_and_visibility_are_those_of_the_hidden_markov_model_with_all_states(
    share: float,
) -> None:
    histories = history(0.3, share)
    for evidence in EVIDENCE:
        learn(histories, *evidence)
    r, visible = by_all_states(0.3, share, 6.0)
    assert histories.present(ONE, 6 * S) == pytest.approx([r], rel=1e-9)
    assert visibility(histories)[0] == pytest.approx(visible, rel=1e-9)


def test_evidence_counts_at_its_own_stamp_in_whatever_order_it_arrives() -> None:
    found = set()
    for order in list(permutations(EVIDENCE))[::97]:
        histories = history()
        for evidence in order:
            learn(histories, *evidence)
        found.add(
            (
                float(histories.present(ONE, 6 * S)[0]),
                *visibility(histories)[0].tolist(),
            )
        )
    assert len(found) == 1


def test_what_is_forgotten_changes_nothing_and_what_is_older_counts_as_the_oldest() -> (
    None
):
    one, other = history(), history()
    for each in (one, other):
        for evidence in EVIDENCE[:4]:
            learn(each, *evidence)
    other.forget(2 * S)
    assert other.counts[0] == 2
    learn(other, 1.0, 1, 0.1)
    learn(one, 1.5, 1, 0.1)
    assert one.present(ONE, 3 * S) == pytest.approx(
        other.present(ONE, 3 * S), rel=1e-12
    )


def test_misses_in_a_row_cost_little_more_than_the_first_and_another_sensor_is_not_concerned() -> (
    None
):
    histories = history(5.0, 0.5)
    lost = []
    for k in range(6):
        before = histories.numbers[0, histories.counts[0] - 1, LOG_ODDS]
        learn(histories, 0.1 * (k + 1), 0, 0.1)
        lost.append(before - histories.numbers[0, histories.counts[0] - 1, LOG_ODDS])
    assert lost[0] > 1.5
    assert max(lost[3:]) < 0.1
    visible = visibility(histories)
    learn(histories, 1.0, 1, 20.0)
    assert visibility(histories)[0, 0] == visible[0, 0] < 0.05
    assert visibility(histories)[0, 1] > 0.9


def test_many_tracks_with_long_histories_are_as_each_alone() -> None:
    together = Histories(2, LIFETIME_S, 0.7, VISIBLE_S)
    rows = np.arange(20)
    for k in range(20):
        together.begin(k, 0, k % 2, 0.1 * k)
    together.end(7)
    together.begin(7, 0, 1, 3.0)
    rng = np.random.default_rng(4)
    alone = history(0.4)
    for k in range(60):
        ratios = rng.uniform(0.1, 4.0, 20)
        together.learn(
            rows,
            *(np.full(len(rows), each) for each in ((k + 1) * S // 10, k % 2)),
            ratios,
        )
        learn(alone, 0.1 * (k + 1), k % 2, ratios[4])
    assert together.present(rows, 6 * S)[4] == alone.present(ONE, 6 * S)[0]
