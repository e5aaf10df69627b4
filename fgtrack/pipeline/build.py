"""Builds a tracker and its parts from a configuration."""

import math
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np

from fgtrack.config.motion import NOISE_HZ
from fgtrack.config.settings import SMOOTHERS, Config, Defect, MapConfig
from fgtrack.core.diagnostic import EGO
from fgtrack.core.errors import CallError
from fgtrack.core.time import nanoseconds, period_ns, seconds
from fgtrack.estimation.base import Estimator, Start, TrackBank
from fgtrack.estimation.failures import Failures
from fgtrack.estimation.filters.propagation import ExactPropagator
from fgtrack.estimation.filters.track_initiation import initiated
from fgtrack.estimation.object_bank import ObjectBank, SingleObject
from fgtrack.estimation.registry import estimator_bank
from fgtrack.karle2023.backward_forward import BackwardForwardBank
from fgtrack.karle2023.euler import EulerCtrv
from fgtrack.karle2023.filter_defects import PublishedStorage, SaturatedEulerCtrv
from fgtrack.karle2023.road_map import PublishedMap
from fgtrack.karle2023.tracker_parts import (
    PublishedEgo,
    PublishedLifecycle,
    PublishedTracker,
    SlotInbox,
)
from fgtrack.models.correlated_errors import with_correlated_errors
from fgtrack.models.oval import OVAL, make_oval, make_pit_lane
from fgtrack.models.road import Road
from fgtrack.models.track_map import TrackMap
from fgtrack.tracking.association import GatedMahalanobis, Hypotheses
from fgtrack.tracking.decided_tracker import DecidedTracker
from fgtrack.tracking.decisions.entries import decision_motion
from fgtrack.tracking.decisions.history import Decisions
from fgtrack.tracking.decisions.lives import DecidedLives
from fgtrack.tracking.decisions.rules import Rules
from fgtrack.tracking.decisions.second_returns import Returns
from fgtrack.tracking.decisions.unseen import BirthPrior
from fgtrack.tracking.ego.growth import EgoGrowth
from fgtrack.tracking.ego.trajectory import EgoStd, EgoTrajectory
from fgtrack.tracking.ego.waiting import PoseWait
from fgtrack.tracking.facing import Facing
from fgtrack.tracking.guarded_bank import GuardedBank
from fgtrack.tracking.inbox import Inbox
from fgtrack.tracking.lives.counters import CountingLifecycle
from fgtrack.tracking.lives.existence import (
    ExistenceLifecycle,
    ExistenceRules,
    Lifecycle,
)
from fgtrack.tracking.lives.latency import Views, Watermarks
from fgtrack.tracking.objects import Objects
from fgtrack.tracking.parts import TrackerParts
from fgtrack.tracking.preprocess import Preprocess
from fgtrack.tracking.stamped_facing import StampedFacing
from fgtrack.tracking.stamped_objects import StampedObjects
from fgtrack.tracking.tracker import MultiObjectTracker

#: Stored ego states of the published implementation.
_EGO_STORAGE_TICKS = 350
_EGO_MEMORY_S = 5.0


def build_tracker(
    config: Config, observed: Callable[[TrackerParts], TrackerParts] | None = None
) -> MultiObjectTracker:
    """Return the tracker that `config` describes; `observed` may replace its parts."""
    for name, sensor in config.used_sensors.items():
        if not sensor.std:
            raise CallError(
                f"sensors.{name}.std: is not set: give the standard deviation of each measured component"
            )
    road = build_road(config.map, config.defects)
    motion = config.motion_model()
    decides = isinstance(config.association, Hypotheses)
    lifecycle = build_lifecycle(config)
    failures = Failures()
    published_order = config.lifecycle.kind == "published"
    joint = (
        config.association if isinstance(config.association, GatedMahalanobis) else None
    )
    ego = _build_ego(config)
    parts = TrackerParts(
        sensors=config.sensors,
        ego=ego,
        wait=_build_wait(config, ego),
        inbox=(SlotInbox if "one_slot" in config.defects else Inbox)(config.sensors),
        preprocess=Preprocess(
            road,
            config.merge,
            motion,
            config.ego.detection_origin_m,
            not published_order,
        ),
        association=config.association,
        joint=joint,
        bank=GuardedBank(lambda: build_bank(config, failures), failures),
        failures=failures,
        motion=motion,
        lifecycle=lifecycle,
        weigh_births=lifecycle.likely
        if isinstance(lifecycle, ExistenceLifecycle) and lifecycle.weighs_births
        else None,
        suppress_births_near_newer_tracks=config.lifecycle.suppress_births_near_newer_tracks,
        birth=config.birth,
        objects=StampedObjects() if decides else Objects(),
        facing=_build_facing(config, motion.cartesian),
        road=road,
        watermarks=Watermarks(config.sensors, [EGO]),
    )
    parts = parts if observed is None else observed(parts)
    if decides:
        rules = _decision_rules(config)
        decisions = Decisions(rules, len(config.sensors), config.revises)
        return DecidedTracker(parts, decisions)
    return (PublishedTracker if published_order else MultiObjectTracker)(parts)


def _build_facing(config: Config, cartesian: bool) -> Facing | None:
    """Return the beliefs about fronts; None if every yaw is used as it was measured."""
    if isinstance(config.association, Hypotheses):
        return StampedFacing(cartesian, nanoseconds(config.effective.reach_s))
    return Facing(cartesian) if config.association.reads_yaws else None


def _decision_rules(config: Config) -> Rules:
    """Return the numbers of decisions; raises `CallError` for a lifecycle that counts."""
    own, birth = config.lifecycle, config.birth
    if not isinstance(own, ExistenceRules) or not isinstance(
        config.association, Hypotheses
    ):
        raise CallError(
            "association.kind: hypotheses needs the probabilities of lifecycle.kind: existence"
        )
    motion = with_correlated_errors(
        decision_motion(config.motion.model(config.used_sensors)), config.used_sensors
    )
    prior = None
    if birth.appearances_per_s is not None:
        mean, std = np.zeros(motion.dim), np.ones(motion.dim)
        for row, name in enumerate(motion.state_names):
            mean[row] = birth.mean.get(name, 0.0)
            std[row] = birth.std.get(name, motion.start_variance(name) ** 0.5)
        prior = BirthPrior(birth.appearances_per_s, mean, np.diag(std**2))
    odds = own.birth_probability / (1.0 - own.birth_probability)
    returns = {
        index: Returns(
            sensor.second_returns.share,
            sensor.second_returns.stds_m,
            math.log(odds * sensor.clutter_per_m2),
            sensor.detection_probability * own.visible_share,
        )
        for index, sensor in enumerate(config.sensors.values())
        if sensor.second_returns is not None
    }
    return Rules(
        motion,
        Views(config.sensors, config.ego.detection_origin_m),
        config.association.most,
        own.lifetime_s,
        own.visible_share,
        own.visible_s,
        own.out_of_view_s,
        own.hidden_s,
        own.delete_probability,
        own.confirm_probability,
        odds,
        own.min_travel_m,
        birth.speed_std_mps,
        returns,
        prior,
    )


def build_lifecycle(config: Config) -> Lifecycle | DecidedLives:
    """Return the lifecycle, which confirms and ends tracks."""
    rules = config.lifecycle
    if isinstance(rules, ExistenceRules):
        if isinstance(config.association, Hypotheses):
            return DecidedLives(rules)
        return ExistenceLifecycle(rules, config.sensors, config.ego.detection_origin_m)
    kind = PublishedLifecycle if rules.kind == "published" else CountingLifecycle
    return kind(rules, config.sensors, config.ego.detection_origin_m)


def build_road(config: MapConfig, defects: Collection[Defect] = ()) -> Road:
    """Return the map; raises `CallError` for a missing file, and for a pit lane without a track."""
    if config.track_file is None:
        if config.pit is None:
            return Road()
        raise CallError(
            f"{config.pit}: a pit lane (map.pit) needs the map of its track (map.track), give --map as well"
        )
    track = _read_map(config.track_file, make_oval)
    pit = None if config.pit is None else _read_map(config.pit, make_pit_lane)
    buffers = (config.inner_buffer_m, config.outer_buffer_m, config.pit_buffer_m)
    if not {"heading_jump", "circular_heading"} & set(defects):
        return Road(track, pit, *buffers)
    circular = "heading_jump" not in defects
    return Road(
        PublishedMap(track, circular),
        None if pit is None else PublishedMap(pit, circular),
        *buffers,
    )


def _read_map(name: str, built_in: Callable[[], TrackMap]) -> TrackMap:
    if name == OVAL:
        return built_in()
    if not Path(name).is_file():
        raise CallError(f"{name}: there is no such map file")
    return TrackMap.read(Path(name))


def _build_backward_forward(config: Config) -> TrackBank:
    step_ns = period_ns(config.filter.frequency_hz)
    leads = "leading_clock" in config.defects
    is_stale = "stale_present" in config.defects
    steps = round(config.filter.storage_s * config.filter.frequency_hz)

    def bank() -> TrackBank:
        propagator = build_propagator(config, seconds(step_ns))
        if not (leads or is_stale):
            return BackwardForwardBank(propagator, step_ns, steps)
        return PublishedStorage(
            propagator, step_ns, steps, leads=leads, is_stale=is_stale
        )

    if config.map.track_file is not None or leads or is_stale:
        return bank()
    # Without a map, each track is initiated separately, because its heading is unknown at first.
    motion = config.motion_model()

    def one(start: Start) -> Estimator:
        return initiated(
            motion,
            start,
            config.initiation.method,
            lambda each: SingleObject(motion, bank(), each),
        )

    return ObjectBank(motion, one, config.filter.storage_s)


def build_bank(config: Config, failures: Failures | None = None) -> TrackBank:
    """Return the estimators of all objects, which count into `failures`; raises `CallError` for invalid options."""
    name = config.estimator
    given = config.options.get(name, {})
    is_filter = name == "ekf-backward-forward"
    if given and (is_filter or name in SMOOTHERS):
        raise CallError(
            f"options.{name}: this estimator has no options, set the keys of smoother or filter instead"
        )
    if is_filter:
        return _build_backward_forward(config)
    # Any: options of a plug-in have any type.
    options: dict[str, Any] = {"initiation": config.initiation.method, **given}
    if name in SMOOTHERS:
        options |= {**vars(config.smoother), "failures": failures}
        del options["lag_s"]
    return estimator_bank(name, config.motion_model(), config.effective.lag_s, options)


def build_propagator(config: Config, step_s: float) -> ExactPropagator:
    """Return the propagator of the backward-forward EKF, with steps of `step_s`."""
    motion = config.motion_model()
    noise = config.motion
    if noise.kind != "ctrv_euler":
        return ExactPropagator(motion)
    names = [
        "position",
        "position",
        "yaw",
        "speed",
        "yaw_rate",
        *(["accel"] if noise.is_driven else []),
    ]
    density = np.array([noise.std_per_s[name] ** 2 / NOISE_HZ for name in names])
    if "noise_per_step" in config.defects:
        density *= NOISE_HZ * step_s
    make = SaturatedEulerCtrv if "saturated_yaw" in config.defects else EulerCtrv
    return make(motion, density, accelerates=noise.is_driven)


def _build_ego(config: Config) -> EgoTrajectory:
    ego = config.ego
    std = EgoStd(
        ego.position_std_m, ego.yaw_std_rad, ego.speed_std_mps, ego.yaw_rate_std_radps
    )
    known = None if ego.uncertainty == "none" else std
    if "refiltered_ego" in config.defects:
        step_ns = period_ns(config.filter.frequency_hz)
        return PublishedEgo(
            ego.yaw_weight, ego.yaw_rate_weight, step_ns, _EGO_STORAGE_TICKS, known
        )
    # A plug-in's noise may lack `speed`; the default for traffic is used then.
    noise = {"speed": 15.0, **config.motion.std_per_s}
    density_m2ps3 = noise.get("velocity", noise["speed"]) ** 2 / NOISE_HZ
    growth = (
        None
        if known is None
        else EgoGrowth(ego.accel_std_mps2, ego.yaw_accel_std_radps2, density_m2ps3)
    )
    time_s = ego.position_time_s
    return EgoTrajectory(
        ego.yaw_weight,
        ego.yaw_rate_weight,
        std=known,
        memory_s=max(_EGO_MEMORY_S, config.effective.reach_s + 2.0),
        position_time_s=time_s,
        growth=growth,
    )


def _build_wait(config: Config, ego: EgoTrajectory) -> PoseWait | None:
    """Return the rule for lists that wait for an ego message; None if no list waits."""
    if not config.ego.wait_s:
        return None
    most_age_ns = nanoseconds(0.5 * config.effective.reach_s)
    return PoseWait(ego, config.sensors, nanoseconds(config.ego.wait_s), most_age_ns)
