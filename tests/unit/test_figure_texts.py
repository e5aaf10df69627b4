"""No text of any figure is cut off or lies on another: of few and many objects, runs, sensors, long names."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from evaluation_runs import START_NS, TICK_NS, Car, update, write_run
from matplotlib.figure import Figure
from support.pictures import faults

from fgtrack.core.types import Detection, DetectionList, Disposition, EgoState
from fgtrack.evaluation.runs import evaluated
from fgtrack.runs import Run
from fgtrack.show.figures import plot

TICKS = range(50)
LONG = "a-run-with-a-name-that-goes-on-and-on-until-nobody-wants-to-read-it-any-more-and-then-some"


def a_run(
    folder: Path,
    *,
    objects: int = 2,
    sensors: int = 2,
    seed: int = 0,
    scale: float = 1.0,
    truth: bool = True,
) -> Run:
    """Cars side by side, each tracked with an error of its own; sensors with late detections, an ego, the oval."""
    rng = np.random.default_rng(seed)
    cars = [Car(k, 100.0, 12.0 * k, 0.3, 20.0) for k in range(objects)]
    tracks = [
        [
            car.track(
                k, car.object_id, along_m=scale * 0.1 * rng.normal(), speed_mps=0.1
            )
            for car in cars
        ]
        for k in TICKS
    ]
    updates = {
        k: [
            update(
                f"sensor_{index}_of_the_vehicle",
                tick=k,
                delay_ns=int(1e7 * (1 + index)) + seed,
                disposition=Disposition.OUT_OF_SEQUENCE
                if index
                else Disposition.IN_SEQUENCE,
                nis=float(rng.chisquare(3)),
                x_m=scale * rng.normal(),
                y_m=rng.normal(),
                speed_mps=rng.normal(),
            )
            for index in range(sensors)
        ]
        for k in TICKS
    }
    stamps_ns = [START_NS + k * TICK_NS for k in TICKS]
    return write_run(
        folder,
        tracks,
        truth=[row for car in cars for row in car.truth(TICKS)] if truth else (),
        updates=updates,
        smoothed={
            k: [car.later(k - 5, car.object_id, 0.1) for car in cars] for k in TICKS[5:]
        },
        ego=[
            EgoState(stamp_ns, stamp_ns, 80.0, 0.0, 0.0, 10.0) for stamp_ns in stamps_ns
        ],
        detections=[
            DetectionList("lidar", each, each, [Detection(x_m=20.0, y_m=1.0)])
            for each in stamps_ns[2:-2]
        ],
        config_text="map: {track: oval}",
        process_ns=rng.integers(100_000, 90_000_000, len(TICKS)).tolist(),
        meta={"estimator": folder.name},
    )


def many_runs(folder: Path) -> list[Run]:
    return [a_run(folder / f"{LONG}-{k}", scale=1.0 + 0.01 * k) for k in range(9)]


SCENES = {
    "fifty objects": lambda folder: [a_run(folder / "smoother", objects=50)],
    "no truth": lambda folder: [a_run(folder / "smoother", truth=False)],
    "large numbers": lambda folder: [
        a_run(folder / name, scale=1e7) for name in ("smoother", "ekf-replay")
    ],
    "many runs with long names": many_runs,
}


def figures(runs: list[Run]) -> Iterator[tuple[str, Figure]]:
    """One of each kind."""
    plans = {plan.draw.func: plan for plan in reversed(plot.planned(evaluated(runs)))}
    return plot.drawn(plans.values())


@pytest.mark.parametrize(
    "scene",
    [
        one if one == "no truth" else pytest.param(one, marks=pytest.mark.slow)
        for one in SCENES
    ],
)
def test_no_text_is_cut_off_or_lies_on_another(scene: str, tmp_path: Path) -> None:
    found = {name: faults(figure) for name, figure in figures(SCENES[scene](tmp_path))}
    assert {name: lines for name, lines in found.items() if lines} == {}
