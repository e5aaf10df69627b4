"""The certificate of exactness: the order of arrival does not matter, measured on simulated streams.

In a linear model every estimator is held to the dense joint Gaussian of what has arrived; in a nonlinear one to its
own answer in the order of the stamps.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import FloatArray, TrackState
from fgtrack.estimation.base import Estimator, Measurement, Start, UpdateStatus
from fgtrack.estimation.dense_joint import Difference, dense_joint, difference, rounding_bound
from fgtrack.estimation.registry import ESTIMATORS, EXACT, Claims, Factory, start_estimator
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CTRV, CV, MotionModel
from fgtrack.pipeline.config import PAPER_SENSORS
from fgtrack.sim.delays import LIDAR_DELAY, RADAR_DELAY

ORDER_TOLERANCE = 1e-9
#: At convergence, where nothing has left the window, and where what has left keeps its linearisation.
WHOLE_TOLERANCE, MARGINALISED_TOLERANCE = 1e-5, 1e-3
_RING_S = 10.0
_START_NS = NS_PER_S
_RADAR_PHASE_S = 0.023
_NOT_FUSED = (UpdateStatus.TOO_OLD, UpdateStatus.FAILED)
_CHECKPOINTS = 4
_ITERATIONS = 10

#: Thresholds at which a smoother follows every move, so that it converges to rounding.
_TINY = MappingProxyType({"yaw_rad": 1e-7, "speed_mps": 1e-7, "yaw_rate_radps": 1e-7, "accel_mps2": 1e-7})


@dataclass(frozen=True)
class Subject:
    """An estimator that claims to be exact."""

    factory: Factory
    claims: Claims
    options: Mapping[str, Any] = field(default_factory=dict)

    def start(self, stream: "_Stream") -> Estimator:
        """One for the object of `stream`."""
        name = getattr(self.factory, "__name__", "estimator")
        return start_estimator(name, self.factory, stream.motion, stream.prior, stream.lag_s, self.options)


@dataclass(frozen=True)
class Check:
    """One estimator on one stream in one order of arrival."""

    stream: str
    estimator: str
    order: str
    against: str
    mean_sigma: float
    """Largest difference of a mean, in standard deviations."""
    covariance: float
    """Largest difference of a covariance, relative to the standard deviations."""
    num_refused: int
    """Measurements that were not fused; each voids the check."""
    tolerance: float | None
    """What both differences must stay below; None where nothing is promised."""

    @property
    def met(self) -> bool:
        """Whether it keeps the promise."""
        if self.tolerance is None:
            return True
        return self.mean_sigma < self.tolerance and self.covariance < self.tolerance and not self.num_refused


@dataclass(frozen=True)
class Certificate:
    """All checks."""

    checks: tuple[Check, ...]

    @property
    def num_promises(self) -> int:
        """Checks with a tolerance."""
        return sum(check.tolerance is not None for check in self.checks)

    @property
    def missed(self) -> tuple[Check, ...]:
        """Checks that miss their tolerance."""
        return tuple(check for check in self.checks if not check.met)

    def as_dict(self) -> dict[str, Any]:
        """JSON values; a number that is not finite is null."""
        return {
            "met": not self.missed,
            "checks": [
                {
                    "stream": check.stream,
                    "estimator": check.estimator,
                    "order": check.order,
                    "against": check.against,
                    "mean_sigma": _finite(check.mean_sigma),
                    "covariance": _finite(check.covariance),
                    "num_refused": check.num_refused,
                    "tolerance": check.tolerance,
                    "met": check.met,
                }
                for check in self.checks
            ],
        }


@dataclass(frozen=True)
class _Stream:
    """Measurements in the order of their stamps, and the orders in which they arrive."""

    name: str
    motion: MotionModel
    prior: Start
    measurements: tuple[Measurement, ...]
    orders: Mapping[str, Sequence[int]]
    lag_s: float
    late: bool = False
    """Whether some arrive when they are older than the window."""

    @property
    def newest_ns(self) -> int:
        return self.measurements[-1].stamp_ns

    def probes_ns(self) -> list[int]:
        """Stamps of the past to look at: nodes and in between, inside the window and, where asked for, behind it."""
        reach_s = 3.0 * self.lag_s if self.late else 0.9 * self.lag_s
        past = [at for at in (m.stamp_ns for m in self.measurements) if at >= self.newest_ns - nanoseconds(reach_s)]
        return sorted({*past[:: max(len(past) // 5, 1)], (past[0] + self.newest_ns) // 2})


#: Options with which the smoothers are exact: a ring as long as the stream, and small thresholds.
_OPTIONS: Mapping[str, Mapping[str, Any]] = {
    "smoother": {"ring_s": _RING_S, "relinearise": _TINY},
    "smoother-batch": {"ring_s": _RING_S},
}


def exact_estimators() -> dict[str, Subject]:
    """The estimators that claim to be exact for any late measurements, plug-ins included, by name."""
    subjects = {
        name: Subject(factory, Claims.of(factory), _OPTIONS.get(name, {}))
        for name, factory in ESTIMATORS.loaded().items()
    }
    return {name: subject for name, subject in subjects.items() if subject.claims.exact == EXACT}


def verify(rng: np.random.Generator, subjects: Mapping[str, Subject]) -> Certificate:
    """Run every one of `subjects` on every stream, in every order of arrival."""
    checks: list[Check] = []
    for stream in (_linear(rng), _close(rng), _late(rng)):
        able = {name: subject for name, subject in subjects.items() if not stream.late or _reaches(subject, stream)}
        for order, places in stream.orders.items():
            checks += _against_dense_joint(stream, order, places, able)
    for stream, converged in ((_whole(rng), WHOLE_TOLERANCE), (_turning(rng), MARGINALISED_TOLERANCE)):
        for name, subject in subjects.items():
            if subject.claims.nonlinear != "never":
                tolerance = ORDER_TOLERANCE if subject.claims.nonlinear == "at once" else converged
                checks += _against_time_order(stream, name, subject, tolerance)
        if "smoother" in subjects:  # what the default thresholds cost: no promise, a number
            claims = replace(subjects["smoother"].claims, nonlinear="at once")
            configured = replace(subjects["smoother"], claims=claims, options={"ring_s": _RING_S})
            checks += _against_time_order(stream, "smoother (defaults)", configured, None)
    return Certificate(tuple(checks))


def _reaches(subject: Subject, stream: "_Stream") -> bool:
    """Whether the estimator fuses all that comes later than the length of its window."""
    estimator = subject.start(stream)
    for measurement in stream.measurements:
        estimator.update(measurement)
    return estimator.window_ns[0] <= stream.measurements[0].stamp_ns


def _against_dense_joint(
    stream: _Stream, order: str, places: Sequence[int], subjects: Mapping[str, Subject]
) -> list[Check]:
    """All of `subjects` on the same stream: at some moments the present, at the end the past as well."""
    motion, prior = stream.motion, stream.prior
    running = {name: subject.start(stream) for name, subject in subjects.items()}
    largest = dict.fromkeys(subjects, Difference(0.0, 0.0))
    refused = dict.fromkeys(subjects, 0)
    arrived: list[Measurement] = []
    moments = {len(places) * (k + 1) // _CHECKPOINTS for k in range(_CHECKPOINTS)}
    for place in places:
        measurement = stream.measurements[place]
        arrived.append(measurement)
        for name, estimator in running.items():
            refused[name] += estimator.update(measurement).status in _NOT_FUSED
        if len(arrived) in moments:
            newest_ns = max(m.stamp_ns for m in arrived)
            now = [newest_ns, newest_ns + NS_PER_S // 10]
            joint = dense_joint(motion, prior, arrived, now)
            for name, estimator in running.items():
                largest[name] = _largest([largest[name], *_differences(estimator, joint)])
    smoothed = dense_joint(motion, prior, arrived, stream.probes_ns())
    for name, estimator in running.items():
        if subjects[name].claims.smooths:
            largest[name] = _largest([largest[name], *_differences(estimator, smoothed)])
    stamps_ns = [prior.stamp_ns, *(m.stamp_ns for m in stream.measurements)]
    tolerances = {
        name: max(subject.claims.tolerance, subject.claims.rounding * rounding_bound(motion, stamps_ns))
        for name, subject in subjects.items()
    }
    return [
        Check(stream.name, name, order, "dense joint", *largest[name], refused[name], tolerances[name])
        for name in subjects
    ]


def _against_time_order(stream: _Stream, name: str, subject: Subject, tolerance: float | None) -> list[Check]:
    expected, _ = _states(stream, subject, stream.orders["time"])
    checks = []
    for order, places in stream.orders.items():
        if order == "time":
            continue
        found, num_refused = _states(stream, subject, places)
        apart = _largest(difference(found[at], state) for at, state in expected.items())
        checks.append(Check(stream.name, name, order, "order of stamps", *apart, num_refused, tolerance))
    return checks


def _states(stream: _Stream, subject: Subject, places: Iterable[int]) -> tuple[dict[int, TrackState], int]:
    """States of the present and the past after the whole stream, and how many measurements were refused."""
    estimator = subject.start(stream)
    num_refused = 0
    for place in places:
        num_refused += estimator.update(stream.measurements[place]).status in _NOT_FUSED
    if subject.claims.nonlinear == "at convergence":
        estimator.converge(_ITERATIONS)  # type: ignore[attr-defined]  # the claim says that it has it
    stamps_ns = [*stream.probes_ns(), stream.newest_ns, stream.newest_ns + NS_PER_S // 10]
    return {at: estimator.state_at(at) for at in stamps_ns}, num_refused


def _differences(estimator: Estimator, expected: Mapping[int, TrackState]) -> list[Difference]:
    return [difference(estimator.state_at(at), state) for at, state in expected.items()]


def _largest(differences: Iterable[Difference]) -> Difference:
    """The largest of each; a NaN wins."""
    means, covariances = np.array(list(differences)).T
    return Difference(float(means.max()), float(covariances.max()))


# --- the streams


def _linear(rng: np.random.Generator) -> _Stream:
    """Positions of the paper's LiDAR and RADAR in a linear model, with the paper's delays."""
    return _stream(rng, "CV, paper's delays", CV(), _paper_stamps(1.5), lag_s=1.0, reach_s=0.95)


def _close(rng: np.random.Generator) -> _Stream:
    """The same with stamps of the two sensors that are equal, or 1 us or 1 ms apart."""
    stamps_s, sensors = _paper_stamps(0.5)
    gaps_s = np.resize([0.0, 1e-6, 1e-3, _RADAR_PHASE_S], len(stamps_s) // 2)
    stamps_s = np.where(sensors == "radar", stamps_s - _RADAR_PHASE_S + np.repeat(gaps_s, 2), stamps_s)
    return _stream(rng, "CV, stamps 1 us apart", CV(), (stamps_s, sensors), lag_s=1.5, reach_s=1.4)


def _late(rng: np.random.Generator) -> _Stream:
    """A window shorter than the delays: most of it arrives when it is older than the window."""
    return _stream(rng, "CV, lag 0.05 s", CV(), _paper_stamps(1.5), lag_s=0.05, reach_s=0.5, late=True)


def _whole(rng: np.random.Generator) -> _Stream:
    """A car at 65 m/s in a bend, the RADAR with its speed; shorter than the window."""
    return _stream(rng, "CTRV, all in the window", CTRV(), _paper_stamps(1.0), lag_s=2.0, reach_s=1.9)


def _turning(rng: np.random.Generator) -> _Stream:
    """The same, longer than the window."""
    return _stream(rng, "CTRV, paper's delays", CTRV(), _paper_stamps(2.0), lag_s=1.5, reach_s=0.5)


def _paper_stamps(duration_s: float) -> tuple[FloatArray, npt.NDArray[np.str_]]:
    """Stamps of LiDAR and RADAR at 20 Hz each, and which is which."""
    rounds = 0.05 * np.arange(1, round(20 * duration_s) + 1)
    stamps_s = np.stack([rounds, rounds + _RADAR_PHASE_S], axis=-1).ravel()
    return stamps_s, np.tile(["lidar_cluster", "radar"], len(rounds))


def _stream(
    rng: np.random.Generator,
    name: str,
    motion: MotionModel,
    plan: tuple[FloatArray, npt.NDArray[np.str_]],
    lag_s: float,
    reach_s: float,
    late: bool = False,
) -> _Stream:
    """Truth with the motion model's own noise, measured as `plan` says; in the random order up to `reach_s` late."""
    stamps_s, sensors = plan
    prior = Start(
        stamp_ns=_START_NS,
        position_m=(20.0, -5.0),
        yaw_rad=0.6,
        yaw_std_rad=0.35,
        speed_mps=65.0,
        speed_std_mps=3.0,
        yaw_rate_radps=0.1,
        yaw_rate_std_radps=0.1,
    )
    x = motion.from_kinematic(np.array([20.0, -5.0, 0.6, 65.0, 0.1, 0.0]), np.zeros((6, 6)))[0]
    measurements, last_s = [], 0.0
    for stamp_s, sensor in zip(stamps_s.tolist(), sensors.tolist(), strict=True):
        if stamp_s > last_s:
            Q = motion.process_noise(x, stamp_s - last_s)
            x = motion.predict(x, stamp_s - last_s) + np.linalg.cholesky(Q) @ rng.standard_normal(motion.dim)
            last_s = stamp_s
        measurements.append(_measured(rng, motion, x, _START_NS + nanoseconds(stamp_s), sensor))
    delays_s = np.where(sensors == "radar", RADAR_DELAY.draw(rng, stamps_s), LIDAR_DELAY.draw(rng, stamps_s))
    random_s = rng.uniform(0.0, reach_s, len(stamps_s))
    orders = {
        "time": range(len(measurements)),
        "arrival": np.argsort(stamps_s + delays_s, kind="stable").tolist(),
        "random": np.argsort(stamps_s + random_s, kind="stable").tolist(),
    }
    return _Stream(name, motion, prior, tuple(measurements), orders, lag_s, late)


def _measured(rng: np.random.Generator, motion: MotionModel, x: FloatArray, stamp_ns: int, sensor: str) -> Measurement:
    """What the paper's `sensor` measures of `x`; in a linear model its position only."""
    noise = PAPER_SENSORS[sensor]
    names = ("x_m", "y_m") if motion.linear else noise.components
    R = noise.noise(names)
    model = measurement_model(names, motion)
    return Measurement(stamp_ns, model, model.predict(x) + np.linalg.cholesky(R) @ rng.standard_normal(len(names)), R)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
