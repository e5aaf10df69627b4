"""What a run is warned of: detections that were not used, windows that are too short, noise that does not fit."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from unit.evaluation_runs import WEST, update, write_run

from fgtrack.core.types import Disposition, UpdateRecord
from fgtrack.evaluation.diagnostics import (
    diagnostics,
    lifetimes_and_breaks,
    noise_diagnostics,
    unused,
)
from fgtrack.runs import Columns, Run
from fgtrack.runs.schema import column

CONFIG = """
sensors: {lidar: {max_delay_s: 0.4}, radar: {}}
"""
SMOOTHER: dict[str, object] = {"lag_key": "smoother.lag_s", "lag_s": 1.0}
FILTER: dict[str, object] = {"lag_key": "filter.storage_s", "lag_s": 3.0}


def run_of(
    folder: Path,
    records: list[UpdateRecord],
    config: str = CONFIG,
    effective: dict[str, object] = SMOOTHER,
) -> Run:
    by_tick: dict[int, list[UpdateRecord]] = {}
    for tick, record in enumerate(records):
        by_tick.setdefault(tick, []).append(record)
    return write_run(
        folder,
        [[]] * len(records),
        updates=by_tick,
        meta={"effective": effective},
        config_text=config,
    )


def lists(fate: Disposition, num: int = 40, **values: float) -> list[UpdateRecord]:
    return [
        update(tick=k, disposition=fate, delay_ns=150_000_000, **values)
        for k in range(num)
    ]


def test_a_healthy_run_has_none(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    fine = [
        update(
            tick=k, delay_ns=150_000_000, nis=float(rng.chisquare(2)), x_m=0.1, y_m=0.1
        )
        for k in range(100)
    ]
    refused = [update(tick=k, disposition=Disposition.GATED) for k in range(100, 150)]
    run = run_of(tmp_path / "run", fine + refused)
    assert (diagnostics(run), list(noise_diagnostics(run)), unused(run)) == (
        [],
        [],
        None,
    )


@pytest.mark.parametrize(
    ("fate", "cure"),
    [
        (Disposition.GATED, "the gate of `association`"),
        (Disposition.OUT_OF_BOUNDS, "--map"),
        (Disposition.DUPLICATE, "send lists twice"),
        (Disposition.SUPERSEDED, "clock.node_hz"),
        (Disposition.INVALID, "sensors.lidar.std"),
    ],
)
def test_what_most_detections_of_a_sensor_ended_in_is_told_with_a_cure(
    fate: Disposition, cure: str, tmp_path: Path
) -> None:
    run = run_of(
        tmp_path / "run", [*lists(fate, 30), *lists(Disposition.IN_SEQUENCE, 29)]
    )
    (found,) = diagnostics(run)
    assert (found.about, found.settings) == ("lidar", {})
    assert found.text.startswith(f"30 of 59 {fate.value}: ")
    assert cure in found.text
    assert unused(run) is None
    (again,) = diagnostics(run_of(tmp_path / "other", lists(fate, 3)))
    assert str(again).startswith("lidar: 3 of 3")


@pytest.mark.parametrize("late", [20, 60])
def test_late_detections_that_an_estimator_drops_by_design_are_no_warning(
    late: int, tmp_path: Path
) -> None:
    def told(estimator: str) -> list[str]:
        run = write_run(
            tmp_path / estimator,
            [[]] * 80,
            updates={
                0: [
                    *(
                        update(
                            tick=k,
                            disposition=Disposition.TOO_OLD,
                            delay_ns=3_500_000_000,
                        )
                        for k in range(late)
                    ),
                    *lists(Disposition.IN_SEQUENCE, 80 - late),
                ]
            },
            meta={"effective": SMOOTHER, "estimator": estimator},
            config_text=CONFIG,
        )
        return list(map(str, diagnostics(run)))

    assert told("drop") == []
    assert told("ekf-replay")


@pytest.mark.parametrize(("failed", "is_told"), [(6, True), (4, False)])
def test_failed_detections_above_5_percent_name_the_first_failure(
    failed: int, is_told: bool, tmp_path: Path
) -> None:
    records = [
        *lists(Disposition.FAILED, failed),
        *lists(Disposition.IN_SEQUENCE, 100 - failed),
    ]
    run = write_run(
        tmp_path / "run",
        [[]] * 100,
        updates={0: records},
        meta={"effective": SMOOTHER, "first_failure": "KeyError: 3"},
        config_text=CONFIG,
    )
    told = [str(one) for one in diagnostics(run)]
    line = "lidar: 6 detections failed (6.0 %): the first failure: KeyError: 3"
    assert told == ([line] if is_told else [])


def test_too_old_names_the_limit_that_was_passed(tmp_path: Path) -> None:
    late = [
        update(tick=k, disposition=Disposition.TOO_OLD, delay_ns=3_500_000_000)
        for k in range(5)
    ]
    (by_sensor,) = diagnostics(run_of(tmp_path / "a", late))
    assert (
        "median delay 3.5 s, allowed 0.4 s: raise sensors.lidar.max_delay_s"
        in by_sensor.text
    )
    (by_window,) = diagnostics(
        run_of(
            tmp_path / "b", late, CONFIG.replace("max_delay_s: 0.4", "max_delay_s: 9.0")
        )
    )
    assert "allowed 1 s: raise smoother.lag_s" in by_window.text
    unlimited = CONFIG.replace("{max_delay_s: 0.4}", "{}")
    (by_storage,) = diagnostics(run_of(tmp_path / "c", late, unlimited, FILTER))
    assert "allowed 3 s: raise filter.storage_s" in by_storage.text


@pytest.mark.parametrize(("share", "is_warned"), [(0.2, True), (0.005, False)])
def test_delays_longer_than_the_memory_of_the_estimator_are_told_once(
    share: float, is_warned: bool, tmp_path: Path
) -> None:
    """Most detections come in time."""
    rows = []
    for k in range(1000):
        is_late = k % round(1.0 / share) == 0
        fate = Disposition.TOO_OLD if is_late else Disposition.IN_SEQUENCE
        rows.append(
            update(
                tick=k,
                disposition=fate,
                delay_ns=3_500_000_000 if is_late else 100_000_000,
            )
        )
    run = run_of(
        tmp_path / "run", rows, CONFIG.replace("{max_delay_s: 0.4}", "{}"), FILTER
    )
    text = "lidar: 20 % arrive later than filter.storage_s (3 s) allows and are not used; 99 % arrive within 3.5 s: set"
    assert [
        text in each for each in map(str, diagnostics(run)) if "later than" in each
    ] == [True] * is_warned


def test_stamps_that_nobody_set_are_told(tmp_path: Path) -> None:
    unset = [
        UpdateRecord("lidar", 0, 10**18 + k, 0, Disposition.IN_SEQUENCE)
        for k in range(3)
    ]
    (found,) = diagnostics(run_of(tmp_path / "a", unset))
    assert str(found).startswith("lidar: all stamps are 0")
    assert found.settings == {"sensors.lidar.stamp_from": "receipt"}


@pytest.mark.parametrize(
    ("nis", "size", "times"),
    [(32.0, "small", 4), (0.2, "large", 0.32), (-1e-9, "large", 0)],
)
def test_noise_that_does_not_fit_is_told(
    nis: float, size: str, times: float, tmp_path: Path
) -> None:
    run = run_of(
        tmp_path / "run", [update(tick=k, nis=nis, x_m=0.1, y_m=0.1) for k in range(40)]
    )
    (found,) = noise_diagnostics(run)
    assert str(found).startswith(
        f"lidar: mean NIS {nis:.3g}, expected 2: the configured noise is too {size}"
    )
    assert f"errors are {times} times" in str(found)
    burst = [26.0 if k % 10 == 0 else 1.4 for k in range(40)]
    born = run_of(
        tmp_path / "born",
        [update(tick=k, nis=each, x_m=0.1, y_m=0.1) for k, each in enumerate(burst)],
    )
    assert list(noise_diagnostics(born)) == []
    few = run_of(
        tmp_path / "few", [update(tick=k, nis=nis, x_m=0.1, y_m=0.1) for k in range(20)]
    )
    assert list(noise_diagnostics(few)) == []


def test_a_run_that_used_nothing_says_what_became_of_all(tmp_path: Path) -> None:
    run = run_of(
        tmp_path / "run", [*lists(Disposition.TOO_OLD, 3), *lists(Disposition.GATED, 2)]
    )
    assert unused(run) == "none of the 5 detections was used (2 gated, 3 too_old)"
    assert unused(run_of(tmp_path / "empty", [])) is None


@pytest.mark.parametrize(
    ("meta", "text"),
    [
        ({"ego_refused": {"stamp ahead of its receipt": 2}, "ego_jumps": 0}, None),
        (
            {"ego_refused": {"stamp ahead of its receipt": 3}},
            "3 of 4 states not used, stamp ahead of its receipt",
        ),
        ({"ego_jumps": 1}, "its position jumps once"),
        ({"ego_jumps": 3}, "its position jumps 3 times"),
    ],
)
def test_most_states_refused_and_jumps_of_the_ego_are_told(
    meta: dict[str, object], text: str | None, tmp_path: Path
) -> None:
    run = run_of(tmp_path / "run", lists(Disposition.IN_SEQUENCE))
    ego = Columns({name: column(name, [0, 1, 2, 3]) for name in run.tables["ego"]})
    found = list(
        map(
            str,
            diagnostics(replace(run.with_tables(ego=ego), meta={**run.meta, **meta})),
        )
    )
    assert [f"ego: {text}" in each for each in found] == (
        [] if text is None else [True]
    )


def test_angles_in_degrees_are_told(tmp_path: Path) -> None:
    run = run_of(tmp_path / "run", [update(tick=k) for k in range(40)])
    stamps_ns = np.arange(3)
    ego = {
        "yaw_rad": np.array([0.1, 67.0, np.nan]),
        "stamp_ns": stamps_ns,
        "receipt_ns": stamps_ns,
    }
    of_radar = {
        "sensor": np.array(["radar", "radar"]),
        "bearing_rad": np.array([-12.0, 6.0]),
        "frame": np.array(["map", "map"]),
        "stamp_ns": np.arange(2),
        "receipt_ns": np.arange(2),
    }
    found = diagnostics(run.with_tables(ego=Columns(ego), detections=Columns(of_radar)))
    assert [str(one).split(":")[:2] for one in found[:2]] == [
        ["ego", " yaw_rad reaches 67, so it is probably in degrees"],
        ["radar", " bearing_rad reaches 12, so it is probably in degrees"],
    ]
    assert all("`{path: ..., degrees: true}`" in str(one) for one in found[:2])


def pieces(folder: Path, *spans: tuple[int, int], ahead_m: float = 0.0) -> Run:
    """WEST tracked by one track after another, each from and to a tick, the next `ahead_m` further ahead."""
    tracks = [
        [
            WEST.track(tick, k, along_m=k * ahead_m)
            for k, (begin, end) in enumerate(spans)
            if begin <= tick < end
        ]
        for tick in range(max(end for _, end in spans))
    ]
    return write_run(folder, tracks, config_text=CONFIG)


BROKEN = [(0, 100), (130, 200), (190, 300), (350, 400)]
"""With gaps of 0.6 s and 1 s, and an overlap of 0.2 s."""


def test_tracks_that_begin_where_another_one_has_just_ended_are_told_without_truth(
    tmp_path: Path,
) -> None:
    run = pieces(tmp_path / "run", *BROKEN)
    lifetimes_s, num_breaks = lifetimes_and_breaks(run)
    assert num_breaks == 3
    assert lifetimes_s == pytest.approx([1.98, 1.38, 2.18, 0.98])
    (found,) = diagnostics(run)
    assert found.text.startswith(
        "3 of 4 confirmed tracks begin where another track has just ended: 28 breaks per object"
    )
    assert "`fgtrack advise`" in found.text


def test_births_that_die_unconfirmed_are_told_where_they_are_most_detections(
    tmp_path: Path,
) -> None:
    (found,) = diagnostics(
        run_of(
            tmp_path / "bad",
            lists(Disposition.BIRTH, 31) + lists(Disposition.IN_SEQUENCE, 30),
        )
    )
    assert (found.about, found.text.split(";")[0]) == (
        "tracks",
        "31 of 61 used detections started a track that was never confirmed",
    )
    assert (
        diagnostics(
            run_of(
                tmp_path / "good",
                lists(Disposition.BIRTH, 30) + lists(Disposition.IN_SEQUENCE, 30),
            )
        )
        == []
    )


@pytest.mark.parametrize(
    ("counts", "texts"),
    [
        ({"yaws": 100, "flipped": 5, "unused": 5}, []),
        ({"yaws": 29, "flipped": 20}, []),
        ({"yaws": 100, "flipped": 6}, ["6 of 100 yaws are half a turn off"]),
        ({"yaws": 200, "unused": 30}, ["30 of 200 yaws are inconsistent"]),
        (
            {"yaws": 200, "flipped": 50, "unused": 30},
            ["50 of 200 yaws are half a turn off", "30 of 200 yaws are inconsistent"],
        ),
    ],
)
def test_many_wrong_yaws_are_a_diagnostic_with_their_number(
    counts: dict[str, int], texts: list[str], tmp_path: Path
) -> None:
    run = run_of(tmp_path / "run", lists(Disposition.IN_SEQUENCE))
    run.meta["yaws"] = {"lidar": counts}
    found = diagnostics(run)
    assert [each.about for each in found] == ["lidar"] * len(texts)
    for each, text in zip(found, texts, strict=True):
        assert each.text.startswith(text)
