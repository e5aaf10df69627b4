"""Where the error of the present comes from."""

import math
import pickle
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fgtrack
from fgtrack.advice.ledger import Contribution, Ledger, _sentence, ledger
from fgtrack.config.reading import read_config, read_scenario
from fgtrack.core.errors import DataError
from fgtrack.core.types import DetectionList, Message, TruthState
from fgtrack.inputs.stream import write_stream
from fgtrack.show.figures.ledger import waterfall
from fgtrack.sim.simulate import simulate

MAPS = {"track_map": "oval", "pit_map": "oval"}


@pytest.fixture(scope="module")
def messages() -> list[Message]:
    return simulate(
        replace(read_scenario("default"), duration_s=12.0), np.random.default_rng(2)
    )


@pytest.fixture(scope="module")
def short() -> list[Message]:
    """As `messages`, where the numbers do not matter."""
    return simulate(
        replace(read_scenario("default"), duration_s=4.0), np.random.default_rng(2)
    )


@pytest.fixture(scope="module")
def karle(messages: list[Message]) -> Ledger:
    return ledger(
        messages, read_config("karle2023", **MAPS), read_config("tuned", **MAPS)
    )


@pytest.fixture(scope="module")
def replaying(messages: list[Message]) -> Ledger:
    """The ledger of the replaying filter with its tuned noise."""
    return ledger(messages, read_config("tuned", estimator="ekf-replay", **MAPS))


def rms(result: Ledger, estimator: str) -> float:
    return float(
        next(
            row["rms_m"]
            for row in result.tables.tables["policies"].records
            if row["estimator"] == estimator
        )
    )


def prompt(messages: Sequence[Message]) -> list[Message]:
    moved = [
        replace(m, receipt_ns=m.stamp_ns) if isinstance(m, DetectionList) else m
        for m in messages
    ]
    return sorted(
        moved,
        key=lambda message: (
            message.stamp_ns if isinstance(message, TruthState) else message.receipt_ns
        ),
    )


def test_the_parts_add_up_to_the_difference_of_the_ends(karle: Ledger) -> None:
    first, *rest = karle.waterfall
    causes = [part.cause for part in rest]
    assert causes[-4:] == [
        "noise that is not tuned",
        "time grid of the filter",
        "forgetting what was fused since",
        "late arrival, everything kept",
    ]
    total = sum(part.share_m2.mean for part in rest)
    assert total == pytest.approx(
        first.mean_square_m2 - rest[-1].mean_square_m2, abs=1e-12
    )
    assert rest[-1].share_m2.mean > 0.0  # lateness costs
    assert str(pickle.loads(pickle.dumps(karle))) == str(karle)


def test_a_wrong_clock_has_a_part(messages: list[Message], replaying: Ledger) -> None:
    """The LiDAR's clock is 60 ms slow: its stamps are behind the time at which it measured."""
    slow = [
        replace(m, stamp_ns=m.stamp_ns - 60_000_000)
        if isinstance(m, DetectionList) and m.sensor == "lidar_cluster"
        else m
        for m in messages
    ]
    config = read_config("tuned", estimator="ekf-replay", **MAPS)
    right = read_config(config, {"sensors.lidar_cluster.clock_offset_s": -0.06})
    result = ledger(slow, config, right)
    first, clock, *rest = result.waterfall
    assert clock.cause == "clock offsets"
    assert clock.share_m2.mean > 0.1 * first.mean_square_m2
    total = clock.share_m2.mean + sum(part.share_m2.mean for part in rest)
    assert total == pytest.approx(
        first.mean_square_m2 - rest[-1].mean_square_m2, abs=1e-12
    )
    assert clock.mean_square_m2 == pytest.approx(
        replaying.waterfall[0].mean_square_m2, rel=0.02
    )


def test_settings_and_maps_are_those_of_replay(short: list[Message]) -> None:
    given = ledger(
        short, "tuned", map="oval", pit_map="oval", set={"estimator": "ekf-replay"}
    )
    assert str(given) == str(
        ledger(short, read_config("tuned", estimator="ekf-replay", **MAPS))
    )


def test_advice_has_the_table_where_it_is_asked_for(
    short: list[Message], tmp_path: Path
) -> None:
    write_stream(tmp_path / "drive.jsonl", short)
    config = read_config("tuned", estimator="ekf-replay", **MAPS)
    advice = fgtrack.advise(tmp_path / "drive.jsonl", config, ledger=True)
    names = [row["estimator"] for row in advice.tables.tables["ledger"].records]
    assert names == [
        "drop",
        "ekf-backward-forward",
        "rewind-forget",
        "ekf-replay",
        "smoother-banded",
        names[-1],
    ]
    assert names[-1] == "ekf-replay, if no list were late"
    assert (
        "ledger" not in fgtrack.advise(tmp_path / "drive.jsonl", config).tables.tables
    )


def test_the_replaying_filter_has_the_error_of_its_own_run(replaying: Ledger) -> None:
    """By the run's files alone: tracks against the truth at the same ticks."""
    assert replaying.waterfall[0].mean_square_m2 == pytest.approx(
        rms(replaying, "ekf-replay") ** 2, rel=1e-9
    )
    assert [part.cause for part in replaying.waterfall[1:]] == [
        "late arrival, everything kept"
    ]


def test_nobody_late_means_no_part_of_lateness(short: list[Message]) -> None:
    result = ledger(
        prompt(short), read_config("smoother", estimator="ekf-replay", **MAPS)
    )
    assert result.waterfall[-1].share_m2.mean == pytest.approx(0.0, abs=1e-12)
    assert all(
        row["cost"] == pytest.approx(0.0, abs=1e-9)
        for row in result.tables.tables["sensors"].records
    )
    assert rms(result, "drop") == pytest.approx(rms(result, "ekf-replay"), rel=1e-9)


def test_a_tie_has_no_minus(karle: Ledger) -> None:
    first = karle.waterfall[0]
    tie = Contribution("tie", first.mean_square_m2 + 1e-6, first.share_m2)
    assert ": tie +0.00 m; " in _sentence([first, tie], karle.tables.tables)


def test_a_late_sensor_costs_and_its_late_lists_are_worth_something(
    karle: Ledger,
) -> None:
    lidar = next(
        row
        for row in karle.tables.tables["sensors"].records
        if row["sensor"] == "lidar_cluster"
    )
    assert lidar["delay_s"] == pytest.approx(0.15, abs=0.03)
    assert lidar["late"] > 0.4
    assert lidar["too_old"] == 0.0
    assert lidar["cost"] > 0.02
    assert lidar["worth"] > 0.02
    assert rms(karle, "drop") > rms(karle, "ekf-replay")


def test_waiting_buys_more_than_smoothing(karle: Ledger) -> None:
    now, *_, longest = karle.tables.tables["waiting"].records
    assert longest["smoother_m"] < longest["filter_m"] < now["filter_m"]
    assert now["gain"] == 0.0  # a smoothing pass changes the past alone


def test_a_smoothing_pass_over_the_filter_does_what_the_smoother_does(
    karle: Ledger,
) -> None:
    for row in karle.tables.tables["waiting"].records:
        assert row["rts_m"] == pytest.approx(row["smoother_m"], rel=0.02)
    assert row["rts_m"] < 0.9 * row["filter_m"]


def test_without_truth_predicted_variances_stand_for_errors(
    messages: list[Message],
) -> None:
    config = read_config("smoother", estimator="ekf-replay", **MAPS)
    result = ledger([m for m in messages if not isinstance(m, TruthState)], config)
    assert not result.with_truth
    assert "No truth" in str(result)
    headings = [
        " ".join(column.heading.split())
        for table in result.tables.tables.values()
        for column in table.columns
        if "RMSE" in column.heading
    ]
    assert headings
    assert all(heading.startswith("predicted ") for heading in headings)
    assert math.isfinite(result.waterfall[0].mean_square_m2)
    assert result.waterfall[-1].share_m2.mean > 0.0


def test_a_recording_without_tracks_has_no_ledger() -> None:
    with pytest.raises(DataError, match="no track in this recording"):
        ledger([DetectionList("radar", 0, 0, [])], read_config("smoother", **MAPS))


def test_a_run_folder_stands_for_its_recording(tmp_path: Path) -> None:
    recording = fgtrack.simulate(
        "default", duration_s=3.0, seed=1, out=tmp_path / "drive.jsonl"
    )
    fgtrack.replay(recording, "smoother", estimator="ekf-replay", out=tmp_path / "run")
    assert str(ledger(tmp_path / "run")) == str(
        ledger(recording, read_config(str(tmp_path / "run" / "config.yaml")))
    )


def test_the_figure_names_every_part(karle: Ledger) -> None:
    [axes] = waterfall(
        [(part.cause, part.mean_square_m2) for part in karle.waterfall], "title"
    ).axes
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert labels == [
        "error now",
        *(part.cause for part in karle.waterfall[1:]),
        "without delays",
    ]


def test_sensors_need_no_configuration(short: list[Message]) -> None:
    assert math.isfinite(ledger(short).waterfall[0].mean_square_m2)


def test_a_run_folder_without_its_recording_says_so(tmp_path: Path) -> None:
    recording = fgtrack.simulate(
        "default", duration_s=2.0, seed=1, out=tmp_path / "drive.jsonl"
    )
    fgtrack.replay(recording, "smoother", estimator="ekf-replay", out=tmp_path / "run")
    Path(recording).unlink()
    with pytest.raises(
        DataError,
        match=r"run: its recording is not at .*drive.jsonl; give the recording's path with -c",
    ):
        ledger(tmp_path / "run")
