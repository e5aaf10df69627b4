"""A long drive through the smoothers of several vehicles: nothing fails, nothing is lost, nothing grows."""

import gc
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from fgtrack.core.time import NS_PER_S, nanoseconds, seconds
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement, Start, UpdateStatus
from fgtrack.estimation.failures import Failure
from fgtrack.estimation.smoothing.bank import SmootherBank
from fgtrack.estimation.smoothing.gtsam.incremental import IncrementalSolver
from fgtrack.estimation.smoothing.settings import SmootherSettings
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CTRV

START_NS = 1_790_000_000_000_000_000
VEHICLES = 4
PERIOD_S = 0.025
MOTION = CTRV()
SETTINGS = SmootherSettings()
SENSORS = (
    (measurement_model(("x_m", "y_m"), MOTION), np.array([0.3, 0.3])),
    (measurement_model(("x_m", "y_m", "speed_mps"), MOTION), np.array([1.0, 1.0, 0.2])),
)
STATM = Path("/proc/self/statm")


@dataclass
class Drive:
    """What a drive left behind."""

    statuses: Counter[UpdateStatus] = field(default_factory=Counter)
    failures: Counter[Failure] = field(default_factory=Counter)
    errors_m: list[float] = field(default_factory=list)
    num_final: int = 0
    resident: list[int] = field(default_factory=list)
    """Pages after each quarter."""


def truth(vehicle: int, stamp_ns: int) -> FloatArray:
    """On a circle of its own."""
    start = np.array([100.0 * vehicle, 0.0, vehicle, 60.0 + 3.0 * vehicle, 0.1 - 0.05 * vehicle])
    return MOTION.predict(start, seconds(stamp_ns - START_NS))


def schedule(num_detections: int, rng: np.random.Generator) -> list[tuple[int, int, int]]:
    """Receipt, stamp and vehicle of every detection, in the order of receipt.

    Of five stamps of a vehicle, one is 1 us after another, one in ten equals another; 40 % come late, 1 % of all so
    late that the window has gone, and a few that nothing is left of it.
    """
    count = num_detections // VEHICLES
    events = []
    for vehicle in range(VEHICLES):
        stamps_ns = START_NS + nanoseconds(PERIOD_S) * np.arange(1, count + 1)
        kind = rng.random(count)
        kind[0] = 1.0
        stamps_ns = np.where(kind < 0.2, np.roll(stamps_ns, 1) + 1_000, stamps_ns)
        stamps_ns = np.where((kind >= 0.2) & (kind < 0.3), np.roll(stamps_ns, 1), stamps_ns)
        delay_s = np.where(rng.random(count) < 0.4, rng.uniform(0.02, 0.9, count), 0.0)
        delay_s = np.where(rng.random(count) < 0.01, rng.uniform(1.0, 2.8, count), delay_s)
        delay_s = np.where(rng.random(count) < 0.003, rng.uniform(3.5, 5.0, count), delay_s)
        delay_s[0] = 0.0
        receipts_ns = stamps_ns + np.rint(delay_s * NS_PER_S).astype(np.int64)
        events += [(int(receipt), int(stamp), vehicle) for receipt, stamp in zip(receipts_ns, stamps_ns, strict=True)]
    return sorted(events)


def drive(num_detections: int, seed: int) -> Drive:
    rng, done = np.random.default_rng(seed), Drive()
    bank = SmootherBank(MOTION, SETTINGS, IncrementalSolver)
    events = schedule(num_detections, rng)
    last_ns = max(stamp_ns for _, stamp_ns, _ in events)
    quarters = {len(events) * k // 4 for k in (1, 2, 3, 4)}
    for number, (receipt_ns, stamp_ns, vehicle) in enumerate(events, start=1):
        bank.advance(receipt_ns)
        x = truth(vehicle, stamp_ns)
        model, std = SENSORS[rng.integers(len(SENSORS))]
        z = model.predict(x) + std * rng.standard_normal(len(std))
        if vehicle not in bank.track_ids:
            R = np.diag(std[:2] ** 2)
            bank.birth(
                vehicle,
                Start(
                    stamp_ns=stamp_ns,
                    position_m=z[:2],
                    position_covariance=R,
                    yaw_rad=x[2] + 0.1,
                    yaw_std_rad=0.3,
                    speed_mps=x[3] + 1.0,
                    speed_std_mps=3.0,
                    yaw_rate_std_radps=0.2,
                ),
            )
            continue
        [result] = bank.update(stamp_ns, [vehicle], [Measurement(stamp_ns, model, z, np.diag(std**2))])
        done.statuses[result.status] += 1
        if number % 20 == 0:
            done.num_final += sum(report.lag_s is None for report in bank.smoothed())
            seen = receipt_ns < last_ns  # afterwards only the latest of the late come in
            for track_id, state in zip(bank.track_ids, bank.present() if seen else [], strict=seen):
                done.errors_m.append(float(np.hypot(*(state.mean - truth(track_id, receipt_ns))[:2])))
        if number in quarters:
            gc.collect()
            done.resident.append(int(STATM.read_text().split()[1]) if STATM.exists() else 0)
    done.failures = bank.windows.failures.counts
    return done


def check(done: Drive, num_detections: int) -> None:
    assert sum(done.statuses.values()) == num_detections - VEHICLES
    assert done.statuses[UpdateStatus.FAILED] == 0
    assert not done.failures
    late = done.statuses[UpdateStatus.OUT_OF_SEQUENCE] + done.statuses[UpdateStatus.BEYOND_WINDOW]
    assert late > 0.35 * num_detections
    assert done.statuses[UpdateStatus.BEYOND_WINDOW] > 0.005 * num_detections
    assert done.statuses[UpdateStatus.TOO_OLD] > 0.001 * num_detections
    assert done.num_final > 0.6 * num_detections
    assert np.sqrt(np.mean(np.square(done.errors_m))) < 0.4
    assert max(done.errors_m) < 3.0


def test_a_thousand_detections_of_several_vehicles_are_all_accounted_for() -> None:
    check(drive(1_000, 1), 1_000)


@pytest.mark.slow
@pytest.mark.skipif(not STATM.exists(), reason="the system does not tell the resident memory")
def test_twenty_thousand_detections_need_no_more_memory_than_five_thousand() -> None:
    done = drive(20_000, 2)
    check(done, 20_000)
    first, *_, last = done.resident
    assert last < 1.01 * first
