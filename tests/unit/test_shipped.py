"""Configurations, scenarios and sweeps by name."""

from pathlib import Path

import pytest

from fgtrack.config.reading import read_config, read_scenario
from fgtrack.config.shipped import Kind, find_file, shipped, summary
from fgtrack.core.errors import CallError


@pytest.mark.parametrize("kind", ["configuration", "scenario", "sweep"])
def test_every_shipped_file_has_a_summary_that_fits_a_line(kind: Kind) -> None:
    for path in shipped(kind).values():
        assert path.read_text().startswith("# ")
        assert 10 < len(summary(path)) < 100
        assert summary(path).endswith((".", "?"))


def test_a_shipped_name_stands_in_for_a_file_that_is_not_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert read_config("smoother").estimator == "smoother"
    assert len(read_scenario("dense").opponents) == 10
    Path("smoother").write_text("estimator: drop\n")
    assert read_config("smoother").estimator == "drop"
    assert (
        read_config("smoother", folder=tmp_path / "elsewhere").estimator == "smoother"
    )


def test_maps_and_settings_go_before_what_the_file_says() -> None:
    config = read_config(
        "smoother", ["smoother.lag_s=2.5"], track_map="oval", pit_map="pit.csv"
    )
    assert (config.map.track, config.map.pit, config.smoother.lag_s) == (
        "oval",
        "pit.csv",
        2.5,
    )
    assert read_config("smoother").map.track is None


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "smothr",
            "smothr: there is no such configuration file, did you mean 'smoother'?",
        ),
        (
            "zzz",
            "shipped files are adsb, airport, ais, autoferry, karle2023, karle2023_reference, kitti, open_space",
        ),
        ("smother.yaml", "smother.yaml: there is no such configuration file"),
        ("some/smoother", "some/smoother: there is no such configuration file"),
    ],
)
def test_a_name_that_is_unknown_is_one_line_with_a_hint(
    name: str, message: str
) -> None:
    with pytest.raises(CallError) as caught:
        find_file("configuration", name)
    assert message in str(caught.value)
