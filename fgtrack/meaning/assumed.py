"""Assumes settings that the configuration leaves open, from the contents and the detections of a recording."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Set
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fgtrack.config.motion import NOISE_HZ, MotionConfig
from fgtrack.config.recorded import Recorded, RecordedSensor, recorded
from fgtrack.config.settings import ClockConfig, Config, FilterConfig
from fgtrack.config.yaml_file import SMALLEST, plain
from fgtrack.core.errors import DataError
from fgtrack.core.types import MEASURABLE, DetectionList, FloatArray, Message
from fgtrack.estimation.smoothing.settings import SmootherSettings
from fgtrack.inputs.source import InputSource
from fgtrack.meaning.assumption import Assumed, Assumption, departures, is_given
from fgtrack.meaning.components import uninformative
from fgtrack.meaning.corrected import corrected_message
from fgtrack.meaning.coverage import Coverage, coverages
from fgtrack.meaning.scattered_noise import Scatter, scattered_noise
from fgtrack.meaning.single_reports import SingleReports
from fgtrack.meaning.tracklets import points_of, speeds_mps
from fgtrack.models.sensors import Mount
from fgtrack.tracking.association import GatedMahalanobis
from fgtrack.tracking.birth import Birth
from fgtrack.tracking.lives.existence import ExistenceRules

__all__ = ["ASSUMED_STD", "assumed", "is_open", "source_of", "unmodelled_sensors"]

#: Standard deviations of a sensor without settings: a LiDAR or RADAR detector of cars.
ASSUMED_STD = {
    "x_m": 1.0,
    "y_m": 1.0,
    "yaw_rad": 0.1,
    "speed_mps": 1.0,
    "range_m": 1.0,
    "bearing_rad": 0.02,
    "range_rate_mps": 0.5,
}
_BOX_STD_M = 0.3
"""Standard deviation of the centre of a box: the translation error of LiDAR detectors is 0.25 to 0.5 m (nuScenes)."""
#: A track out of view continues for this number of periods of the slowest sensor, or of longest silences.
_LISTS_OUT_OF_VIEW = 2.5
_SILENCES = 1.5
#: Ticks for each report of an object, and lifetime of a track in longest usual silences of its object.
_TICKS_PER_REPORT = 4.0
_SILENCES_PER_LIFE = 4.0
#: Largest acceleration across the direction of travel of anything but aircraft: a race car's is 30 m/s^2.
_LARGEST_TURN_MPS2 = 30.0
#: Widest interval of a standard deviation that counts, as a share of it, and least share of the usual value.
_WIDEST = 0.3
_LEAST_OF_USUAL = 0.1
#: Fewest tracklets that show speeds, their quantile, and the least standard deviation of the speed of a new track.
_FEWEST_TRACKLETS = 10
_FAST = 0.95
_LEAST_SPEED_MPS = 15.0
_LEAST_CLUTTER = 0.05
"""Smallest assumed number of false detections in a list; fewer cannot be excluded."""
#: Share of time-correlated errors in the variance: smaller shares are not modelled, larger ones are limited.
_LEAST_SHARE = 0.5
_LARGEST_SHARE = 0.99
#: Correlation time: the detected point of a hull changes with its aspect, within tens of seconds.
_OFFSET_S = 30.0
_HULLS = 2.0 * math.sqrt(12.0)
"""Length of a long hull, divided by the standard deviation on each axis of the difference of two of its detections."""
_FIRST_MESSAGES = 20_000
"""Number of messages by which components without information are recognised."""
#: Longest delay that is assumed to be real.
_LONGEST_DELAY_S = 30.0
_LONGEST_S = 60.0
"""Longest window."""
#: Standard deviation per step at 100 Hz, which is a density of 225 m^2/s^3. The density of Singer's model (Estimating
#: optimal tracking filter performance for manned maneuvering targets, IEEE T-AES 1970) is 2 sigma^2 tau. An aircraft
#: that banks by at most 25 degrees accelerates by up to 4.6 m/s^2 for some 17 s; for uniform accelerations sigma is
#: 2.6 m/s^2. Ships manoeuvre less.
_MANOEUVRES = {"velocity": 150.0}
#: Reasons of assumptions.
RECORDED = "recorded"
USUAL = "usual for a LiDAR or RADAR detector of cars"
USUAL_BOX = "usual for boxes that a detector fits to cars"
_UNPLACED = (
    "no positions, and bearings from an unknown mount are less accurate than the tracks"
)
_TWO_LISTS = "two lists of the slowest sensor"

Coverages = Mapping[str, Coverage]
Rule = Callable[[Config, Coverages], Iterator[Assumption]]
"""Yields assumptions from the configuration and the sensors' coverages."""


def assumed(config: Config, source: InputSource) -> Assumed:
    """Return `config` with assumptions for all settings that it leaves open; given settings stay.

    The first source that specifies a setting counts: settings that `source` carries
    (origin of detections, track, mounts and fields of view); estimates from the
    detections (`coverages`); usual values (standard deviations, a field of view all
    around).
    """
    carried = recorded(source)
    result = Assumed(config).assuming(*_recorded(config, carried))
    if is_open(result.config):
        known = {
            **{name: item.mount for name, item in carried.sensors.items()},
            **{name: item.mount for name, item in result.config.sensors.items()},
        }
        mounts = {name: mount for name, mount in known.items() if mount is not None}
        covered = _covered(source, config, mounts)
        unmodelled = unmodelled_sensors(config, covered)
        rules: list[Rule] = [
            _report_ticks,
            _slow_revisits,
            _noise,
            _lists,
            lambda config, _: _recorded(config, carried),
        ]
        rules += [_births, _claim, _offsets, _unplaced, _windows]
        if not unmodelled:
            rules = []
            covered = {
                name: replace(item, persistence=None) for name, item in covered.items()
            }
        given = departures(config)
        for rule in (*rules, _views, _out_of_view):
            new = rule(result.config, covered)
            result = result.assuming(
                *(each for each in new if _is_free(each.path, given, unmodelled))
            )
    config = result.config
    sensors = {
        name: replace(sensor, field_of_view_rad=sensor.field_of_view_rad or math.tau)
        for name, sensor in config.sensors.items()
    }
    ego = replace(
        config.ego, detection_origin_x_m=config.ego.detection_origin_x_m or 0.0
    )
    return replace(result, config=replace(config, ego=ego, sensors=sensors))


def is_open(config: Config) -> bool:
    """True if `assumed` reads the messages: no sensors are given, or a sensor lacks noise or limits of view."""
    mapped = {*config.input.detections, *config.input.csv.detections}
    named = {*mapped, *config.sensors}.difference(config.ignore_sensors)
    return not named or any(
        name not in config.sensors
        or not config.sensors[name].std
        or not config.sensors[name].has_view_limits
        for name in named
    )


def source_of(messages: Callable[[], Iterable[Message]]) -> InputSource:
    """Input source of messages in memory."""
    return InputSource(Path(), "messages", lambda: iter(messages()))


def unmodelled_sensors(config: Config, names: Iterable[str]) -> frozenset[str]:
    """Return the sensors in `names` whose noise `config` leaves open."""
    return frozenset(
        name
        for name in names
        if name not in config.sensors or not config.sensors[name].std
    )


def _is_free(
    path: tuple[str, ...], given: Mapping[str, object], unmodelled: Set[str]
) -> bool:
    """True if the user has not given the setting at `path`.

    Of a sensor with given noise, only the mount and the limits of view are assumed.
    """
    if is_given(given, path) and path != ("ignore_sensors",):
        return False
    return (
        path[0] != "sensors"
        or path[1] in unmodelled
        or path[2] in ("mount", "field_of_view_rad", "view_range_m", "max_range_m")
        or path[2] == "max_range_behind_m"
    )


def _covered(
    source: InputSource, config: Config, mounts: Mapping[str, Mount]
) -> Coverages:
    """Return the coverage of all sensors in the recording or in `config.input`, without ignored sensors."""

    first: list[Message] = []

    def readable() -> Iterator[Message]:
        with suppress(DataError):  # the replay ends there too, and reports the error
            for message in source.messages():
                if not (
                    isinstance(message, DetectionList)
                    and message.sensor in config.ignore_sensors
                ):
                    read = corrected_message(message, config)
                    if len(first) < _FIRST_MESSAGES:
                        first.append(read)
                    yield read

    named = set(config.input.detections) | set(config.input.csv.detections)
    result = {name: Coverage() for name in named.difference(config.ignore_sensors)}
    result |= coverages(readable(), mounts)
    contrary = uninformative(first, mounts)
    points, _ = points_of(first, config.ego.detection_origin_m)
    unmodelled = unmodelled_sensors(config, result)
    for name, one in result.items():
        # Reports of an object decide on its velocities, where they are linked.
        linked = one.reports
        reasons = contrary.get(name, {})
        if linked is not None:
            untested = reasons.keys() - linked.std.keys()
            reasons = {key: reasons[key] for key in untested} | linked.uninformative
        scatter: Mapping[str, Scatter] = {}
        speed_mps = None
        if name in unmodelled and name in points and linked is None:
            scatter = scattered_noise(points[name])
            mount = mounts.get(name) or Mount()
            speed_mps = _fast_mps(speeds_mps(points[name], mount.yaw_rad))
        result[name] = replace(
            one,
            measured=one.measured - reasons.keys(),
            uninformative=reasons,
            scatter=scatter,
            speed_mps=speed_mps,
        )
    return dict(sorted(result.items()))


def _fast_mps(speeds: FloatArray) -> float | None:
    """Return the speed that nearly all tracklets stay below; None with few tracklets."""
    if len(speeds) < _FEWEST_TRACKLETS:
        return None
    return float(np.quantile(speeds, _FAST))


def _sensor(name: str, reason: str, **settings: object) -> Iterator[Assumption]:
    """Yield assumptions for the settings of a sensor that are not None."""
    for key, value in settings.items():
        if value is not None:
            yield Assumption(("sensors", name, key), value, reason)


def _recorded(config: Config, carried: Recorded) -> Iterator[Assumption]:
    """Yield the settings that the recording carries, where `config` leaves them open."""
    # Path of a section, the section of `config`, and the recorded section. Any: dataclasses.
    sections: list[tuple[tuple[str, ...], Any, Any]]
    sections = [
        (("ego",), config.ego, carried.ego),
        (("map",), config.map, carried.map),
    ]
    for name, sensor in config.sensors.items():
        sections.append(
            (("sensors", name), sensor, carried.sensors.get(name, RecordedSensor()))
        )
    for path, section, given in sections:
        for key, value in plain(given).items():
            if value is not None and getattr(section, key) is None:
                yield Assumption((*path, key), value, RECORDED)


def _slow_revisits(config: Config, covered: Coverages) -> Iterator[Assumption]:
    """Yield motion model, clock and windows for objects that every sensor measures too rarely for the defaults.

    The standard deviation of a heading after the time t without a measurement is sqrt(q
    t^3 / 3), with the density q of the yaw rate. Above 1 rad, a straight line with the
    noise `_MANOEUVRES` predicts better. It is also better for aircraft, which cannot turn
    as fast as the default model assumes. The windows then hold two measurements.
    """
    used = [item for item in covered.values() if item.num_lists]
    limit_s = math.cbrt(3.0 / (MotionConfig().std_per_s["yaw_rate"] ** 2 / NOISE_HZ))
    needed_s = min(map(_prediction_s, used), default=0.0)
    turn_mps2 = min(map(_turn_mps2, used), default=0.0)
    if needed_s <= limit_s and turn_mps2 <= _LARGEST_TURN_MPS2:
        return
    shortest_s = min(item.revisit_s or 0.0 for item in used)
    two_lists_s = float(math.ceil(2.0 * shortest_s))
    window_s = min(max(two_lists_s, _late_s(used)), _LONGEST_S)
    reason = (
        f"an object is measured every {shortest_s:.2g} s, so its heading must be predicted for {needed_s:.2g} s; "
        f"the default model does so for {limit_s:.2g} s only"
    )
    if needed_s <= limit_s:
        reason = f"the default model assumes turns with {turn_mps2:.2g} m/s2 at the speed of the objects"
    settings: dict[tuple[str, str], object] = {
        ("motion", "kind"): "cv",
        ("motion", "std_per_s"): _MANOEUVRES,
    }
    if needed_s > limit_s:
        settings |= {
            ("clock", "node_hz"): 1.0,
            ("filter", "storage_s"): window_s,
            ("smoother", "lag_s"): window_s,
        }
    for path, value in settings.items():
        if getattr(config, path[0]) == getattr(Config(), path[0]):
            yield Assumption(path, value, reason)


def _prediction_s(one: Coverage) -> float:
    """Return the time over which the heading of an object is predicted, with the age of its estimate; 0 if unknown."""
    age_s = 0.0 if one.reports is None else _heading_age_s(one.reports)
    return (one.revisit_s or 0.0) + age_s


def _turn_mps2(one: Coverage) -> float:
    """Return the acceleration of a turn that the default model assumes at the speed of single reports.

    0 for other sensors, and for reports that are exact enough to show a turn within two
    periods.
    """
    if one.reports is None or _heading_age_s(one.reports) <= one.reports.period_s:
        return 0.0
    return one.reports.speed_mps * MotionConfig().yaw_rate_std_radps


def _heading_age_s(reports: SingleReports) -> float:
    """Age of the best estimate of a heading from noisy positions.

    With positions of the standard deviation s, the period T and the speed v, the heading
    over the time t has the error s sqrt(12 T / t^3) / v. Turns add sqrt(q t^3 / 3). Both
    are equal at t^6 = 36 s^2 T / (v^2 q).
    """
    speed_mps = max(reports.speed_mps, 1.0)
    density = MotionConfig().std_per_s["yaw_rate"] ** 2 / NOISE_HZ
    std_m = max(reports.along.std, reports.across.std)
    sixth_power = 36.0 * std_m**2 * reports.period_s / (speed_mps**2 * density)
    return math.pow(sixth_power, 1.0 / 6.0)


def _report_ticks(config: Config, covered: Coverages) -> Iterator[Assumption]:
    """Yield the rate of ticks and the lifetime of tracks for objects that all sensors report one by one."""
    used = [one for one in covered.values() if one.num_lists]
    reports = [one.reports for one in used if one.reports is not None]
    if not used or len(reports) < len(used):
        return
    period_s = min(one.period_s for one in reports)
    reason = f"an object is reported every {period_s:.2g} s"
    default_hz = ClockConfig().node_hz or math.inf
    node_hz = min(max(float(round(_TICKS_PER_REPORT / period_s)), 1.0), default_hz)
    if config.clock == ClockConfig() and node_hz < default_hz:
        yield Assumption(("clock", "node_hz"), node_hz, reason)
    silence_s = min(one.silence_s for one in reports)
    lifetime_s = float(f"{_SILENCES_PER_LIFE * silence_s:.2g}")
    if config.lifecycle == ExistenceRules() and lifetime_s > ExistenceRules.lifetime_s:
        reason = f"an object is silent for up to {silence_s:.2g} s between its reports"
        yield Assumption(("lifecycle", "lifetime_s"), lifetime_s, reason)


def _noise(config: Config, covered: Coverages) -> Iterator[Assumption]:
    """Yield standard deviations of the sensors: from the scatter, from single reports, or usual ones."""
    cartesian = {"x_m", "y_m"}
    for name, item in covered.items():
        redundant = (
            {"range_m", "bearing_rad"} if cartesian <= item.measured else cartesian
        )
        components = item.measured - redundant or cartesian
        usual = ASSUMED_STD | (
            dict.fromkeys(cartesian, _BOX_STD_M) if item.boxes else {}
        )
        std = {
            component: usual[component]
            for component in MEASURABLE
            if component in components
        }
        reason = USUAL_BOX if item.boxes else USUAL
        growth: dict[str, float] = {}
        if _shows_noise(item):
            std, growth, shown = _of_scatter(std, item)
            unshown = [component for component in std if component not in shown]
            usual_words = f"{', '.join(unshown)}: {reason}" if unshown else ""
            reason = "; ".join(filter(None, [_scatter_words(shown), usual_words]))
        elif item.reports is not None:
            std, growth = _of_reports(std, item.reports)
            reason = (
                f"scatter of {item.reports.num_triples} triples of reports of an object, "
                f"every {item.reports.period_s:.2g} s; not less than {USUAL}"
            )
        left_out = [
            f"{component} is not used: {why}"
            for component, why in item.uninformative.items()
        ]
        yield from _sensor(
            name,
            "; ".join([reason, *left_out]),
            std=std,
            std_growth=growth or None,
        )


def _shows_noise(one: Coverage) -> bool:
    """True if the scatter of a sensor shows its noise.

    It does not where sensors disagree by more, because their errors are correlated in
    time. So are the errors of boxes, unless another sensor agrees with them.
    """
    is_compared = one.disagreement_m is not None
    return bool(one.scatter) and not _is_common(one) and (is_compared or not one.boxes)


def _of_scatter(
    usual: Mapping[str, float], one: Coverage
) -> tuple[dict[str, float], dict[str, float], dict[str, Scatter]]:
    """Return standard deviations, their growth with the range, and the scatter of the components that it shows.

    Half of the variance that the scatters of two sensors leave unexplained counts for
    each. Standard deviations are at least a tenth of the usual ones, because tracks
    have errors of the mounts, of the ego and of the motion, too.
    """
    shown = {
        name: each
        for name, each in one.scatter.items()
        if name in usual and each.half_width <= _WIDEST
    }
    std = dict(usual)
    growth: dict[str, float] = {}
    for name, each in shown.items():
        is_length = name in ("x_m", "y_m", "range_m")
        more = one.unexplained_m / math.sqrt(2.0) if is_length else 0.0
        least = _LEAST_OF_USUAL * usual[name]
        std[name] = float(f"{max(math.hypot(each.noise.std, more), least):.2g}")
        if each.noise.growth:
            growth[name] = float(f"{each.noise.growth:.2g}")
    return std, growth, shown


def _scatter_words(shown: Mapping[str, Scatter]) -> str:
    """Return the scatters and their 95 % intervals in words."""
    if not shown:
        return ""
    parts = [
        f"{name} +- {100.0 * each.half_width:.0f} %" for name, each in shown.items()
    ]
    count = max(each.num_triples for each in shown.values())
    return f"scatter of {count} triples of detections around straight lines, {', '.join(parts)}"


def _of_reports(
    usual: Mapping[str, float], reports: SingleReports
) -> tuple[dict[str, float], dict[str, float]]:
    """Return standard deviations of single reports, not less than `usual`, and their growth with the range."""
    measured = dict(reports.std)
    growth: dict[str, float] = {}
    if "x_m" in usual:
        along, across = reports.along, reports.across
        if along.growth == across.growth == 0.0:
            measured["x_m"] = measured["y_m"] = math.hypot(
                along.std, across.std
            ) / math.sqrt(2.0)
        else:
            measured |= {"x_m": along.std, "y_m": across.std}
            trends = {"x_m": along.growth, "y_m": across.growth}
            growth = {
                key: float(f"{value:.2g}") for key, value in trends.items() if value
            }
    std = {
        key: max(value, float(f"{measured.get(key, 0.0):.2g}"))
        for key, value in usual.items()
    }
    return std, growth


def _lists(config: Config, covered: Coverages) -> Iterator[Assumption]:
    """Yield kind of the lists, detection probability, clutter and score model of the sensors."""
    for name, one in covered.items():
        persistence = one.persistence
        if not one.scans:
            yield from _sensor(
                name, "its lists contain one object, and none is empty", scan=False
            )
        if one.scans and persistence is not None and one.area_m2:
            reason = (
                f"persistence of {len(persistence.lines)} detections "
                "that recur in three successive lists"
            )
            clutter_per_m2 = (
                max(persistence.clutter_per_list, _LEAST_CLUTTER) / one.area_m2
            )
            clutter_per_m2 = float(
                f"{max(clutter_per_m2, persistence.near_clutter_per_m2):.2g}"
            )
            score = persistence.score and {
                "even": float(f"{persistence.score.even:.3g}"),
                "scale": float(f"{persistence.score.scale:.3g}"),
            }
            probability = round(persistence.detection_probability, 2)
            yield from _sensor(
                name,
                reason,
                detection_probability=probability,
                clutter_per_m2=clutter_per_m2,
                score=score,
            )
        elif one.density_per_m2 < config.sensors[name].clutter_per_m2:
            density = max(float(f"{one.density_per_m2:.2g}"), SMALLEST)
            reason = "mean number of detections in a list, over their area"
            yield from _sensor(name, reason, clutter_per_m2=density)


def _births(config: Config, covered: Coverages) -> Iterator[Assumption]:
    """Yield the standard deviation of the speed of a new track, by the speeds of the objects of all sensors.

    The default excludes no airliner. With it, the first detections of a car are weak
    evidence, and its first velocity is as wrong as two positions make it.
    """
    used = [
        item
        for item in covered.values()
        if item.num_lists and not item.measured.isdisjoint(("x_m", "range_m"))
    ]
    speeds = [item.speed_mps for item in used if item.speed_mps is not None]
    if not speeds or len(speeds) < len(used) or config.birth != Birth():
        return
    std_mps = float(math.ceil(max(*speeds, _LEAST_SPEED_MPS)))
    if std_mps < Birth().speed_std_mps:
        reason = f"95 % of the tracklets are slower than {max(speeds):.2g} m/s"
        yield Assumption(("birth", "speed_std_mps"), std_mps, reason)


def _claim(config: Config, covered: Coverages) -> Iterator[Assumption]:
    """Yield rules for large hulls, if sensors disagree by more than usual errors.

    A track suppresses births within the length of a hull. Two detections, uniform over
    a hull of length l in any direction, differ by l / sqrt(12) on each axis. Sensors
    show the disagreement of typical hulls; a hull that is detected at both ends is
    twice as long. Positions without boxes may belong to anything, so a track is
    confirmed only after it has moved by three standard deviations: otherwise it may be
    a shore or a moored ship.
    """
    largest_m = max(
        (item.disagreement_m or 0.0 for item in covered.values() if _is_common(item)),
        default=0.0,
    )
    if largest_m <= ASSUMED_STD["x_m"]:
        return
    reason = f"sensors disagree by {largest_m:.2g} m on each axis, as on large hulls"
    if config.association == GatedMahalanobis():
        yield Assumption(
            ("association", "claim_m"), float(round(_HULLS * largest_m)), reason
        )
    if config.lifecycle == ExistenceRules() and not any(
        item.boxes for item in covered.values()
    ):
        travel_m = float(round(3.0 * largest_m / math.sqrt(2.0)))
        yield Assumption(("lifecycle", "min_travel_m"), travel_m, reason)


def _is_common(one: Coverage) -> bool:
    """True if a sensor disagrees with another one by more than the independent errors of both explain."""
    share = one.unexplained_m**2 / max((one.disagreement_m or 0.0) ** 2, 1e-12)
    return share >= _LEAST_SHARE


def _offsets(config: Config, covered: Coverages) -> Iterator[Assumption]:
    """Yield time-correlated errors of sensors that disagree by more than their independent errors explain.

    Each of two sensors has half of the variance of their difference d, beside its
    independent errors e: s^2 = e^2 + max(d^2 / 2 - e^2, 0).
    """
    for name, one in covered.items():
        std = config.sensors[name].std
        if one.disagreement_m is None or one.persistence is None or "x_m" not in std:
            continue
        if not _is_common(one):
            continue
        independent_m = max(std["x_m"], one.persistence.std_m)
        std_m = float(f"{one.disagreement_m / math.sqrt(2.0):.2g}")
        if (1.0 - _LEAST_SHARE) * std_m**2 >= independent_m**2:
            share = 1.0 - (independent_m / std_m) ** 2
            correlation = {
                "share": min(round(share, 2), _LARGEST_SHARE),
                "time_s": _OFFSET_S,
            }
            reason = (
                f"this sensor and another one disagree by {one.disagreement_m:.2g} m on each axis, "
                "as on large hulls"
            )
            yield from _sensor(
                name,
                reason,
                std={**std, "x_m": std_m, "y_m": std_m},
                correlation=correlation,
            )


def _unplaced(config: Config, covered: Coverages) -> Iterator[Assumption]:
    """Yield that sensors with bearings alone and an unknown mount are ignored, if other sensors measure positions."""
    unplaced = [
        name
        for name, item in config.sensors.items()
        if not item.gives_position and item.mount is None
    ]
    if unplaced and any(item.gives_position for item in config.sensors.values()):
        yield Assumption(
            ("ignore_sensors",), [*config.ignore_sensors, *unplaced], _UNPLACED
        )


def _windows(config: Config, covered: Coverages) -> Iterator[Assumption]:
    """Yield windows that hold two lists of the slowest sensor in use, and the delays of nearly all lists."""
    used = [item for name, item in covered.items() if name not in config.ignore_sensors]
    rates_hz = [item.object_hz for item in used if item.object_hz]
    two_lists_s = float(math.ceil(2.0 / min(rates_hz, default=math.inf)))
    late_s = _late_s(used)
    ring_s = config.smoother.ring_s
    needed_s = max(two_lists_s, late_s - ring_s)
    lag_s = min(needed_s, _LONGEST_S - ring_s)
    if (
        lag_s > config.smoother.lag_s
        and config.smoother == SmootherSettings()
        and config.filter == FilterConfig()
    ):
        words = f"detections that come up to {late_s:g} s late"
        words = words if needed_s > two_lists_s else _TWO_LISTS
        reason = (
            words
            if lag_s == needed_s
            else f"{words} take {needed_s:g} s, longer than the longest window"
        )
        yield Assumption(("smoother", "lag_s"), lag_s, reason)
        yield Assumption(("filter", "storage_s"), lag_s + ring_s, reason)


def _late_s(used: Iterable[Coverage]) -> float:
    """Return the delay that a window must hold, in whole seconds; longer delays than `_LONGEST_DELAY_S` are clock
    errors.
    """
    delays_s = (math.ceil(1.2 * item.delay_s) for item in used)
    return float(
        max((each for each in delays_s if each <= _LONGEST_DELAY_S), default=0)
    )


def _views(config: Config, covered: Coverages) -> Iterator[Assumption]:
    """Yield sector and range of sensors without a given field of view."""
    for name, sensor in config.sensors.items():
        if sensor.scan and not sensor.has_view_limits and name in covered:
            one = covered[name]
            rate = "" if one.rate_hz is None else f" at {one.rate_hz:.3g} Hz"
            usable_m = (
                None
                if sensor.score is not None or one.persistence is None
                else one.persistence.max_range_m
            )
            yield from _sensor(
                name,
                f"coverage of {one.num_detections} detections in {one.num_lists} lists{rate}",
                mount=plain(Mount(yaw_rad=one.axis_rad)) if one.axis_rad else None,
                field_of_view_rad=one.field_of_view_rad,
                view_range_m=one.range_m,
                max_range_m=None if usable_m is None else float(round(usable_m)),
            )


def _out_of_view(config: Config, covered: Coverages) -> Iterator[Assumption]:
    """Yield `lifecycle.out_of_view_s`, the time that a track out of view continues.

    With one position sensor it is half the sensor's period, so the track ends at the
    first list without it. Otherwise it is the largest of the default, 2.5 periods of
    the slowest sensor, and 1.5 times the longest silence of a position sensor.
    """
    if not any(sensor.scan for sensor in config.used_sensors.values()):
        return  # without scans there are no misses
    periods_s = {
        name: 1.0 / item.object_hz for name, item in covered.items() if item.object_hz
    }
    position_sensors = [
        name for name, item in config.used_sensors.items() if item.gives_position
    ]
    default_s = ExistenceRules.out_of_view_s
    if len(position_sensors) == 1 and position_sensors[0] in periods_s:
        longest_s = 0.5 * periods_s[position_sensors[0]]
        reason = "half the period of the only sensor with positions"
    else:
        slow_s = _LISTS_OUT_OF_VIEW * max(periods_s.values(), default=0.0)
        silent_s = _SILENCES * max(
            (covered[name].silence_s for name in position_sensors if name in covered),
            default=0.0,
        )
        longest_s = max(default_s, slow_s, silent_s)
        reason = (
            _TWO_LISTS
            if longest_s == slow_s
            else "longer than the longest silence of a sensor"
        )
    if (
        isinstance(config.lifecycle, ExistenceRules)
        and config.lifecycle.out_of_view_s == default_s != longest_s
    ):
        yield Assumption(
            ("lifecycle", "out_of_view_s"), float(f"{longest_s:.2g}"), reason
        )
