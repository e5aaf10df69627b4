"""The committed scenarios and the built-in one, which is a picture of the data of Karle et al. 2023, section III-H."""

import numpy as np
import pytest

from fgtrack.config.keys import commented, sections
from fgtrack.config.reading import read_scenario
from fgtrack.config.shipped import shipped
from fgtrack.core.types import DetectionList, FloatArray, Message, TruthState
from fgtrack.core.yaml_text import safe_yaml
from fgtrack.sim.scenario import Scenario
from fgtrack.sim.simulate import simulate

EGO_ID = -1


@pytest.fixture(scope="module")
def messages() -> list[Message]:
    return simulate(read_scenario("default"), np.random.default_rng(0))


@pytest.fixture(scope="module")
def detections(messages: list[Message]) -> dict[str, FloatArray]:
    """x and y in the ego frame of all detections, shape (n, 2), by sensor."""
    scans = [message for message in messages if isinstance(message, DetectionList)]
    points = {
        name: [(d.x_m, d.y_m) for s in scans if s.sensor == name for d in s.objects]
        for name in NAMES
    }
    return {name: np.array(values, dtype=float) for name, values in points.items()}


@pytest.fixture(scope="module")
def cars(messages: list[Message]) -> dict[int, FloatArray]:
    """x, y, speed, shape (n, 3), of every car at the same n stamps."""
    truth = [message for message in messages if isinstance(message, TruthState)]
    ids = {state.object_id for state in truth}
    states = {
        i: [(s.x_m, s.y_m, s.speed_mps) for s in truth if s.object_id == i] for i in ids
    }
    return {i: np.array(values, dtype=float) for i, values in states.items()}


NAMES = ("lidar_cluster", "radar")


def test_the_sensors_of_the_default_see_where_those_of_the_paper_did(
    detections: dict[str, FloatArray],
) -> None:
    lidar, radar = detections["lidar_cluster"], detections["radar"]
    assert (
        -57.0 - 3.0 < lidar[:, 0].min() < -50.0
    )  # an outlier may lie a little beyond the range
    assert radar[:, 0].min() > 0.0
    assert np.hypot(*lidar.T).max() < 98.0 + 3.0
    assert (
        np.hypot(*radar.T).max() < 105.0 + 3.0 + 3.0
    )  # its range counts from the nose


def test_cars_of_the_default_follow_each_other_and_overtake_at_the_speeds_of_the_paper(
    cars: dict[int, FloatArray],
) -> None:
    ego = cars[EGO_ID]
    others = [states for i, states in cars.items() if i != EGO_ID]
    near = [np.hypot(*(car - ego)[:, :2].T) < 105.0 for car in others]
    speed = np.concatenate(
        [car[mask, 2] for car, mask in zip(others, near, strict=True)]
    )
    assert 35.0 < speed.min() < speed.max() < 75.0
    relative = np.concatenate(
        [(car - ego)[mask, 2] for car, mask in zip(others, near, strict=True)]
    )
    counts, edges = np.histogram(relative, bins=np.arange(-12.5, 13.0))
    assert edges[counts.argmax()] == -0.5  # the peak of the distribution is at 0
    assert relative.min() < -5.0
    assert relative.max() > 5.0


def test_the_printed_scenario_is_a_scenario_file() -> None:
    for name in shipped("scenario"):
        scenario = read_scenario(name)
        assert read_scenario(safe_yaml(commented(scenario))) == scenario


def test_the_printed_scenario_holds_every_kind_and_every_key() -> None:
    text = commented(read_scenario("single_opponent"))
    for section in sections(Scenario):
        named = (f"kind: {section.kind}.", f'kind: "{section.kind}"')
        assert section.kind is None or any(name in text for name in named)
        for one in section.settings:
            assert (
                f" {one.name}: " in f" {text}".replace("\n", " ")
                or f" {one.name}:\n" in text
            )
    assert "rate_hz: 20.0  # Rate of the scans; default 20" in text
