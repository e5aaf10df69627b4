"""Scenarios of one object whose measurements arrive late."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from fgtrack.core.errors import CallError, did_you_mean
from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import FloatArray, TrackState
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.birth import initial_state
from fgtrack.models.measurement import AT_ORIGIN, measurement_model
from fgtrack.models.motion import CTRV, CV, MotionModel
from fgtrack.ranking.crowds import CROWDS
from fgtrack.ranking.problem import Arrival, Problem, answer_of, queries_of
from fgtrack.sim.vehicles import draw_states

START_NS = 1_790_000_000 * NS_PER_S
DURATION_S = 4.0
NUM_TIMES = 5
"""Number of times in a run at which a method is asked."""
_US_PER_S = 1_000_000
_LINEAR = CV(velocity_density_m2ps3=2.0)
_START = Start(
    stamp_ns=START_NS,
    position_m=(30.0, 20.0),
    position_std_m=1.0,
    yaw_rad=0.4,
    yaw_std_rad=0.2,
    speed_mps=12.0,
    speed_std_mps=2.0,
    yaw_rate_radps=0.1,
)

Delays = Callable[[FloatArray, np.random.Generator], FloatArray]
"""Draws the delay in s of each stamp in s after the start, shape (n,)."""


@dataclass(frozen=True)
class Sensor:
    """A sensor of a scenario."""

    period_s: float
    std: Mapping[str, float]
    """Standard deviation of each measured component."""
    delays: Delays
    copies: float = 0.0
    """Probability that a measurement is delivered a second time."""
    first_s: float | None = None
    """Stamp of the first measurement after the start; None if it is drawn within a period."""
    clock_offset_s: float = 0.0
    """Time of the sensor's clock minus true time; it shifts the stamps."""


@dataclass(frozen=True)
class Scenario:
    """One object and its sensors."""

    about: str
    """Scenario in one line."""
    sensors: Mapping[str, Sensor]
    motion: MotionModel = _LINEAR

    def draw(self, name: str, rng: np.random.Generator) -> Problem:
        """Draw delays, the motion and the measurements; the problem is called `name`."""
        sent = [
            (START_NS + _whole_us(stamp_s), sensor, float(delay_s))
            for sensor, of in self.sensors.items()
            for stamp_s, delay_s in _sendings(of, rng)
        ]
        received = sorted(
            (stamp_ns + nanoseconds(delay_s), stamp_ns, sensor)
            for stamp_ns, sensor, first_s in sent
            for delay_s in _deliveries(first_s, self.sensors[sensor], rng)
        )
        queries = queries_of(
            [stamp_ns for _, stamp_ns, _ in received], START_NS, NUM_TIMES
        )
        asked_ns = {query.stamp_ns for query in queries}
        states = self._motion(asked_ns | {stamp_ns for stamp_ns, *_ in sent}, rng)
        measured = {
            (stamp_ns, sensor): self._measured(sensor, stamp_ns, states[stamp_ns], rng)
            for stamp_ns, sensor, _ in sorted(sent)
        }
        arrivals = tuple(
            Arrival(receipt_ns, sensor, measured[stamp_ns, sensor], stamp_ns)
            for receipt_ns, stamp_ns, sensor in received
        )
        truth = {
            stamp_ns: answer_of(self.motion, _certain(stamp_ns, states[stamp_ns])).mean
            for stamp_ns in asked_ns
        }
        return Problem(name, self.motion, _START, arrivals, queries, truth)

    def _motion(
        self, stamps_ns: Iterable[int], rng: np.random.Generator
    ) -> dict[int, FloatArray]:
        """Draw the states at the stamps; the first state is drawn from the prior."""
        mean, covariance = initial_state(self.motion, _START)
        x = mean + np.linalg.cholesky(covariance) @ rng.standard_normal(len(mean))
        states = {START_NS: x}
        before_ns = START_NS
        for stamp_ns in sorted(stamps_ns):
            if stamp_ns > before_ns:
                x = draw_states(self.motion, x, (stamp_ns - before_ns) / NS_PER_S, rng)
            states[stamp_ns] = x
            before_ns = stamp_ns
        return states

    def _measured(
        self, sensor: str, stamp_ns: int, x: FloatArray, rng: np.random.Generator
    ) -> Measurement:
        std = self.sensors[sensor].std
        model = measurement_model(tuple(std), self.motion)
        noise = np.array(list(std.values()))
        z = model.predict(x, AT_ORIGIN) + noise * rng.standard_normal(len(noise))
        offset_ns = nanoseconds(self.sensors[sensor].clock_offset_s)
        return Measurement(stamp_ns + offset_ns, model, z, np.diag(noise**2))


def _whole_us(duration_s: float) -> int:
    """Return a duration in ns, rounded to microseconds: clocks of other languages are not finer."""
    return round(duration_s * _US_PER_S) * 1000


def _certain(stamp_ns: int, x: FloatArray) -> TrackState:
    return TrackState(stamp_ns, x, np.zeros((len(x), len(x))))


def _sendings(
    sensor: Sensor, rng: np.random.Generator
) -> Iterator[tuple[float, float]]:
    """Yield stamp and delay of each measurement of a sensor in s, the stamps after the start."""
    drawn_s = rng.uniform(0.1, 1.0) * sensor.period_s
    first_s = drawn_s if sensor.first_s is None else sensor.first_s
    stamps_s = np.arange(first_s, DURATION_S, sensor.period_s)
    delays_s = sensor.delays(stamps_s, rng)
    yield from zip(stamps_s.tolist(), delays_s.tolist(), strict=True)


def _deliveries(
    delay_s: float, sensor: Sensor, rng: np.random.Generator
) -> Iterator[float]:
    """Yield the delay of a measurement, and the delay of its copy if there is a copy."""
    yield delay_s
    if rng.random() < sensor.copies:
        yield delay_s + rng.uniform(0.01, 0.5)


def _gamma(mean_s: float, least_s: float = 0.0) -> Delays:
    """Independent delays: `least_s` and a gamma distribution of shape 2 with the mean `mean_s`."""
    return lambda stamps_s, rng: least_s + rng.gamma(2.0, mean_s / 2.0, len(stamps_s))


def _in_time(stamps_s: FloatArray, rng: np.random.Generator) -> FloatArray:
    return np.zeros(len(stamps_s))


def _outages(stamps_s: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Delays of a link that is down for 0.8 s in every 2 s, and then delivers everything, newest first."""
    phase_s = (stamps_s + rng.uniform(0.0, 2.0)) % 2.0
    down = phase_s < 0.8
    held_s = 0.8 - phase_s + 1e-3 * phase_s
    return np.asarray(np.where(down, held_s, 0.01))


def _fixed(delay_s: float) -> Delays:
    return lambda stamps_s, rng: np.full(len(stamps_s), delay_s)


_XY = {"x_m": 0.3, "y_m": 0.3}
_COARSE = {"x_m": 1.0, "y_m": 1.0}
_RANGE = {"range_m": 0.4, "bearing_rad": 0.01}
_DOPPLER = {"range_m": 0.4, "bearing_rad": 0.01, "range_rate_mps": 0.2}
_LATE = {
    "lidar": Sensor(0.1, _XY, _gamma(0.15)),
    "radar": Sensor(0.1, _COARSE, _gamma(0.06)),
}


def _one_late(steps: int) -> Scenario:
    """Return a scenario whose single accurate position arrives after `steps` later positions."""
    return Scenario(
        f"an accurate position between two others arrives {steps} step{'s' if steps > 1 else ''} late",
        {
            "lidar": Sensor(DURATION_S, _XY, _fixed(steps * 0.1), first_s=2.05),
            "radar": Sensor(0.1, _COARSE, _in_time, first_s=0.1),
        },
    )


SCENARIOS: Mapping[str, Scenario] = {
    "linear": Scenario("positions of two late sensors, constant velocity", _LATE),
    **{f"late-by-{steps}": _one_late(steps) for steps in (1, 3, 10)},
    "bursts": Scenario(
        "a link that is down for 0.8 s in every 2 s",
        {
            "lidar": Sensor(0.1, _XY, _outages),
            "radar": Sensor(0.1, _COARSE, _gamma(0.06)),
        },
    ),
    "copies": Scenario(
        "a fifth of the positions is delivered twice",
        {
            "lidar": Sensor(0.1, _XY, _gamma(0.15), copies=0.2),
            "radar": Sensor(0.1, _COARSE, _gamma(0.06), copies=0.2),
        },
    ),
    "two-clocks": Scenario(
        "the clock of one sensor is 0.1 s ahead; the offset is unknown",
        {
            "lidar": Sensor(0.1, _XY, _gamma(0.15)),
            "radar": Sensor(0.1, _COARSE, _gamma(0.06, 0.1), clock_offset_s=0.1),
        },
    ),
    "range-bearing": Scenario(
        "range and bearing, constant velocity",
        {"radar": Sensor(0.1, _RANGE, _gamma(0.15))},
    ),
    "doppler": Scenario(
        "range, bearing and range rate, constant velocity",
        {"radar": Sensor(0.1, _DOPPLER, _gamma(0.15))},
    ),
    "ctrv": Scenario("positions, constant turn rate and velocity", _LATE, CTRV()),
}
"""Shipped scenarios of one object by name."""
NAMES = (*SCENARIOS, *CROWDS)
"""Names of all scenarios, those of several objects at the end."""


def draw(name: str, seed: int) -> Problem:
    """Draw the scenario `name` with a seed. Raises `CallError` for an unknown name."""
    if name not in SCENARIOS:
        raise CallError(
            f"scenario {name!r} is unknown{did_you_mean(name, NAMES)}: there are {', '.join(NAMES)}"
        )
    return SCENARIOS[name].draw(name, np.random.default_rng(seed))
