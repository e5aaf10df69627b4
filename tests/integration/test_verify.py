"""`fgtrack verify`: all promises are kept, and a broken estimator is found out."""

import json
from collections.abc import Mapping

import numpy as np
import pytest

from fgtrack.cli.main import run
from fgtrack.cli.verify import _verdict
from fgtrack.core.types import TrackState
from fgtrack.estimation.base import Estimator, Measurement, Start, UpdateResult, UpdateStatus
from fgtrack.estimation.registry import EXACT, Claims
from fgtrack.estimation.replay import ReplayEkf
from fgtrack.models.motion import MotionModel
from fgtrack.pipeline import verify as pipeline
from fgtrack.pipeline.verify import Certificate, Subject, exact_estimators, verify

SUBJECTS = exact_estimators()


class Careless:
    """A replaying EKF that does something else with what is late, and says that it was fused."""

    def __init__(self, inner: ReplayEkf) -> None:
        self._inner = inner

    @property
    def window_ns(self) -> tuple[int, int]:
        return self._inner.window_ns

    def advance(self, now_ns: int) -> None:
        self._inner.advance(now_ns)

    def state_at(self, stamp_ns: int) -> TrackState:
        return self._inner.state_at(stamp_ns)

    def update(self, measurement: Measurement) -> UpdateResult:
        newest_ns = self._inner.window_ns[1]
        if measurement.stamp_ns < newest_ns:
            return self.late(measurement, newest_ns)
        return self._inner.update(measurement)

    def late(self, measurement: Measurement, newest_ns: int) -> UpdateResult:
        return UpdateResult(UpdateStatus.OUT_OF_SEQUENCE, np.zeros(2), 0.0)


class Refusing(Careless):
    def late(self, measurement: Measurement, newest_ns: int) -> UpdateResult:
        return UpdateResult(UpdateStatus.TOO_OLD)


class NotANumber(Careless):
    def state_at(self, stamp_ns: int) -> TrackState:
        state = self._inner.state_at(stamp_ns)
        return TrackState(stamp_ns, np.full_like(state.mean, np.nan), state.covariance)


Kind = type[Careless]


def subject(kind: Kind) -> Mapping[str, Subject]:
    def start(motion: MotionModel, prior: Start, lag_s: float) -> Estimator:
        return kind(ReplayEkf(motion, prior, lag_s))

    return {"broken": Subject(start, Claims(exact=EXACT))}


def checks(certificate: Certificate, order: str) -> list[bool]:
    return [check.met for check in certificate.checks if check.estimator == "broken" and check.order == order]


@pytest.fixture(scope="module")
def certificate() -> Certificate:
    return verify(np.random.default_rng(1), SUBJECTS)


def test_every_exact_estimator_keeps_its_promise_on_every_stream_in_every_order(certificate: Certificate) -> None:
    assert certificate.missed == ()
    assert set(SUBJECTS) == {"ekf-replay", "smoother", "smoother-batch", "asd"}
    by_estimator = {name: [c for c in certificate.checks if c.estimator == name] for name in SUBJECTS}
    for name, found in by_estimator.items():
        linear = {(c.stream, c.order) for c in found if c.against == "dense joint"}
        beyond = {"CV, lag 0.05 s"} if name.startswith("smoother") else set()
        streams = {"CV, paper's delays", "CV, stamps 1 us apart"} | beyond
        assert linear == {(stream, order) for stream in streams for order in ("time", "arrival", "random")}
        nonlinear = {(c.stream, c.order) for c in found if c.against == "order of stamps"}
        streams = set() if name == "asd" else {"CTRV, all in the window", "CTRV, paper's delays"}
        assert nonlinear == {(stream, order) for stream in streams for order in ("arrival", "random")}


def test_the_tolerances_are_those_of_the_promise(certificate: Certificate) -> None:
    tolerances = {(c.stream, c.estimator): c.tolerance for c in certificate.checks}
    assert tolerances["CV, paper's delays", "ekf-replay"] == tolerances["CV, paper's delays", "smoother"] == 1e-9
    assert tolerances["CV, paper's delays", "smoother-batch"] == 1e-6
    assert tolerances["CV, lag 0.05 s", "smoother"] == 1e-9
    assert tolerances["CV, stamps 1 us apart", "ekf-replay"] == tolerances["CTRV, paper's delays", "ekf-replay"] == 1e-9
    assert tolerances["CV, stamps 1 us apart", "smoother"] < 1e-4
    assert tolerances["CTRV, paper's delays", "smoother"] == 1e-3
    assert tolerances["CTRV, paper's delays", "smoother (defaults)"] is None


def test_the_streams_arrive_out_of_order_and_some_of_them_older_than_the_window(certificate: Certificate) -> None:
    rng = np.random.default_rng(1)
    for make in (pipeline._linear, pipeline._close, pipeline._late, pipeline._whole, pipeline._turning):
        stream = make(rng)
        stamps_ns = np.array([m.stamp_ns for m in stream.measurements])
        late_s = {}
        for order, places in stream.orders.items():
            assert sorted(places) == list(range(len(stamps_ns)))
            arrived = stamps_ns[list(places)]
            late_s[order] = (np.maximum.accumulate(arrived) - arrived) / 1e9
        assert late_s["time"].max() == 0.0
        for order in ("arrival", "random"):
            assert (late_s[order] > 0.0).mean() > 0.2
            assert (late_s[order].max() >= stream.lag_s) == stream.late


def test_the_same_seed_gives_the_same_certificate() -> None:
    only = {"ekf-replay": SUBJECTS["ekf-replay"]}
    assert verify(np.random.default_rng(5), only) == verify(np.random.default_rng(5), only)


def test_an_estimator_that_ignores_late_data_is_found_out() -> None:
    certificate = verify(np.random.default_rng(1), subject(Careless))
    assert all(checks(certificate, "time"))
    assert not any(checks(certificate, "arrival"))
    assert not any(checks(certificate, "random"))


@pytest.mark.parametrize("kind", [Refusing, NotANumber])
def test_refusing_late_data_or_giving_no_number_keeps_no_promise(kind: Kind) -> None:
    certificate = verify(np.random.default_rng(1), subject(kind))
    assert not any(checks(certificate, "arrival"))
    json.dumps(certificate.as_dict(), allow_nan=False)


Capture = pytest.CaptureFixture[str]


def test_the_command_prints_json_and_nothing_else(capsys: Capture) -> None:
    only = {"ekf-replay": SUBJECTS["ekf-replay"]}
    assert run(["verify", "--json", "--estimator", "ekf-replay"]) == 0
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert err == ""
    assert found["met"] is True
    assert found == verify(np.random.default_rng(1), only).as_dict()
    assert all(one["mean_sigma"] < one["tolerance"] for one in found["checks"] if one["tolerance"] is not None)


def test_the_command_prints_a_table_and_a_closing_line(capsys: Capture, certificate: Certificate) -> None:
    assert run(["verify", "-e", "ekf-replay"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "all 10 tolerances met: estimates do not depend on the order of arrival"
    assert any(
        "CV, paper's delays" in line and "random" in line and "1e-09" in line and "met" in line for line in lines
    )
    shown = [check for check in certificate.checks if check.estimator == "smoother (defaults)"]
    assert {_verdict(check) for check in shown} == {"no promise"}


def test_the_command_fails_where_a_tolerance_is_missed(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, "exact_estimators", lambda: subject(Careless))
    assert run(["verify"]) == 1
    out, err = capsys.readouterr()
    assert out.splitlines()[-1] == "8 of 10 tolerances missed: estimates depend on the order of arrival"
    assert err == ""
    monkeypatch.setattr(pipeline, "exact_estimators", lambda: subject(Refusing))
    assert run(["verify"]) == 1
    assert "not fused" in capsys.readouterr().out


def test_only_an_exact_estimator_can_be_verified(capsys: Capture) -> None:
    assert run(["verify", "-e", "drop"]) == 2
    assert "estimator 'drop' does not claim to be exact: there are ekf-replay, smoother" in capsys.readouterr().err
