"""What is wrong with the clocks of a recording: a constant offset per sensor, and whether it can be known at all."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import ClassVar

import numpy as np

from fgtrack.core.errors import CallError, DataError, did_you_mean
from fgtrack.core.time import nanoseconds, seconds
from fgtrack.core.types import DetectionList, EgoState, Message
from fgtrack.estimation.factor_graph.clock_calibration.offsets import OffsetSettings, OffsetSolution, solve_offsets
from fgtrack.estimation.factor_graph.clock_calibration.time_shift import ShiftableMeasurement
from fgtrack.io.run import Run
from fgtrack.models.sensors import SensorModel
from fgtrack.pipeline.assumed import assumed, source_of
from fgtrack.pipeline.clock import Delivered, corrected
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.ego_path import EgoPath
from fgtrack.pipeline.offset_measurements import Remeasure, measurements_by_track
from fgtrack.pipeline.replay import again, replay_in_memory
from fgtrack.sim.redelay import restamped

Track = Sequence[ShiftableMeasurement]
Replayed = Callable[[Iterable[Message], Config], tuple[Run, str | None]]
"""A function that replays messages, and says why they broke off: `replay_in_memory`, or one that remembers."""


@dataclass(frozen=True)
class OffsetRules:
    """Which tracks count, and when an offset is known."""

    solver: OffsetSettings = field(default_factory=OffsetSettings)
    max_std_s: float = 0.01
    """An offset is identifiable where its standard deviation is below this ..."""
    max_prior_share: float = 0.1
    """... and below this share of the prior's."""
    min_track_s: float = 2.0
    """Shorter tracks are left out."""
    min_detections: int = 10
    """Of a sensor on a track, for the track to be used for the sensor."""
    max_detections: int = 10_000
    """Tracks with the most detections come first; what exceeds this is left out, of the first one its end."""
    ego_cutoff_hz: float = 2.0
    """See `EgoPath`."""
    repeat_above_s: float = 0.005
    """Where an offset is larger, tracks are made a second time, with corrected stamps."""
    fit_noise: bool = False
    """Whether the standard deviations of each sensor are first scaled to the residuals of a part of the tracks."""
    probe_detections: int = 300
    """Of so many detections of a track are these residuals."""

    @property
    def needed_std_s(self) -> float:
        """Largest standard deviation of an identifiable offset."""
        return min(self.max_std_s, self.max_prior_share * self.solver.prior_std_s)

    @property
    def needed_information(self) -> float:
        """Information that the detections must give for that, in 1 / s^2, besides the prior."""
        return self.needed_std_s**-2 - self.solver.prior_std_s**-2


@dataclass(frozen=True)
class Bias:
    """A constant error of the positions of a sensor, detections minus truth; 0 in a direction without one."""

    EGO: ClassVar[str] = "ego"
    VEHICLE: ClassVar[str] = "vehicle"
    of: str
    """Whose directions are meant: those of the `ego`, or of the `vehicle` that is seen."""
    ahead_m: float
    left_m: float


@dataclass(frozen=True)
class SensorOffset:
    """One sensor: reported stamp = time at which it sensed + offset."""

    sensor: str
    offset_s: float | None
    """None where nothing could be estimated."""
    std_s: float | None
    num_detections: int
    """Used in the estimate."""
    identifiable: bool
    why: str
    """A line."""
    residual: float | None = None
    """RMS residual over the standard deviation used: `std_s` is as right as this is near 1."""
    spread_s: float | None = None
    """Standard deviation by how much stretches of 5 s disagree; errors that last make it larger than `std_s`."""
    dof: float | None = None
    """Degrees of freedom of `std_s`, where few stretches tell it."""
    bias: Bias | None = None
    """Of its positions against the truth; None where there is none, or no truth."""


@dataclass(frozen=True)
class OffsetReport:
    """The offsets of all sensors against the clock of one of them, which is taken for that of the ego."""

    reference: str
    sensors: tuple[SensorOffset, ...]
    num_tracks: int
    """Tracks used."""
    num_detections: int
    broken: str | None
    """Why the input broke off, where it did; what came before was used."""
    least_delays_s: Mapping[str, float] = field(default_factory=dict)
    """The shortest delay of each sensor: its stamps are not earlier than the truth by more than that, for nothing is
    received before it was sensed."""

    def as_dict(self) -> dict[str, object]:
        """Plain values for JSON."""
        return asdict(self)


def estimate_offsets(
    messages: Iterable[Message],
    config: Config,
    reference: str | None = None,
    rules: OffsetRules | None = None,
    replayed: Replayed = replay_in_memory,
) -> OffsetReport:
    """Estimate the clock offsets of the sensors in `messages`, from tracks that the tracker of `config` makes.

    Sensors are not refused for their delays here: a wrong stamp looks like one.

    Parameters
    ----------
    messages
        In receipt order. Where they end in a `DataError`, what came before is used.
    reference
        The sensor whose offset is 0; None takes the one with most detections on tracks.

    Raises
    ------
    CallError
        The reference is not in the input, or the configuration cannot be built.
    DataError
        There are no detections, fewer than five ego states, or a sensor has no model.
    """
    rules = rules or OffsetRules()
    heard: list[Delivered] = []
    repeated = again(messages, config)
    config = assumed(config, source_of(repeated)).config
    recorded = _recorded(repeated(), heard, config.sensors)
    config = unrefused(config)
    run, broken = replayed(recorded, config)
    raw = _lists(heard, config)
    sensors = [name for name in config.sensors if any(one.sensor == name for one in raw)]
    if not sensors:
        raise DataError("there are no detections of a sensor that the configuration names (sensors)")
    if reference is not None and reference not in sensors:
        hint = did_you_mean(reference, sensors)
        raise CallError(f"reference {reference!r} is no sensor of the input, which has {', '.join(sensors)}{hint}")
    path = ego_path_of(heard, raw, rules)
    remeasure = Remeasure(config, path)
    tracks = measurements_by_track(run, raw, raw, config.sensors, remeasure)
    reference = reference or max(sensors, key=_counts(tracks).__getitem__)
    used = _chosen(tracks, reference, rules)
    if rules.fit_noise and used:
        remeasure = Remeasure(_with_noise(config, used, reference, rules), path)
        used = _chosen(measurements_by_track(run, raw, raw, config.sensors, remeasure), reference, rules)
    solution = _solution(used, reference, config, rules, {})
    known_s = {} if solution is None else _known(solution, rules)
    if any(abs(offset_s) > rules.repeat_above_s for offset_s in known_s.values()):
        corrected = [_restamped(message, known_s) for message in heard]
        run, _ = replay_in_memory(corrected, config)
        used = _chosen(
            measurements_by_track(run, _lists(corrected, config), raw, config.sensors, remeasure), reference, rules
        )
        solution = _solution(used, reference, config, rules, known_s)
    counts = _counts(used)
    rows = tuple(_row(name, reference, counts[name], solution, len(sensors), rules) for name in sensors)
    return OffsetReport(reference, rows, len(used), counts.total(), broken, least_delays_s(raw))


def least_delays_s(lists: Iterable[DetectionList]) -> dict[str, float]:
    """Return the shortest delay of each sensor."""
    found: dict[str, float] = {}
    for one in lists:
        found[one.sensor] = min(found.get(one.sensor, math.inf), seconds(one.receipt_ns - one.stamp_ns))
    return found


def unrefused(config: Config) -> Config:
    """`config` for messages whose stamps it has corrected: it takes them as they are and refuses none for its delay."""
    sensors = {}
    for name, sensor in config.sensors.items():
        stamp_from = "message" if sensor.stamp_from == "receipt" else sensor.stamp_from
        sensors[name] = replace(sensor, max_delay_s=None, clock_offset_s=0.0, stamp_from=stamp_from)
    return replace(config, sensors=sensors)


def _with_noise(config: Config, used: Sequence[Track], reference: str, rules: OffsetRules) -> Config:
    """`config` with standard deviations that fit the residuals of the beginning of each track."""
    solver = replace(rules.solver, max_rounds=1)
    beginnings = [track[: rules.probe_detections] for track in used]
    probe = _chosen(beginnings, reference, replace(rules, max_detections=5 * rules.probe_detections))
    found = _solution(probe, reference, config, replace(rules, solver=solver), {})
    if found is None:
        return config
    sensors = dict(config.sensors)
    for name, residual in found.residuals.items():
        if residual > 0.0:
            std = {component: value * residual for component, value in sensors[name].std.items()}
            sensors[name] = replace(sensors[name], std=std)
    return replace(config, sensors=sensors)


def _recorded(
    messages: Iterable[Message], heard: list[Delivered], sensors: Mapping[str, SensorModel]
) -> Iterator[Message]:
    """The messages with stamps as `sensors` mend them; those that a tracker hears are kept in `heard` as well."""
    for message in messages:
        if isinstance(message, DetectionList):
            message = corrected(message, sensors)
        if isinstance(message, (EgoState, DetectionList)):
            heard.append(message)
        yield message


def _lists(heard: Iterable[Delivered], config: Config) -> list[DetectionList]:
    return [one for one in heard if isinstance(one, DetectionList) and one.sensor in config.sensors]


def ego_path_of(heard: Iterable[Delivered], raw: Iterable[DetectionList], rules: OffsetRules) -> EgoPath | None:
    """The path of the ego; None where it is not needed."""
    if all(one.frame == "map" for one in raw):
        return None
    return EgoPath((one for one in heard if isinstance(one, EgoState)), rules.ego_cutoff_hz)


def _counts(tracks: Iterable[Track]) -> Counter[str]:
    """Number of measurements by sensor."""
    return Counter(item.sensor for track in tracks for item in track)


def _chosen(tracks: Sequence[Track], reference: str, rules: OffsetRules) -> list[Track]:
    """Tracks that live long enough and were seen by the reference and another sensor, the longest ones first."""
    chosen: list[Track] = []
    total = 0
    for whole in sorted(tracks, key=len, reverse=True):
        track = whole[: rules.max_detections]
        seen = {name for name, count in _counts([track]).items() if count >= rules.min_detections}
        if reference not in seen or len(seen) == 1:
            continue
        if seconds(track[-1].stamp_ns - track[0].stamp_ns) < rules.min_track_s:
            continue
        total += len(track)
        if chosen and total > rules.max_detections:
            break
        chosen.append([item for item in track if item.sensor in seen])
    return chosen


def _solution(
    used: Sequence[Track], reference: str, config: Config, rules: OffsetRules, start_s: Mapping[str, float]
) -> OffsetSolution | None:
    """The offsets of all sensors of `used` but the reference; None where there are none."""
    if not used:
        return None
    free_s = {name: start_s.get(name, 0.0) for name in _counts(used) if name != reference}
    return solve_offsets(config.motion.model(), used, free_s, rules.solver)


def _known(solution: OffsetSolution, rules: OffsetRules) -> dict[str, float]:
    """Offsets that are good enough to correct stamps by."""
    limit_s = rules.max_prior_share * rules.solver.prior_std_s
    columns = solution.offsets_s.tolist(), np.sqrt(np.diag(solution.covariance)).tolist(), solution.converged.tolist()
    rows = zip(solution.sensors, *columns, strict=True)
    return {name: offset_s for name, offset_s, std_s, converged in rows if converged and std_s < limit_s}


def _restamped(message: Delivered, offsets_s: Mapping[str, float]) -> Delivered:
    """`message` with the stamps that a right clock would have given it."""
    if isinstance(message, EgoState) or message.sensor not in offsets_s:
        return message
    return restamped(message, message.stamp_ns - nanoseconds(offsets_s[message.sensor]))


def _row(
    name: str, reference: str, count: int, solution: OffsetSolution | None, num_sensors: int, rules: OffsetRules
) -> SensorOffset:
    residual = None if solution is None else solution.residuals.get(name)
    if num_sensors == 1:
        return SensorOffset(name, None, None, count, False, "the only modality: nothing to compare it with")
    if name == reference:
        why = "the reference: its clock is taken for that of the ego"
        return SensorOffset(name, 0.0, 0.0, count, False, why, residual)
    if solution is None or name not in solution.sensors:
        why = (
            f"no track of {rules.min_track_s:g} s has {rules.min_detections} detections of it and of {reference}: "
            "nothing to compare"
        )
        return SensorOffset(name, None, None, count, False, why)
    place = solution.sensors.index(name)
    speed = f"objects move {solution.speeds_mps[name]:.2g} m/s (rms) in its frame"
    if not solution.converged[place]:
        return SensorOffset(name, None, None, count, False, f"nothing holds the estimate: {speed}", residual)
    offset_s, std_s = float(solution.offsets_s[place]), float(np.sqrt(solution.covariance[place, place]))
    information = max(std_s**-2 - rules.solver.prior_std_s**-2, 0.0)
    why = f"information {information:.3g} /s2, {rules.needed_information:.3g} /s2 needed: {speed}"
    spread_s = float(solution.spread_s[place])
    known = std_s < rules.needed_std_s
    return SensorOffset(name, offset_s, std_s, count, known, why, residual, None if math.isnan(spread_s) else spread_s)
