"""Every exact estimator on every nasty stream, in several orders of arrival."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.scripts import load

from fgtrack.core.types import TrackState
from fgtrack.estimation.base import Estimator
from fgtrack.pipeline.nasty_streams import NASTY, spinning
from fgtrack.pipeline.verify import exact_estimators

script = load("orders")

FILTERS = ("ekf-replay", "iekf-replay", "ukf-replay", "iplf-replay")
#: Where the default settings take one step per measurement, and one is not enough.
STRONG = ("standing", "outliers of 20 sd, no gate", "outliers, Huber", "outliers, Cauchy", "outliers, Tukey")


def judged(name: str, estimator: str, orders: int, seed: int = 1) -> None:
    row = script.measured(name, estimator, seed, orders)
    assert row.minima > 1 or row.converged < (1e-9 if estimator in FILTERS else script.SAME)
    assert not row.oracle > (1e-7 if estimator in FILTERS else script.SAME) or row.minima > 1
    if name not in STRONG:
        assert row.default_max < 0.15


@pytest.mark.parametrize("name", NASTY)
@pytest.mark.parametrize("estimator", ["ekf-replay", "smoother", "smoother-banded"])
def test_the_order_of_arrival_does_not_matter_on_a_nasty_stream(name: str, estimator: str) -> None:
    judged(name, estimator, 12 if estimator in FILTERS else 3)


@pytest.mark.slow
@pytest.mark.parametrize("estimator", exact_estimators())
@pytest.mark.parametrize("name", NASTY)
def test_it_does_not_in_two_dozen_orders_for_any_exact_estimator(name: str, estimator: str) -> None:
    if estimator in script.able(name):
        judged(name, estimator, 25, seed=2)


@pytest.mark.parametrize("estimator", ["smoother", "smoother-banded"])
@pytest.mark.parametrize("seed", range(1, 5))
def test_a_fast_turn_is_found_whatever_is_late_by_as_much_as_it_likes(estimator: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    stream, subject = spinning(rng), exact_estimators()[estimator]
    stamps_s = 1e-9 * np.array([one.stamp_ns for one in stream.measurements])
    newest = [stream.newest_ns]
    expected = script.states(script.fed(stream, subject, range(len(stamps_s))), newest)
    for _ in range(4):
        places = np.argsort(stamps_s + rng.uniform(0.0, 1.9, len(stamps_s))).tolist()
        found = script.states(script.fed(stream, replace(subject, options={}), places), newest)
        assert script.apart_from(found, expected, stream).mean_sigma < 0.15


def test_solutions_that_the_order_decides_between_are_told_as_several_minima() -> None:
    """Two positions that contradict each other, under a loss that descends again: whichever came first is believed."""
    stream = NASTY["outliers, Tukey"](np.random.default_rng(1))
    one, seen = stream.measurements[0], stream.sightings[0]
    off = 4.5 * np.sqrt(np.diag(one.R)) * (np.arange(len(one.z)) == 0)
    expected = one.model.predict(
        stream.motion.predict(stream.problem.start.mean, (one.stamp_ns - stream.prior.stamp_ns) / 1e9)
    )
    stream = replace(
        stream,
        prior=replace(stream.prior, position_std_m=100.0),
        measurements=tuple(replace(one, z=expected + sign * off) for sign in (1.0, -1.0)),
        sightings=tuple(replace(seen, z=expected + sign * off) for sign in (1.0, -1.0)),
    )
    for name in ("smoother", "smoother-banded"):
        subject = exact_estimators()[name]
        runs = [script.fed(stream, subject, places) for places in ([0, 1], [1, 0], [0, 1])]
        for run in runs:
            run.converge(100)
        found = script.solutions(stream, subject, runs)
        assert len(found) == 2
        assert script.apart_from(found[0], found[1], stream).mean_sigma > 5.0
        with pytest.raises(AssertionError, match="not converged"):
            script.solutions(stream, subject, [runs[0], Off(runs[0])])


class Off:
    """An estimator that is somewhere else."""

    def __init__(self, inner: Estimator) -> None:
        self._inner = inner

    def state_at(self, stamp_ns: int) -> TrackState:
        state = self._inner.state_at(stamp_ns)
        return TrackState(stamp_ns, state.mean + 0.3 * np.sqrt(np.diag(state.covariance)), state.covariance)


def test_the_script_writes_a_table_and_every_row(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(script, "NASTY", {name: NASTY[name] for name in ("two bearings alike", "CV, 1 ns apart")})
    script.main(tmp_path / "out", orders=2, seeds=1, jobs=1, only=["ekf-replay", "asd"])
    printed = capsys.readouterr().out
    assert (tmp_path / "out/orders.md").read_text() == printed
    assert printed.count("| ekf-replay |") == 2
    assert printed.count("| asd |") == 1
    rows = (tmp_path / "out/orders.csv").read_text().splitlines()
    assert len(rows) == 4
