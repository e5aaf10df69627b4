"""Nothing is lost without a word: whatever comes in, every detection ends in exactly one row of updates."""

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.paper import paper

from fgtrack.config.settings import Config
from fgtrack.config.yaml_file import load
from fgtrack.core.types import (
    Detection,
    DetectionList,
    Disposition,
    EgoState,
    TickReport,
    UpdateRecord,
)
from fgtrack.estimation.registry import ESTIMATORS
from fgtrack.models.oval import make_oval
from fgtrack.models.sensors import Mount, SensorModel
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.clock import Delivered, clock_ticks

REFERENCE = Path(__file__).resolve().parents[2] / "configs/karle2023_reference.yaml"
START_NS = 1_600_000_000_000_000_000
MS = 1_000_000
EXTRA_SENSORS = {
    "camera": SensorModel(
        std={"bearing_rad": 0.02}, max_delay_s=0.5, stamp_from="object"
    ),
    "doppler": SensorModel(
        std={"range_m": 0.5, "bearing_rad": 0.02, "range_rate_mps": 0.3},
        mount=Mount(1.0, 0.5, 0.3),
        stamp_from="object",
    ),
    "mixed": SensorModel(
        std={
            "x_m": 1.0,
            "y_m": 0.5,
            "yaw_rad": 0.2,
            "range_m": 1.0,
            "bearing_rad": 0.1,
        },
        births=False,
    ),
}
CLAIM = "lifecycle.suppress_births_near_newer_tracks=true"
OVAL = ['map.track="oval"', 'map.pit="oval"']


def _with_all_sensors(config: Config) -> Config:
    return replace(config, sensors={**config.sensors, **EXTRA_SENSORS})


CONFIGS = {
    "clean": _with_all_sensors(paper(*OVAL)),
    "clean in open space": _with_all_sensors(
        paper(
            "association={kind: mahalanobis, joint_from: 2}",
            "birth={kind: measured}",
            "merge={kind: none}",
            "motion={kind: cv, std_per_s: {velocity: 5.0}}",
            "clock.node_hz=7.0",
        )
    ),
    "replaying": replace(
        _with_all_sensors(
            paper(*OVAL, "filter.storage_s=0.3", "association.max_nis=50.0", CLAIM)
        ),
        estimator="ekf-replay",
    ),
    "smoothing": replace(
        _with_all_sensors(
            paper("smoother={lag_s: 0.3, ring_s: 0.3}", "motion={kind: ctrv}", CLAIM)
        ),
        estimator="smoother",
    ),
    "smoothing what is not too late": replace(
        _with_all_sensors(
            paper(
                *OVAL,
                "smoother={lag_s: 0.3, late: drop}",
                "motion={kind: ctra, std_per_s: {position: 0.2, yaw: 0.3, speed: 1.0, yaw_rate: 0.5, accel: 3.0}}",
            )
        ),
        estimator="smoother",
    ),
    "published": load(Config, REFERENCE, OVAL),
}

# --- random streams

odd_numbers = st.sampled_from(
    [math.nan, math.inf, -math.inf, 0.0, -0.0, 1e308, -1e200, 1e-300, 1e9]
)
small = st.floats(-3.0, 3.0)


@st.composite
def detections(draw: st.DrawFn) -> Detection:
    kind = draw(
        st.sampled_from(
            ["car", "car", "car", "far", "empty", "odd", "polar", "bearing", "partial"]
        )
    )
    x_m, y_m = draw(
        st.sampled_from([(25.0, 0.0), (25.0, 3.0), (29.0, 4.0), (45.0, -2.0)])
    )
    x_m, y_m = x_m + draw(small) / 3, y_m + draw(small) / 3
    stamp_ns = draw(
        st.none() | st.integers(-1500, 1500).map(lambda ms: START_NS + ms * MS)
    )
    size = draw(st.sampled_from([None, None, 4]))
    covariance = None if size is None else tuple(draw(covariances(size)))
    if kind == "empty":
        return Detection(0.0, 0.0, 0.0, 0.0, stamp_ns=stamp_ns)
    if kind == "odd":
        values = [draw(odd_numbers | st.floats()) for _ in range(7)]
        return Detection(*values, stamp_ns=stamp_ns)
    if kind == "polar":
        polar = {
            "range_m": math.hypot(x_m, y_m),
            "bearing_rad": math.atan2(y_m, x_m),
            "range_rate_mps": draw(small),
        }
        return Detection(**polar, stamp_ns=stamp_ns)
    if kind == "bearing":
        return Detection(bearing_rad=math.atan2(y_m, x_m), stamp_ns=stamp_ns)
    if kind == "partial":
        return Detection(
            **dict.fromkeys(
                draw(st.sets(st.sampled_from(["x_m", "y_m", "yaw_rad"]))), x_m
            )
        )
    if kind == "far":
        x_m, y_m = draw(st.floats(-400.0, 400.0)), draw(st.floats(-400.0, 400.0))
    return Detection(
        x_m,
        y_m,
        draw(small),
        30.0 + draw(small),
        covariance=covariance,
        stamp_ns=stamp_ns,
    )


@st.composite
def covariances(draw: st.DrawFn, size: int) -> list[float]:
    root = np.array(
        draw(
            st.lists(
                st.sampled_from([0.0, 0.1, 1.0, -2.0]),
                min_size=size**2,
                max_size=size**2,
            )
        )
    )
    root = root.reshape(size, size)
    matrix = draw(
        st.sampled_from(
            [root @ root.T, root @ root.T + np.eye(size), root, -np.eye(size)]
        )
    )
    return matrix.ravel().tolist()


@st.composite
def streams(draw: st.DrawFn) -> list[Delivered]:
    """Messages in receipt order: late, early, repeated, of the future, of any frame, with any content."""
    line = make_oval().table[0]
    receipt_ns = START_NS
    messages: list[Delivered] = []
    ego_from = draw(st.sampled_from([0, 0, 0, 5, 1000]))
    for number in range(draw(st.integers(1, 15))):
        receipt_ns += draw(
            st.sampled_from(
                [0, 1, 5 * MS, 20 * MS, 50 * MS, 50 * MS, 300 * MS, 2500 * MS]
            )
        )
        if number >= ego_from:
            speed = draw(st.sampled_from([0.0, 30.0, 30.0, 30.0]))
            along_m = 30.0 * (receipt_ns - START_NS) / 1e9
            x_m, y_m = (
                line[0] + along_m * math.cos(line[14]),
                line[1] + along_m * math.sin(line[14]),
            )
            late_ns = draw(st.sampled_from([0, 0, 2 * MS, 40 * MS, -2000 * MS]))
            odd = draw(odd_numbers) if draw(st.integers(0, 9)) == 0 else None
            yaw = float(line[14]) if odd is None else odd
            pit = draw(st.sampled_from([None, True, False]))
            messages.append(
                EgoState(
                    receipt_ns - late_ns,
                    receipt_ns,
                    x_m,
                    y_m,
                    yaw,
                    speed,
                    0.01,
                    in_pit=pit,
                )
            )
        if (
            messages
            and isinstance(messages[-1], DetectionList)
            and draw(st.integers(0, 4)) == 0
        ):
            last = messages[-1]
            messages.append(
                DetectionList(
                    last.sensor, last.stamp_ns, receipt_ns, last.objects, last.frame
                )
            )
            continue
        delay_ns = draw(
            st.sampled_from(
                [
                    0,
                    1,
                    5 * MS,
                    60 * MS,
                    150 * MS,
                    290 * MS,
                    450 * MS,
                    4000 * MS,
                    -900 * MS,
                ]
            )
        )
        far_future = draw(st.integers(0, 19)) == 0
        sensor = draw(
            st.sampled_from([*paper().sensors, *paper().sensors, *EXTRA_SENSORS])
        )
        messages.append(
            DetectionList(
                sensor,
                receipt_ns + 10**14 if far_future else receipt_ns - delay_ns,
                receipt_ns,
                tuple(draw(st.lists(detections(), max_size=4))),
                draw(st.sampled_from(["ego", "ego", "ego", "sensor", "map"])),
            )
        )
    return messages


def run(config: Config, messages: list[Delivered]) -> list[TickReport]:
    tracker = build_tracker(config)
    reports = []
    for tick in clock_ticks(messages, config.clock.node_hz or 50.0):
        for message in tick.messages:
            tracker.receive(message)
        reports.append(tracker.tick(tick.now_ns))
    return reports


def received(messages: list[Delivered]) -> Counter[tuple[str, int, int, int]]:
    """Every detection by sensor, receipt, stamp and index."""
    return Counter(
        (
            message.sensor,
            message.receipt_ns,
            message.stamp_ns if item.stamp_ns is None else item.stamp_ns,
            index,
        )
        for message in messages
        if isinstance(message, DetectionList)
        for index, item in enumerate(message.objects)
    )


def key(record: UpdateRecord) -> tuple[str, int, int, int]:
    return record.sensor, record.receipt_ns, record.stamp_ns, record.index


FUSED = (
    Disposition.IN_SEQUENCE,
    Disposition.OUT_OF_SEQUENCE,
    Disposition.BEYOND_WINDOW,
)


@given(messages=streams(), name=st.sampled_from(list(CONFIGS)))
def test_every_detection_ends_in_exactly_one_row_and_every_state_is_sound(
    name: str, messages: list[Delivered]
) -> None:
    config = CONFIGS[name]
    messages = [
        m for m in messages if isinstance(m, EgoState) or m.sensor in config.sensors
    ]
    reports = run(config, messages)
    assert Counter(
        key(record) for report in reports for record in report.updates
    ) == received(messages)
    ids = set()
    for report in reports:
        born = {
            record.track_id
            for record in report.updates
            if record.disposition == Disposition.BIRTH
        }
        assert not born & ids  # ids are never used twice
        ids |= born
        assert {track.track_id for track in report.tracks} <= ids
        for record in report.updates:
            fused = record.disposition in FUSED
            assert fused == (record.nis is not None) == bool(record.innovation)
            if record.nis is not None:
                assert record.nis >= 0.0
                assert all(map(math.isfinite, record.innovation.values()))
        for track in report.tracks:
            mean, covariance = track.state.mean, track.state.covariance
            assert np.isfinite(mean).all()
            assert -math.pi < mean[2] <= math.pi
            assert np.array_equal(covariance, covariance.T)
            scale = np.sqrt(np.diag(covariance))
            scale = np.where(scale > 0.0, scale, 1.0)  # an entry of 0 stays 0
            normalised = covariance / np.outer(scale, scale)
            assert np.linalg.eigvalsh(normalised).min() >= -1e-8


@pytest.mark.parametrize("estimator", list(ESTIMATORS))
def test_a_detection_stamped_ahead_of_the_clock_starts_a_track_at_once(
    estimator: str,
) -> None:
    ahead = DetectionList(
        "lidar", START_NS + 900 * MS, START_NS, (Detection(20.0, 1.0, 0.0),), "map"
    )
    [report] = run(replace(paper(), estimator=estimator), [ahead])
    [track] = report.tracks
    assert track.state.stamp_ns == START_NS
    assert track.state.mean[:2] == pytest.approx([20.0, 1.0])
