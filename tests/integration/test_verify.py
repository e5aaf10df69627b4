"""`fgtrack verify`: all promises are kept, and a broken estimator is found out."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fgtrack.cli.main import run
from fgtrack.cli.verify import _verdict
from fgtrack.core import geometry
from fgtrack.core.types import YAW_RATE, FloatArray, TrackState, X, Y
from fgtrack.estimation.base import Estimator, Measurement, Start, UpdateResult, UpdateStatus
from fgtrack.estimation.factor_graph import window
from fgtrack.estimation.factor_graph.backends.base import Change
from fgtrack.estimation.factor_graph.backends.batch import BatchBackend
from fgtrack.estimation.factor_graph.backends.incremental import IncrementalBackend
from fgtrack.estimation.factor_graph.rows import PriorOf
from fgtrack.estimation.marginalised_past import Prior
from fgtrack.estimation.registry import EXACT, Claims
from fgtrack.estimation.replay import ReplayEkf
from fgtrack.models import arc
from fgtrack.models.motion import CTRV, MotionModel
from fgtrack.models.sensors import SensorModel
from fgtrack.pipeline import nasty_streams, verify_streams
from fgtrack.pipeline import verify as pipeline
from fgtrack.pipeline.certificate import Certificate, Subject
from fgtrack.pipeline.verify import exact_estimators, one_estimator, verify

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
    """Verdicts on the promises of the broken estimator in one order."""
    found = [check for check in certificate.checks if check.estimator == "broken" and check.order == order]
    return [check.met for check in found if check.tolerance is not None]


@pytest.fixture(scope="module")
def certificate() -> Certificate:
    return verify(np.random.default_rng(1), SUBJECTS)


LINEAR = {"CV, paper's delays", "CV, stamps 1 us apart"}
WHOLE = {
    "CTRV, all in the window",
    "CTRV, from a turning ego",
    "CTRV, all that is nasty",
    "CTRV, Huber loss",
    "CTRA, all in the window",
}
LEAVING, SHORT, TOGETHER = "CTRV, lag 1 s", "CTRV, lag 0.3 s", "CTRV, 8 objects"
MILD = "CTRV, mildly nonlinear", "CTRV, mild, Huber loss"
ORDERS = {"time", "arrival", "random"}


def test_every_exact_estimator_keeps_its_promise_on_every_stream_in_every_order(certificate: Certificate) -> None:
    assert certificate.missed == ()
    assert {"ekf-replay", "smoother", "smoother-batch", "asd"} <= set(SUBJECTS)
    for name, subject in SUBJECTS.items():
        found = [c for c in certificate.checks if c.estimator == name and c.tolerance is not None]
        by_reference = {
            against: {(c.stream, c.order) for c in found if c.against == against}
            for against in ("dense joint", "innovations", "order of stamps", "SciPy", "SciPy, as it grew")
        }
        is_smoother = name in ("smoother", "smoother-batch", "smoother-banded")
        linear = LINEAR | ({"CV, lag 0.05 s"} if is_smoother else set())
        assert by_reference["dense joint"] == {(stream, order) for stream in linear for order in ORDERS}
        told = ORDERS if subject.claims.smooths or subject.claims.retrodicts else {"time"}
        assert by_reference["innovations"] == {each for each in by_reference["dense joint"] if each[1] in told}
        streams = (
            set() if subject.claims.nonlinear == "never" else WHOLE | {LEAVING} | ({SHORT} if is_smoother else set())
        )
        assert by_reference["order of stamps"] == {(stream, order) for stream in streams for order in ORDERS - {"time"}}
        judged = streams if subject.claims.solves else set()
        together = {(TOGETHER, order) for order in ("time", "random")} if name == "ekf-replay" else set()
        assert by_reference["SciPy"] == {(stream, order) for stream in judged for order in ORDERS} | together
        grows = subject.claims.nonlinear == "at convergence"
        assert by_reference["SciPy, as it grew"] == (by_reference["SciPy"] if grows else set())
        nearby = {(c.stream, c.order) for c in found if c.against == "SciPy, nearby"}
        assert nearby == (set() if subject.claims.solves else {(stream, "time") for stream in MILD})
    assert SUBJECTS["ekf-replay"].claims.solves == "ekf"
    assert SUBJECTS["smoother"].claims.solves == SUBJECTS["smoother-batch"].claims.solves == "least squares"
    assert [name for name, subject in SUBJECTS.items() if not subject.claims.solves] == ["asd"]


def test_the_models_and_the_dense_joint_are_judged_as_well(certificate: Certificate) -> None:
    models = {c.estimator for c in certificate.checks if c.stream == "models"}
    assert {"CTRV", "CTRA", "CV"} < models
    assert sum("measurements" in name for name in models) == 2
    assert {c.stream for c in certificate.checks if c.estimator == "(dense joint)"} == {
        "CV, paper's delays",
        "CV, lag 0.05 s",
    }


def test_the_tolerances_are_those_of_the_promise(certificate: Certificate) -> None:
    tolerances = {(c.stream, c.estimator, c.against): c.tolerance for c in certificate.checks}
    linear, leaving = "CV, paper's delays", LEAVING
    assert tolerances[linear, "ekf-replay", "dense joint"] == tolerances[linear, "smoother", "dense joint"] == 1e-9
    assert tolerances[linear, "smoother-batch", "dense joint"] == 1e-6
    assert tolerances["CV, lag 0.05 s", "smoother", "dense joint"] == 1e-9
    assert tolerances["CV, stamps 1 us apart", "ekf-replay", "dense joint"] == 1e-9
    assert tolerances["CV, stamps 1 us apart", "smoother", "dense joint"] < 1e-4
    assert tolerances[leaving, "ekf-replay", "order of stamps"] == 1e-9
    assert tolerances[leaving, "ekf-replay", "SciPy"] == 1e-7
    assert tolerances[leaving, "smoother", "SciPy"] == tolerances[leaving, "smoother", "order of stamps"] == 5e-3
    assert tolerances["CTRV, all in the window", "smoother-batch", "SciPy"] == 1e-5
    assert tolerances[SHORT, "smoother", "SciPy"] == tolerances[SHORT, "smoother", "SciPy, as it grew"] == 5e-2
    assert tolerances[leaving, "smoother (defaults)", "SciPy"] is None
    assert tolerances["CTRV, from a turning ego", "ukf-replay", "SciPy"] == 1e-7
    assert tolerances["CTRV, from a turning ego", "iekf-replay", "SciPy"] == 1e-2
    assert tolerances["CTRV, from a turning ego", "iplf-replay", "SciPy"] == 1e-2
    assert tolerances["CTRV, from a turning ego", "imm-replay", "SciPy"] == 1e-7


DRAWS = (
    verify_streams.linear,
    verify_streams.close,
    verify_streams.late,
    verify_streams.whole,
    verify_streams.observed,
    nasty_streams.gathered,
    verify_streams.robust,
    verify_streams.accelerated,
    verify_streams.leaving,
    verify_streams.short,
)


def test_the_streams_arrive_out_of_order_and_some_of_them_older_than_the_window(certificate: Certificate) -> None:
    rng = np.random.default_rng(1)
    for draw in DRAWS:
        stream = draw(rng)
        stamps_ns = np.array([m.stamp_ns for m in stream.measurements])
        late_s = {}
        for order, places in stream.orders.items():
            assert sorted(places) == list(range(len(stamps_ns)))
            arrived = stamps_ns[list(places)]
            late_s[order] = (np.maximum.accumulate(arrived) - arrived) / 1e9
        assert late_s["time"].max() == 0.0
        for order in ("arrival", "random"):
            assert (late_s[order] > 0.0).mean() > 0.2
        longest_s = max(late_s["arrival"].max(), late_s["random"].max())
        assert (longest_s >= stream.lag_s) == stream.late


def test_the_same_seed_gives_the_same_certificate() -> None:
    only = {"ekf-replay": SUBJECTS["ekf-replay"]}
    assert verify(np.random.default_rng(5), only) == verify(np.random.default_rng(5), only)


def test_an_estimator_that_ignores_late_data_is_found_out() -> None:
    certificate = verify(np.random.default_rng(1), subject(Careless))
    assert all(checks(certificate, "time"))
    assert not any(checks(certificate, "arrival"))
    assert not any(checks(certificate, "random"))


Break = Callable[[pytest.MonkeyPatch], None]
Draw = Callable[[np.random.Generator], verify_streams.Stream]


def noise(change: Callable[[FloatArray], None]) -> Break:
    """Break the process noise of one state."""

    def wrong(*arguments: Any) -> FloatArray:
        Q = arc.small_turn_noise(*arguments)
        change(Q)
        return Q

    return lambda patch: patch.setattr("fgtrack.models.motion.small_turn_noise", wrong)


def doubled(Q: FloatArray) -> None:
    Q *= 2.0


def one_entry(Q: FloatArray) -> None:
    Q[X, YAW_RATE] = Q[YAW_RATE, X] = 1.1 * Q[X, YAW_RATE]


def flow(change: Callable[[list[float], FloatArray, float], None]) -> Break:
    """Break where one state goes, or its Jacobian."""
    along = CTRV._along

    def wrong(self: CTRV, x: Sequence[float], t: float, moments: Sequence[complex]) -> tuple[list[float], FloatArray]:
        mean, F = along(self, x, t, moments)
        change(mean, F, t)
        return mean, F

    return lambda patch: patch.setattr(CTRV, "_along", wrong)


def drift(mean: list[float], F: FloatArray, t: float) -> None:
    mean[X] += t


def slope(mean: list[float], F: FloatArray, t: float) -> None:
    F[Y, YAW_RATE] *= 1.1


def no_arm(patch: pytest.MonkeyPatch) -> None:
    def wrong(x_m: float, y_m: float, yaw_rad: float, speed_mps: float, _: float, *arm: float) -> Any:
        return geometry.body_point(x_m, y_m, yaw_rad, speed_mps, 0.0, *arm)

    patch.setattr("fgtrack.tracking.preprocess.body_point", wrong)


def backend(change: Callable[[Change], Change]) -> Break:
    """Break what becomes of the graph."""

    def apply(patch: pytest.MonkeyPatch) -> None:
        for kind in (IncrementalBackend, BatchBackend):
            update = kind.update
            patch.setattr(kind, "update", lambda self, given, update=update: update(self, change(given)))

    return apply


def none_removed(change: Change) -> Change:
    return change._replace(removed=[]) if change.values else change


def one_missing(change: Change) -> Change:
    if not change.removed or not change.values:
        return change
    (key, mean), *_ = change.values.items()
    nothing = PriorOf(key, Prior(mean, 1e12 * np.eye(len(mean))))
    return change._replace(factors=[nothing, *change.factors[1:]])


def marginalised(times: float) -> Break:
    """Break the covariance of what has left, in the backend that is given it."""

    def change(given: Change) -> Change:
        gone = given.marginalised
        if gone is None:
            return given
        return given._replace(factors=[*given.factors, gone.prior], marginalised=gone)

    def weak(patch: pytest.MonkeyPatch) -> None:
        patch.setattr(window, "PriorOf", lambda key, prior: PriorOf(key, Prior(prior.mean, times * prior.covariance)))

    return backend(change) if times == 2.0 else weak


def scaled_noise(patch: pytest.MonkeyPatch) -> None:
    whole = SensorModel.noise
    patch.setattr(SensorModel, "noise", lambda self, names: 1.1 * whole(self, names))


BROKEN: dict[str, tuple[Break, Draw, str]] = {
    "process noise doubled": (noise(doubled), verify_streams.whole, "smoother"),
    "process noise of the EKF doubled": (noise(doubled), verify_streams.whole, "ekf-replay"),
    "one entry of the process noise": (noise(one_entry), verify_streams.whole, "smoother"),
    "a drift of 1 m/s": (flow(drift), verify_streams.whole, "smoother"),
    "Jacobian of the motion": (flow(slope), verify_streams.whole, "smoother"),
    "no arm": (no_arm, verify_streams.observed, "smoother"),
    "no arm, EKF": (no_arm, verify_streams.observed, "ekf-replay"),
    "split segment stays": (backend(none_removed), verify_streams.linear, "smoother"),
    "split segment stays, batch": (backend(none_removed), verify_streams.linear, "smoother-batch"),
    "one half of a split missing": (backend(one_missing), verify_streams.linear, "smoother"),
    "prior dropped": (marginalised(1e6), verify_streams.short, "smoother"),
    "prior doubled": (marginalised(2.0), verify_streams.short, "smoother-batch"),
    "measurement noise": (scaled_noise, verify_streams.whole, "smoother"),
}


@pytest.mark.parametrize("what", BROKEN)
def test_what_is_broken_is_found_out_on_one_stream_in_one_order(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    broken, draw, name = BROKEN[what]
    broken(monkeypatch)
    stream, subject = draw(np.random.default_rng(1)), SUBJECTS[name]
    if stream.motion.linear:
        checks = pipeline._against_dense_joint(stream, "random", stream.orders["random"], {name: subject})
    else:
        [(_, tolerance)] = [pair for pair in pipeline._NONLINEAR if pair[0] is draw]
        one_order = replace(stream, orders={"time": stream.orders["random"]})
        checks = pipeline._nonlinear(one_order, name, subject, tolerance)
    assert not all(check.met for check in checks if check.against.startswith(("SciPy", "dense joint")))


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
    assert lines[-1] == "all 54 tolerances met: estimates are right, in whatever order of arrival"
    assert any("CV, paper's delays" in line for line in lines)
    assert any("ekf-replay" in line and "1e-09" in line and "met" in line for line in lines)
    assert run(["verify", "-e", "ekf-replay", "--all"]) == 0
    every = capsys.readouterr().out.splitlines()
    assert sum("random" in line for line in every) > 5
    assert not any("random" in line for line in lines), "the nearest to its tolerance of each stream alone"
    shown = [check for check in certificate.checks if check.estimator == "smoother (defaults)"]
    assert {_verdict(check) for check in shown} == {"no promise"}


def test_the_command_fails_where_a_tolerance_is_missed(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, "exact_estimators", lambda: subject(Careless))
    assert run(["verify"]) == 1
    out, err = capsys.readouterr()
    assert out.splitlines()[-1] == "16 of 32 tolerances missed: estimates are wrong, or not in every order"
    assert err == ""
    monkeypatch.setattr(pipeline, "exact_estimators", lambda: subject(Refusing))
    assert run(["verify"]) == 1
    assert "not fused" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["drop", "reorder-buffer", "backward-forward"])
def test_any_estimator_can_be_verified_and_is_held_to_what_it_claims(name: str) -> None:
    subjects = one_estimator(name)
    [resolved] = subjects
    certificate = verify(np.random.default_rng(1), subjects)
    found = [c for c in certificate.checks if c.estimator == resolved]
    promised = {(c.stream, c.order) for c in found if c.tolerance is not None}
    assert promised == {(stream, "time") for stream in (*LINEAR, *(() if name == "reorder-buffer" else MILD))}
    assert certificate.missed == ()
    assert max(c.mean_sigma for c in found if c.order == "random") > 1e-3


def test_an_estimator_that_does_not_exist_cannot_be_verified(capsys: Capture) -> None:
    assert run(["verify", "-e", "drops"]) == 2
    assert "drops" in capsys.readouterr().err
