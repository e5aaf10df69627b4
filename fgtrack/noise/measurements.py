"""Replay in memory that records the measurements of each track, with their noise split into parts."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from fgtrack.config.settings import Config
from fgtrack.core.geometry import rotation
from fgtrack.core.linalg import congruence
from fgtrack.core.types import FloatArray, Message
from fgtrack.estimation.base import (
    Measurement,
    Start,
    TrackBank,
    UpdateResult,
)
from fgtrack.estimation.failures import Failures
from fgtrack.models.sensors import SensorModel
from fgtrack.noise.likelihood.series import Observation, Series, positive_part
from fgtrack.pipeline.build import build_bank
from fgtrack.pipeline.replay import replay_in_memory
from fgtrack.runs import Run
from fgtrack.tracking.association import (
    Assignment,
    Association,
    AssociationProblem,
    GatedEuclidean,
    GatedMahalanobis,
)
from fgtrack.tracking.detections import PosedBatch
from fgtrack.tracking.ego.trajectory import EgoPose
from fgtrack.tracking.facing import SIGNED
from fgtrack.tracking.guarded_bank import GuardedBank
from fgtrack.tracking.inbox import Batch
from fgtrack.tracking.parts import TrackerParts
from fgtrack.tracking.preprocess import (
    Candidate,
    Preprocessed,
    Preprocessing,
)

_GATE_PROBABILITY = 0.9999


@dataclass(frozen=True, slots=True)
class BankCall:
    """Call of the track bank in a tick: a birth, or measurements of several tracks at one stamp."""

    now_ns: int
    """Time of the tick."""
    stamp_ns: int
    track_ids: Sequence[int]
    observations: Sequence[Observation] = ()
    """Fused observation of each track; empty for a birth."""
    start: Start | None = None
    """First state of a new track; None for measurements."""


def recorded_series(
    messages: Iterable[Message],
    config: Config,
    origin: str = "",
    gate_stds: float = 0.0,
) -> tuple[list[Series], Run]:
    """Replay the messages; return the series of all tracks and the run.

    A gate in metres is widened to `gate_stds` standard deviations of each detection's
    position. `origin` names the recording in the run.
    """
    bank, run = recorded_bank(messages, config, origin, gate_stds)
    motion = config.motion_model()
    method = config.initiation.method
    return [series.initiated(motion, method) for series in bank.series()], run


def recorded_bank(
    messages: Iterable[Message],
    config: Config,
    origin: str = "",
    gate_stds: float = 0.0,
) -> tuple["RecordingBank", Run]:
    """Replay the messages; return the bank with its recorded calls, and the run.

    The arguments are as in `recorded_series`.
    """
    recorder = MeasurementRecorder(config, gate_stds)
    run = replay_in_memory(messages, config, origin=origin, observed=recorder)
    return recorder.bank, run


class MeasurementRecorder:
    """Hook that puts a `RecordingBank` into the tracker of `config`; see `recorded_series`."""

    bank: "RecordingBank"

    def __init__(self, config: Config, gate_stds: float = 0.0) -> None:
        self._config = config
        self._gate_stds = gate_stds

    def __call__(self, parts: TrackerParts) -> TrackerParts:
        """Return the parts of the tracker with the recording bank, which stays available as `bank`."""
        preprocess = _RecordingPreprocess(parts.preprocess)
        association = parts.association
        make = partial(build_bank, self._config, parts.failures)
        self.bank = RecordingBank(make, parts.failures, preprocess)
        if self._gate_stds and isinstance(
            association, GatedEuclidean | GatedMahalanobis
        ):
            association = _WideGate(association, self._gate_stds)
        # Joint association is off: the fit needs the noise of single detections.
        joint = parts.joint and replace(parts.joint, joint_from=None)
        return replace(
            parts,
            preprocess=preprocess,
            bank=self.bank,
            association=association,
            joint=joint,
        )


@dataclass(frozen=True)
class _WideGate(Association):
    """Association whose gate is widened to `stds` standard deviations of each detection.

    The probability of a Mahalanobis gate is raised too.
    """

    association: GatedEuclidean | GatedMahalanobis
    stds: float

    @property
    def reads_yaws(self) -> bool:
        """See `Association.reads_yaws`."""
        return self.association.reads_yaws

    def assign(self, problem: AssociationProblem) -> Assignment:
        """See `Association.assign`."""
        candidates, states, apart, _, facings = problem
        stds_m = np.array(
            [self._stds_m(candidate, states.means) for candidate in candidates]
        )
        needed_m = self.stds * stds_m.reshape(len(candidates), len(states.means))
        if isinstance(self.association, GatedEuclidean):
            gates_m = np.maximum(self.association.gate_m, needed_m)
            return self.association.within(gates_m, candidates, states, apart, facings)
        limit_m = float(needed_m.max(initial=self.association.max_distance_m))
        probability = max(self.association.gate_probability, _GATE_PROBABILITY)
        opened = replace(
            self.association, max_distance_m=limit_m, gate_probability=probability
        )
        return opened.assign(problem)

    def _stds_m(self, candidate: Candidate, means: FloatArray) -> FloatArray:
        """Return the largest position standard deviation for each track position in `means`.

        A bearing alone has a standard deviation across the line of sight, which grows
        with the distance of the track.
        """
        if candidate.position_covariance is not None:
            return np.full(
                len(means),
                math.sqrt(np.linalg.eigvalsh(candidate.position_covariance)[-1]),
            )
        measurement = candidate.measurement
        k = measurement.model.components.index("bearing_rad")
        away_m = np.hypot(
            means[:, 0] - measurement.pose.x_m, means[:, 1] - measurement.pose.y_m
        )
        return np.asarray(away_m * math.sqrt(measurement.R[k, k]))


class _RecordingPreprocess:
    """Preprocessing that remembers the sensor and the noise source of each measurement.

    It remembers the newest batches only.
    """

    def __init__(self, original: Preprocessing) -> None:
        self._original = original
        # By the identity of the pose (one object per batch) and the content of the measurement:
        # sensor name, sensor model, and True if the covariance is reported by a detection.
        self._own: dict[tuple[int, bytes], tuple[str, SensorModel, bool]] = {}

    def posed(
        self, batch: Batch, sensor: SensorModel, ego: EgoPose | None
    ) -> PosedBatch:
        """See `Preprocess.posed`."""
        return self._original.posed(batch, sensor, ego)

    def together(self, batches: Sequence[PosedBatch]) -> list[Preprocessed]:
        """See `Preprocess.together`."""
        result = self._original.together(batches)
        self._own = {}
        for (batch, sensor, _, pose), (candidates, _) in zip(
            batches, result, strict=True
        ):
            for item in candidates:
                carried = [
                    batch.message.objects[index].covariance
                    for index in (item.leader, *item.merged)
                ]
                is_own = sensor.message_covariance and any(
                    each is not None for each in carried
                )
                self._own[id(pose), _content(item.measurement)] = (
                    batch.message.sensor,
                    sensor,
                    is_own,
                )
        return result

    def observation(self, measurement: Measurement) -> Observation:
        """Return a measurement of the newest batches as an observation, with its noise split into parts."""
        name, sensor, is_own = self._own[id(measurement.pose), _content(measurement)]
        return observation(name, sensor, measurement, is_own)


def _content(measurement: Measurement) -> bytes:
    """Return the components of `measurement` that stay equal when its facing is resolved.

    See `fgtrack.tracking.facing`.
    """
    names = measurement.model.components
    kept = [k for k, name in enumerate(names) if name not in ("yaw_rad", *SIGNED)]
    return measurement.z[kept].tobytes()


def observation(
    name: str, sensor: SensorModel, measurement: Measurement, own: bool
) -> Observation:
    """Return `measurement` of the sensor `name` as an observation, with its noise split into parts.

    The covariance is fixed if it is the detection's `own`, or if the sensor has
    time-correlated errors.
    """
    components = measurement.model.components
    measured = tuple(
        i for i, component in enumerate(components) if component in sensor.std
    )
    assumed = tuple(i for i in range(len(components)) if i not in measured)
    R = measurement.R[np.ix_(measured, measured)]
    T = np.eye(len(measured))
    if own or sensor.correlation is not None:
        return Observation(name, measurement, measured, assumed, T, R, np.zeros_like(R))
    if "x_m" in components:
        x_m, y_m = measurement.z[:2].tolist()
        pose = measurement.pose
        T[:2, :2] = rotation(math.atan2(y_m - pose.y_m, x_m - pose.x_m))
    modelled = congruence(
        T, np.diag([sensor.std[components[i]] ** 2 for i in measured])
    )
    return Observation(
        name,
        measurement,
        measured,
        assumed,
        T,
        np.zeros_like(R),
        positive_part(R - modelled),
    )


class RecordingBank(GuardedBank):
    """Track bank that records the first state and the fused measurements of every track."""

    def __init__(
        self,
        make: Callable[[], TrackBank],
        failures: Failures,
        preprocess: _RecordingPreprocess,
    ) -> None:
        super().__init__(make, failures)
        self._preprocess = preprocess
        self.calls: list[BankCall] = []
        """Recorded calls, in their order."""

    def series(self) -> list[Series]:
        """Return the fused measurements of each track in order of birth, sorted by stamp."""
        tracks: list[tuple[Start, list[Observation]]] = []
        # A track id may be born again, when a known identity returns.
        newest: dict[int, list[Observation]] = {}
        for item in self.calls:
            if item.start is not None:
                newest[item.track_ids[0]] = []
                tracks.append((item.start, newest[item.track_ids[0]]))
            for track_id, each in zip(item.track_ids, item.observations, strict=False):
                newest[track_id].append(each)
        return [
            Series(start, sorted(fused, key=lambda item: item.measurement.stamp_ns))
            for start, fused in tracks
        ]

    def update(
        self,
        stamp_ns: int,
        track_ids: Sequence[int],
        measurements: Sequence[Measurement],
    ) -> list[UpdateResult]:
        """See `TrackBank.update`."""
        results = super().update(stamp_ns, track_ids, measurements)
        fused = [
            row for row, result in enumerate(results) if result.innovation is not None
        ]
        observations = [
            self._preprocess.observation(measurements[row]) for row in fused
        ]
        self.calls.append(
            BankCall(
                self._now_ns, stamp_ns, [track_ids[row] for row in fused], observations
            )
        )
        return results

    def birth(self, track_id: int, prior: Start) -> None:
        """See `TrackBank.birth`."""
        super().birth(track_id, prior)
        self.calls.append(
            BankCall(self._now_ns, prior.stamp_ns, [track_id], start=prior)
        )
