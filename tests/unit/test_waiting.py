"""Lists wait for an ego message only where an extrapolated pose would cost them more than their noise."""

from dataclasses import replace

import numpy as np
import pytest
from support.tracking import START_NS, message, ms

from fgtrack.config.settings import Config
from fgtrack.core.types import Detection, DetectionList, EgoState
from fgtrack.models.sensors import SensorModel
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.live import Tracker as LiveTracker
from fgtrack.tracking.tracker import MultiObjectTracker

SENSORS = {
    "lidar": SensorModel(std={"x_m": 0.1, "y_m": 0.1}),
    "radar": SensorModel(std={"range_m": 0.3, "bearing_rad": 0.01}),
}
FAR = Detection(x_m=100.0, y_m=3.0)
NEAR = Detection(x_m=2.0, y_m=0.0)
CONFIG = Config(sensors=SENSORS)


def ego(stamp_ms: float, receipt_ms: float | None = None) -> EgoState:
    receipt_ns = START_NS + ms(stamp_ms if receipt_ms is None else receipt_ms)
    return EgoState(
        START_NS + ms(stamp_ms), receipt_ns, 0.01 * stamp_ms, 0.0, 0.0, 10.0
    )


def tracker(**settings: object) -> MultiObjectTracker:
    return build_tracker(
        CONFIG.replace({f"ego.{name}": value for name, value in settings.items()})
    )


def seen(
    one: MultiObjectTracker, now_ms: float, *messages: EgoState | DetectionList
) -> list[str]:
    """Dispositions of a tick that takes `messages`."""
    for each in messages:
        one.receive(each)
    return [
        str(update.disposition) for update in one.tick(START_NS + ms(now_ms)).updates
    ]


def test_a_list_waits_until_the_ego_has_come_to_its_stamp() -> None:
    one = tracker()
    assert seen(one, 0.0, ego(0.0)) == []
    assert seen(one, 500.0, message(FAR, stamp_ms=450.0, delay_ms=50.0)) == []
    assert seen(one, 600.0) == []
    assert seen(one, 700.0, ego(460.0)) == ["birth"]


def test_a_list_waits_until_the_extrapolation_costs_less_than_its_noise() -> None:
    one = tracker()
    assert seen(one, 500.0, ego(0.0), message(FAR, stamp_ms=450.0)) == []
    assert seen(one, 520.0, ego(420.0)) == ["birth"]


def test_a_list_that_loses_little_by_the_extrapolation_does_not_wait() -> None:
    assert seen(tracker(), 300.0, ego(0.0), message(NEAR, stamp_ms=250.0)) == ["birth"]
    assert seen(tracker(), 300.0, ego(0.0), message(FAR, stamp_ms=250.0)) == []


def test_nothing_waits_longer_than_the_limit() -> None:
    one = tracker(wait_s=0.3)
    assert seen(one, 500.0, ego(0.0), message(FAR, stamp_ms=450.0)) == []
    assert seen(one, 799.0) == []
    assert seen(one, 800.0) == ["birth"]


def test_without_waiting_every_list_is_placed_at_once() -> None:
    assert seen(tracker(wait_s=0.0), 500.0, ego(0.0), message(FAR, stamp_ms=450.0)) == [
        "birth"
    ]


def test_no_list_waits_until_the_estimator_could_not_fuse_it() -> None:
    one = build_tracker(CONFIG.replace({"ego.wait_s": 10.0, "filter.storage_s": 1.0}))
    assert seen(one, 300.0, ego(0.0), message(FAR, stamp_ms=250.0)) == []
    assert seen(one, 740.0) == []
    assert seen(one, 751.0) == ["birth"]


def test_a_list_without_any_ego_fails_after_the_limit() -> None:
    one = tracker()
    assert seen(one, 0.0, message(FAR)) == []
    assert seen(one, 1000.0) == ["failed"]


def test_an_ego_that_starts_late_places_what_waits_for_it() -> None:
    one = tracker()
    assert seen(one, 0.0, message(FAR)) == []
    assert seen(one, 900.0, ego(-10.0, 890.0), ego(10.0, 900.0)) == ["birth"]


def test_positions_in_the_map_wait_for_nothing() -> None:
    assert seen(
        tracker(), 500.0, ego(0.0), message(FAR, stamp_ms=450.0, frame="map")
    ) == ["birth"]


def test_ranges_to_objects_in_the_map_wait_for_an_ego_that_is_late_but_for_none_that_is_lost() -> (
    None
):
    far = Detection(range_m=100.0, bearing_rad=0.1)
    late = message(far, sensor="radar", stamp_ms=700.0, frame="map")
    assert seen(tracker(), 700.0, ego(0.0), late) == []
    assert (
        len(
            seen(
                tracker(),
                1500.0,
                ego(0.0),
                replace(late, stamp_ns=START_NS + ms(1400.0)),
            )
        )
        == 1
    )
    assert len(seen(tracker(), 700.0, late)) == 1


@pytest.mark.parametrize("is_first", [True, False])
def test_the_order_of_ego_and_list_in_a_tick_does_not_matter(is_first: bool) -> None:
    messages = [ego(450.0, 500.0), message(FAR, stamp_ms=450.0)]
    one = tracker()
    seen(one, 0.0, ego(0.0))
    assert seen(one, 500.0, *(messages if is_first else messages[::-1])) == ["birth"]
    [track] = one.tick(START_NS + ms(500.0)).tracks
    np.testing.assert_allclose((track.x_m, track.y_m), (104.5 + 0.0, 3.0), atol=1e-6)


def test_the_lists_of_a_sensor_stay_in_order() -> None:
    one = tracker()
    seen(one, 0.0, ego(0.0))
    lists = [
        message(FAR, stamp_ms=450.0),
        message(NEAR, stamp_ms=451.0),
        message(stamp_ms=452.0),
    ]
    assert seen(one, 500.0, *lists) == []
    assert seen(one, 600.0, ego(460.0)) == ["birth", "birth"]


def test_the_batches_of_a_message_wait_together() -> None:
    sensors = {"lidar": replace(SENSORS["lidar"], stamp_from="object")}
    one = build_tracker(replace(CONFIG, sensors=sensors))
    early, late = (
        replace(FAR, y_m=y_m, stamp_ns=START_NS + ms(at))
        for y_m, at in ((3.0, 100.0), (30.0, 450.0))
    )
    assert (
        seen(one, 500.0, ego(0.0), ego(120.0), message(early, late, stamp_ms=450.0))
        == []
    )
    assert len(seen(one, 600.0, ego(460.0))) == 2


def test_the_end_of_a_drive_processes_what_still_waits() -> None:
    one = tracker()
    assert seen(one, 500.0, ego(0.0), message(FAR, stamp_ms=450.0)) == []
    one.finish()
    assert [str(update.disposition) for update in one.last_updates] == ["birth"]
    live = LiveTracker(CONFIG)
    for each in (ego(0.0), message(FAR, stamp_ms=450.0)):
        live.receive(each)
    live.tick(START_NS + ms(500.0))
    assert live.counts == {}
    live.finish()
    assert live.counts == {"lidar": {"birth": 1}}
    live.finish()
    assert live.counts == {"lidar": {"birth": 1}}


def test_the_last_tick_of_a_replay_leaves_nothing_waiting() -> None:
    one = tracker()
    assert seen(one, 500.0, ego(0.0), message(FAR, stamp_ms=450.0)) == []
    report = one.tick(START_NS + ms(520.0), is_last=True)
    assert [str(update.disposition) for update in report.updates] == ["birth"]


def test_a_detection_with_its_own_covariance_waits_by_that() -> None:
    precise = replace(NEAR, covariance=(1e-6, 0.0, 0.0, 1e-6))
    assert seen(tracker(), 300.0, ego(0.0), message(precise, stamp_ms=250.0)) == []
