"""Identities of detections as evidence, copies of messages, and errors of stamps."""

import math
from dataclasses import replace

import numpy as np
import pytest

from fgtrack.config.reading import read_config
from fgtrack.config.settings import Config
from fgtrack.core.types import Detection, DetectionList, Disposition
from fgtrack.estimation.filters.replay_bank import ReplayBank
from fgtrack.models.sensors import SensorModel
from fgtrack.noise.likelihood.fit import Problem
from fgtrack.noise.measurements import recorded_series
from fgtrack.noise.parameters import ConfigNoise
from fgtrack.noise.stamps import fitted_stamps, stamp_rates, with_stamps
from fgtrack.pipeline.public import replay
from fgtrack.tracking.inbox import Inbox
from fgtrack.tracking.objects import Evidence, Objects

S = 10**9
BASE = {
    "sensors": {
        "adsb": {
            "std": {"x_m": 10.0, "y_m": 10.0},
            "scan": False,
            "clutter_per_m2": 1e-12,
        }
    },
    "clock.node_hz": 1.0,
    "motion": {"kind": "cv", "std_per_s": {"velocity": 30.0}},
    "lifecycle": {"kind": "existence", "lifetime_s": 60.0, "birth_probability": 0.95},
    "filter": {"storage_s": 30.0, "frequency_hz": 10.0},
}


def report(t_s, x_m, y_m, identity, delay_s=0.0, sensor="adsb"):
    return DetectionList(
        sensor,
        round(t_s * S),
        round((t_s + delay_s) * S),
        (Detection(x_m, y_m, id=identity),),
        "map",
    )


def run(lists, **settings):
    return replay(
        sorted(lists, key=lambda each: each.receipt_ns),
        Config(),
        set={**BASE, **settings},
    )


def track_of(result, identity):
    rows = np.array(
        [item == identity for item in result.tables["detections"]["id"].tolist()]
    )
    return set(result.tables["updates"]["track_id"][rows].tolist())


def crossing(ids):
    """Two objects that meet for 20 s, 15 m apart, turn there and go apart."""
    lists = []
    for k in range(60):
        y_m = max(abs(k - 30.0) * 20.0 - 200.0, 7.5)
        x_m = 50.0 * k
        lists += [
            report(k, x_m, y_m, ids[0]),
            report(k + 0.5, x_m + 25.0, -y_m, ids[1]),
        ]
    return lists


def test_objects_that_touch_keep_their_tracks_by_their_identities():
    named = run(crossing(("AAA", "BBB")))
    assert len(track_of(named, "AAA")) == len(track_of(named, "BBB")) == 1
    assert track_of(named, "AAA") != track_of(named, "BBB")
    assert sorted(named.tables["objects"]["id"].tolist()) == ["AAA", "BBB"]
    assert named.meta["id_conflicts"] == {}


def test_a_known_identity_asks_for_no_track_but_its_own(monkeypatch):
    asked, every = [], ReplayBank.states_at
    monkeypatch.setattr(
        ReplayBank,
        "states_at",
        lambda self, stamp_ns: asked.append(stamp_ns) or every(self, stamp_ns),
    )
    lists = [
        report(k + 0.1 * n, 20.0 * k, 500.0 * (n + 1), f"AAA{n}")
        for k in range(10)
        for n in range(8)
    ]
    result = run(lists, estimator="ekf-replay")
    assert [track_of(result, f"AAA{n}") for n in range(8)] == [{n} for n in range(8)]
    assert max(asked) <= 1 * S  # while the first tick begins tracks


def test_a_detection_without_identity_joins_the_track_of_one():
    lists = [report(k, 20.0 * k, 5.0, "AAA" if k % 2 else None) for k in range(20)]
    result = run(lists)
    assert set(result.tables["updates"]["track_id"].tolist()) == {0}


def test_the_identity_moves_the_gate_by_its_log_likelihood_ratio():
    evidence = Evidence(None, np.array([1, 2, 0]), np.array([1, -1, 0]), 0.01)
    weight = 2.0 * math.log(99.0)
    pairs = [(row, column) for row in range(3) for column in range(3)]
    rows, columns = np.array(pairs).T
    expected = [-weight, weight, 0.0, weight, weight, 0.0, 0.0, 0.0, 0.0]
    assert evidence.nis(rows, columns).tolist() == pytest.approx(expected)
    assert evidence(rows, columns).tolist() == [value > 0.0 for value in expected]


@pytest.mark.parametrize(("wrong", "births"), [(1e-4, 2), (0.4, 1)])
def test_an_identity_that_is_often_wrong_does_not_part_what_lies_together(
    wrong, births
):
    lists = [report(k, 20.0 * k, 5.0, "BBB" if k == 10 else "AAA") for k in range(20)]
    result = run(lists, **{"sensors.adsb.wrong_id_probability": wrong})
    assert result.tables["updates"]["disposition"].tolist().count("birth") == births
    assert result.meta["id_conflicts"] == ({} if births == 2 else {"changed": 1})


def test_an_outlier_of_a_known_identity_starts_no_track_but_a_reused_identity_does():
    lists = [report(k, 20.0 * k, 5.0, "AAA") for k in range(20)]
    outlier = run([*lists, report(10.5, 9e3, 9e3, "AAA")])
    assert outlier.tables["updates"]["disposition"].tolist().count("gated") == 1
    assert set(outlier.tables["tracks"]["track_id"].tolist()) == {0}
    reused = run(
        [*lists, *(report(20 + k, 9e3 + 20.0 * k, 9e3, "AAA") for k in range(10))]
    )
    assert reused.tables["updates"]["disposition"].tolist()[20:24] == [
        "gated",
        "gated",
        "gated",
        "birth",
    ]
    assert reused.meta["id_conflicts"] == {"reused": 1}
    assert set(reused.tables["tracks"]["track_id"].tolist()) == {
        0
    }  # which is there from now on
    assert reused.tables["tracks"]["y_m"][-1] == pytest.approx(9e3, abs=30.0)


@pytest.mark.parametrize("estimator", ["ekf-replay", "smoother-banded", "smoother"])
def test_an_identity_that_returns_after_the_end_of_its_track_has_the_number_of_before(
    estimator,
):
    def passing(start_s, ids):
        return [
            report(start_s + k, 20.0 * k + 3e3 * row, 5.0, name)
            for k in range(10)
            for row, name in enumerate(ids)
        ]

    back = run(
        [*passing(0, ("AAA", "BBB", None)), *passing(600, ("CCC", "AAA", None))],
        estimator=estimator,
    )
    updates = back.tables["updates"]
    first, second = (
        updates["track_id"][
            np.array([d == "birth" for d in updates["disposition"]])
        ].reshape(2, 3)
    ).tolist()
    assert (first, second) == ([0, 1, 2], [3, 0, 4])
    assert back.meta["id_conflicts"] == {}
    times_s = (
        back.tables["tracks"]["now_ns"][
            np.array(back.tables["tracks"]["track_id"]) == 0
        ]
        / S
    )
    assert np.diff(times_s).max() > 100.0  # it is not published while it is away


def test_a_track_forgets_its_identity_with_its_end():
    objects = Objects()
    objects.learn(0, [Detection(0.0, 0.0, id="AAA")])
    assert objects.is_stray(Detection(9.0, 9.0, id="AAA"), 1)
    assert not objects.is_stray(Detection(9.0, 9.0, id="BBB"), 1)
    objects.forget(0)
    assert not objects.is_stray(Detection(9.0, 9.0, id="AAA"), 2)
    assert objects.evidence([Detection(9.0, 9.0, id="AAA")], [0], 1e-3) is None


def test_a_list_with_one_identity_many_times_counts_as_one_stray():
    objects, stray = Objects(), Detection(9.0, 9.0, id="AAA")
    objects.learn(0, [Detection(0.0, 0.0, id="AAA")])
    assert all(
        objects.is_stray(stray, stamp_ns) for stamp_ns in (1, 1, 1, 1, 1, 2, 2, 3, 3)
    )
    assert not objects.is_stray(stray, 4)
    objects.learn(0, [Detection(0.0, 0.0, id="AAA")])
    assert objects.is_stray(stray, 5)


def test_a_copy_moves_the_stamp_of_its_detection_alone():
    inbox = Inbox(
        {"adsb": SensorModel(std={"x_m": 10.0, "y_m": 10.0}, scan=False, copies_s=5.0)}
    )
    both = Detection(1.0, 2.0, id="AAA"), Detection(3.0, 4.0, id="BBB")
    inbox.put(DetectionList("adsb", 2 * S, 3 * S, both, "map"))
    inbox.put(DetectionList("adsb", S, 4 * S, both[1:], "map"))
    batches = inbox.collect()
    assert [(batch.stamp_ns, batch.indices, batch.last) for batch in batches] == [
        (S, (1,), False),
        (2 * S, (0,), True),
    ]


def test_what_several_receivers_heard_is_one_measurement_with_the_earliest_stamp():
    lists = []
    for k in range(10):
        heard = [(0.3, 0.4), (0.1, 0.5), (0.2, 0.6)]  # clock of the receiver, receipt
        lists += [
            DetectionList(
                "adsb",
                round((k + a) * S),
                round((k + b) * S),
                (Detection(20.0 * k + 1.0, 0.0, id="AAA"),),
                "map",
            )
            for a, b in heard
        ]
    result = run(lists, **{"sensors.adsb.copies_s": 5.0})
    updates = result.tables["updates"]
    assert updates["disposition"].tolist().count("duplicate") == 20
    assert len(updates["disposition"]) == len(lists)
    alone = run(
        [each for each in lists if each.stamp_ns % S == S // 10],
        **{"sensors.adsb.copies_s": 5.0},
    )
    assert result.tables["tracks"]["x_m"][-1] == pytest.approx(
        alone.tables["tracks"]["x_m"][-1], abs=1e-6
    )
    kept = run(lists)
    assert kept.tables["updates"]["disposition"].tolist().count("duplicate") == 0


def test_an_object_that_stands_is_not_a_copy_after_a_while():
    lists = [report(8.0 * k, 5.0, 5.0, "AAA") for k in range(5)]
    result = run(lists, **{"sensors.adsb.copies_s": 5.0})
    assert (
        Disposition.DUPLICATE.value
        not in result.tables["updates"]["disposition"].tolist()
    )


@pytest.mark.parametrize(
    "estimator", ["ekf-replay", "smoother-banded", "ekf-backward-forward"]
)
def test_the_error_of_a_stamp_is_part_of_the_innovation_along_the_motion(estimator):
    """v = 200 m/s, stamps err by 0.5 s: 100 m along x; the NIS of x and y together is 2 on average."""
    rng, v_mps = np.random.default_rng(3), 200.0
    errors = rng.normal(size=(400, 3)) * (0.5, 10.0, 10.0)
    lists = [
        report(k, v_mps * (k + a) + b, c, "AAA")
        for k, (a, b, c) in enumerate(errors.tolist())
    ]
    settings = {
        "motion": {"kind": "cv", "std_per_s": {"velocity": 1.0}},
        "birth.speed_std_mps": 250.0,
        "estimator": estimator,
    }
    nis = {}
    for std_s in (0.0, 0.5):
        updates = run(lists, **settings, **{"sensors.adsb.stamp_std_s": std_s}).tables[
            "updates"
        ]
        nis[std_s] = float(np.nanmean(updates["nis"][50:]))
        share = float(np.mean(updates["disposition"] != "gated"))
    assert share > 0.99
    assert nis[0.5] == pytest.approx(
        2.0, abs=0.35
    )  # 350 values of chi-square with 2: 4 standard deviations are 0.43
    assert not 1.5 < nis[0.0] < 2.6


def test_the_error_of_stamps_is_fitted(monkeypatch) -> None:
    """Of 200 stamps alone a standard deviation of 0.5 s is known to 0.5 s / sqrt(400) = 0.025 s."""
    rng, v_mps = np.random.default_rng(5), 200.0
    errors = rng.normal(size=(200, 3)) * (0.5, 10.0, 10.0)
    lists = [
        report(k, v_mps * (k + a) + b, c, "AAA")
        for k, (a, b, c) in enumerate(errors.tolist())
    ]
    settings = {
        **BASE,
        "motion": {"kind": "cv", "std_per_s": {"velocity": 1.0}},
        "birth.speed_std_mps": 250.0,
    }
    noise = ConfigNoise(
        read_config(None, {**settings, "sensors.adsb.stamp_std_s": 0.2})
    )
    problem = Problem(
        recorded_series(lists, noise.config, "", 4.0)[0], noise.space, noise.values
    )
    rates = stamp_rates(problem, noise.values)
    fit = fitted_stamps(problem, rates, noise.values, "adsb", 0.2)
    assert fit.std_s == pytest.approx(0.5, abs=0.1)
    assert 0.03 < fit.std_error < 0.1
    right = with_stamps(problem, rates, "adsb", 0.2, fit.std_s)
    assert fitted_stamps(
        right, rates, noise.values, "adsb", fit.std_s
    ).std_s == pytest.approx(fit.std_s, rel=0.1)
    assert noise.with_stamps("adsb", 0.5).stamp_stds == {"adsb": 0.5}
    # Of long series the first part is taken, whatever was mixed up after it.
    monkeypatch.setattr("fgtrack.noise.stamps._MAX_OBSERVATIONS", 150)
    mixed = replace(
        problem,
        series=[replace(each, mixed=frozenset((5, 170))) for each in problem.series],
    )
    assert fitted_stamps(
        mixed, rates, noise.values, "adsb", 0.2
    ).std_s == pytest.approx(0.5, abs=0.12)


def test_the_first_position_on_earth_is_no_empty_slot():
    first = Detection(0.0, 0.0, id="AAA")
    given = [
        DetectionList("adsb", k * S, k * S, (first,), "map", origin_deg=origin)
        for k, origin in enumerate([None, (41.0, 2.0)])
    ]
    assert run(given).tables["updates"]["disposition"].tolist() == ["invalid", "birth"]
