"""Advice: what is harm, which of two clocks can be wrong, and when a change of the delay is one of the clock."""

import math
from dataclasses import replace

import numpy as np
import pytest

from fgtrack.advice.run_quality import NoiseFit, RunQuality, harm
from fgtrack.clocks.arrivals import Arrivals
from fgtrack.clocks.offsets import OffsetReport, SensorOffset
from fgtrack.clocks.stamps import clock_findings, clock_text, stamp_findings
from fgtrack.evaluation.intervals import Estimate
from fgtrack.evaluation.metrics import ObjectMetrics
from fgtrack.evaluation.scores.statistics import Moments

SECOND_NS = 1_000_000_000
TRUTH = ObjectMetrics(
    {"position_m": Moments()},
    ticks_present=6000,
    ticks_in_view=6000,
    ticks_tracked_in_view=5900,
)
GOOD = RunQuality(
    births=20,
    confirmed=3,
    used={"radar": 0.9},
    noise=(),
    truth=TRUTH,
    tick_s=0.02,
    run=None,
)


def test_harm_is_more_breaks_more_tracks_and_less_that_is_tracked_or_used() -> None:
    assert harm(GOOD, GOOD) is None
    assert harm(GOOD, replace(GOOD, confirmed=7)) is None, "may be chance"
    assert harm(GOOD, replace(GOOD, births=60)) is None, "of clutter"
    assert (
        harm(GOOD, replace(GOOD, confirmed=20)) == "confirmed tracks rise from 3 to 20"
    )
    less = replace(TRUTH, ticks_tracked_in_view=5000)
    assert (
        harm(GOOD, replace(GOOD, truth=less))
        == "the tracked share of time falls from 98 % to 83 %"
    )
    broken = replace(TRUTH, breaks=12)
    assert harm(GOOD, replace(GOOD, truth=broken)) == "breaks rise from 0 to 12"
    assert harm(replace(GOOD, truth=less), replace(GOOD, confirmed=60)) is None, (
        "more of the objects is tracked"
    )
    assert "used detections of radar fall from 90 % to 50 %" in str(
        harm(GOOD, replace(GOOD, used={"radar": 0.5}))
    )
    assert harm(GOOD, replace(GOOD, used={"radar": 1.0}, confirmed=60)) is None, (
        "of other detections"
    )


@pytest.mark.parametrize(
    ("at_s", "is_jump"), [(2.0, False), (30.0, True), (58.0, False)]
)
def test_a_change_in_the_last_seconds_is_no_jump_of_the_clock(
    at_s: float, is_jump: bool
) -> None:
    stamps_ns = np.arange(0, 60 * SECOND_NS, SECOND_NS // 20)
    late_ns = np.where(stamps_ns > at_s * SECOND_NS, 300_000_000, 50_000_000)
    found = list(
        stamp_findings(
            Arrivals(
                "radar",
                stamps_ns + SECOND_NS,
                stamps_ns + SECOND_NS + late_ns,
                np.ones(1200, int),
            )
        )
    )
    assert (
        any(
            "its delay is 50 ms until about 30 s and 300 ms after" in one.text
            for one in found
        )
        == is_jump
    )


@pytest.mark.parametrize(("drift_s", "fewest", "most"), [(0.0, 0, 1), (0.3, 195, 200)])
def test_scatter_of_the_delay_is_no_change_but_a_drift_is(
    drift_s: float, fewest: int, most: int
) -> None:
    stamps_ns = np.arange(1, 601) * (SECOND_NS // 20)
    num_changes = 0
    for seed in range(200):
        delays_s = np.random.default_rng(seed).normal(0.2, 0.1, 600) + np.linspace(
            0.0, drift_s, 600
        )
        receipts_ns = stamps_ns + (1e9 * delays_s).astype(np.int64)
        found = stamp_findings(
            Arrivals("radar", stamps_ns, receipts_ns, np.ones(600, int))
        )
        num_changes += any("its delay is" in one.text for one in found)
    assert fewest <= num_changes <= most


def report(offset_s: float, least_s: float, std_s: float = 0.005) -> OffsetReport:
    radar = SensorOffset("radar", offset_s, std_s, 500, "", dof=5.0)
    lidar = SensorOffset("lidar", 0.0, 0.0, 500, "the reference")
    return OffsetReport("lidar", (lidar, radar), {"lidar": least_s, "radar": least_s})


def test_delays_tell_which_clock_is_wrong_where_the_other_cannot_be_so_early() -> None:
    def text(offset_s: float, least_s: float) -> str:
        found = report(offset_s, least_s)
        return clock_text(found.others[0], found)

    assert (
        "early by at most this time: the stamps of radar are late by at least 60 ms."
        in text(0.08, 0.02)
    )
    assert (
        "either clock may be wrong. lidar is assumed to be right. To identify the wrong clock"
        in text(0.08, 0.1)
    )
    assert "radar arrives at least 20 ms after its stamps" in text(-0.08, 0.02)
    assert "the stamps of lidar are late by at least 60 ms." in text(-0.08, 0.02)


def test_an_offset_is_set_where_it_is_known_and_not_0_and_said_where_it_is_not_known() -> (
    None
):
    (set_,) = clock_findings(report(0.08, 0.1), {"radar": 0.01})
    assert set_.settings == {"sensors.radar.clock_offset_s": 0.09}
    assert not list(clock_findings(report(0.004, 0.1), {"radar": 0.0}))
    (unknown,) = clock_findings(report(0.1, 0.1, std_s=0.03), {"radar": 0.0})
    assert (unknown.kind, dict(unknown.settings)) == ("offset", {})
    assert "is not known: +100 ms ± 77 ms" in unknown.text


@pytest.mark.parametrize(
    ("offset_s", "std_s", "said"),
    [  # half of the 95 % interval is 2.57 standard deviations, of the 99 % interval 4.03
        (
            0.004,
            0.002,
            "its stamps agree with the clock of lidar (offset +4 ms ± 5 ms).",
        ),
        (0.0, 0.002, "its stamps agree with the clock of lidar (offset +0 ms ± 5 ms)."),
        (
            0.008,
            0.002,
            "are 8 ms (± 5 ms) later than the clock of lidar: an offset below 10 ms does not matter.",
        ),
        (
            -0.008,
            0.001,
            "are 8 ms (± 3 ms) earlier than the clock of lidar: an offset below 10 ms does not matter.",
        ),
        (
            0.03,
            0.01,
            "may be 30 ms (± 26 ms) later than the clock of lidar: the 95 % interval excludes 0, the 99",
        ),
        (0.012, 0.002, "its stamps are 12 ms (± 5 ms) later than those of lidar."),
    ],
)
def test_stamps_agree_only_where_the_printed_interval_contains_0(
    offset_s: float, std_s: float, said: str
) -> None:
    found = report(offset_s, 0.1, std_s)
    text = clock_text(found.others[0], found)
    assert said in text
    assert ("agree" in text) == (abs(offset_s) <= 2.571 * std_s)


@pytest.mark.parametrize(
    ("mean", "count", "consistent"),
    [(1.2, 500, True), (3.16, 500, False), (0.5, 500, False), (1.0, 5, False)],
)
def test_noise_is_fine_only_where_its_mean_is_that_expected(
    mean: float, count: int, consistent: bool
) -> None:
    fit = NoiseFit("radar", count, Estimate(mean, math.nan, math.nan, 1), None)
    assert fit.is_consistent == consistent
