"""All that a comparison of filters and smoothers may be confounded by, measured one after the other.

    python experiments/fairness.py -o out/fairness --jobs 2

Runs the experiments on the noise, the initiation, the losses, the ego and bearings, and measures here
what needs no script of its own: the sensor's lever arm and the whiteness of the innovations. Prints every table and
writes them to fairness.md.
"""

import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import typer

import fgtrack
from fgtrack import evaluate, read_scenario
from fgtrack.evaluation import Consistency, average
from fgtrack.sim import Scenario

HERE = Path(__file__).parent

#: By script: the question, and the options of a quick run.
SCRIPTS: Mapping[str, tuple[str, Sequence[str]]] = {
    "births/births.py": ("initiation", ("--objects", "20")),
    "outliers/outliers.py": ("robust losses", ("--runs", "2")),
    "ego_uncertainty/ego_uncertainty.py": ("uncertainty of the ego", ("--runs", "2")),
    "attribution/attribution.py": ("what every ingredient is worth", ("--runs", "2")),
    "doppler/doppler.py": ("range, bearing and range rate", ("--runs", "2")),
    "bearing_only/bearing_only.py": ("bearings alone", ("--runs", "2")),
    "bearing_only/cameras.py": (
        "bearing-only cameras beside positions",
        ("--runs", "2"),
    ),
}

_STILL = {
    "position_density_m2ps": 0.0,
    "yaw_density_rad2ps": 0.0,
    "speed_density_m2ps3": 0.0,
    "yaw_rate_density_rad2ps3": 0.0,
}
_TURN_RADPS = 0.3
_ARMS_M = {"without an arm": (1.74, 0.0), "with an arm of 3.7 and 0.9 m": (3.7, 0.9)}
_DOPPLER_STD = {"range_m": 0.3, "bearing_rad": 0.01, "range_rate_mps": 0.1}


def turning_ego(mount: tuple[float, float], duration_s: float) -> Scenario:
    """Two slow objects, seen by the RADAR of a car that turns; without an arm it sits at the reference point."""
    exact = (
        "position_std_m",
        "yaw_std_rad",
        "speed_std_mps",
        "yaw_rate_std_radps",
        "accel_std_mps2",
    )
    ego = {
        "kind": "drawn",
        "x_m": 0.0,
        "y_m": 0.0,
        "yaw_rad": 0.0,
        "speed_mps": 15.0,
        "yaw_rate_radps": _TURN_RADPS,
    }
    opponents = [
        {
            "kind": "drawn",
            "x_m": 50.0,
            "y_m": 30.0,
            "yaw_rad": 0.7,
            "speed_mps": 6.0,
            "yaw_rate_radps": -0.1,
        },
        {
            "kind": "drawn",
            "x_m": -40.0,
            "y_m": 45.0,
            "yaw_rad": 2.5,
            "speed_mps": 4.0,
            "yaw_rate_radps": 0.1,
        },
    ]
    sensor = {
        "name": "radar",
        "std": _DOPPLER_STD,
        "mount": dict(zip(("x_m", "y_m", "yaw_rad"), (*mount, 0.8), strict=True)),
        "max_range_m": 20_000.0,
        "delay": {"kind": "gamma", "min_s": 0.03, "mean_s": 0.062, "q90_s": 0.089},
    }
    raw = {
        "map": None,
        "duration_s": duration_s,
        "ego": {**ego, "motion": _STILL},
        "ego_messages": dict.fromkeys(exact, 0.0),
        "opponents": opponents,
        "sensors": [sensor],
    }
    return read_scenario(raw)


def lever_arm(seeds: int, duration_s: float) -> str:
    """Position RMSE, NEES and NIS of the smoother with and without an arm."""
    lines = [
        "| RADAR | position RMSE [m] | NEES (2) | NIS (3) |",
        "| --- | --- | --- | --- |",
    ]
    for name, mount in _ARMS_M.items():
        sensor = {
            "std": _DOPPLER_STD,
            "mount": {"x_m": mount[0], "y_m": mount[1], "yaw_rad": 0.8},
        }
        settings = {
            "sensors": {"radar": sensor},
            "birth.speed_std_mps": 20.0,
            "smoother.lagged_s": [],
        }
        found = []
        for seed in range(seeds):
            messages = fgtrack.simulate(turning_ego(mount, duration_s), seed=seed)
            found.append(evaluate(fgtrack.replay(messages, "open_space", set=settings)))
        rmse_m = [
            one.truth.overall.errors["position_m"].rmse for one in found if one.truth
        ]
        nees = [one.consistency.position_nees.mean for one in found]
        nis = [one.consistency.nis["radar"].mean for one in found]
        lines.append(
            f"| {name} | {' | '.join(f'{average(values):.3g}' for values in (rmse_m, nees, nis))} |"
        )
    return "\n".join(lines) + "\n"


def whiteness(seeds: int, duration_s: float) -> str:
    """Lag-1 correlation of the innovations on consistent noise, by estimator and sensor."""
    lines = [
        "| estimator | sensor | correlation at lag 1 | inside its band |",
        "| --- | --- | --- | --- |",
    ]
    for estimator in ("smoother", "ekf-replay", "ekf-backward-forward"):
        runs: list[Consistency] = []
        for seed in range(seeds):
            messages = fgtrack.simulate("drawn_ctrv", seed=seed, duration_s=duration_s)
            run = fgtrack.replay(
                messages,
                "open_space",
                estimator=estimator,
                set={"smoother.lagged_s": []},
            )
            runs.append(evaluate(run).consistency)
        for sensor in ("lidar_cluster", "radar"):
            found = [
                one for run in runs if (one := run.autocorrelation[sensor]) is not None
            ]
            inside = sum(abs(one.lag1) <= one.lag1_band for one in found)
            correlation = average([one.lag1 for one in found])
            lines.append(
                f"| {estimator} | {sensor} | {correlation:.3g} | {inside} of {seeds} |"
            )
    return "\n".join(lines) + "\n"


def printed(script: str, out: Path, jobs: int, options: Sequence[str]) -> str:
    """What an experiment prints; raises `subprocess.CalledProcessError` where it fails."""
    command = [
        sys.executable,
        str(HERE / script),
        "-o",
        str(out),
        "--jobs",
        str(jobs),
        *options,
    ]
    return subprocess.run(command, check=True, text=True, stdout=subprocess.PIPE).stdout


def main(
    out: Annotated[Path, typer.Option("-o", help="Folder of all tables.")] = Path(
        "out/fairness"
    ),
    quick: Annotated[
        bool, typer.Option(help="A few runs of each, to see that it works.")
    ] = False,
    jobs: Annotated[int, typer.Option(help="Processes.")] = 1,
) -> None:
    """Measure everything, write fairness.md."""
    out.mkdir(parents=True, exist_ok=True)
    seeds, duration_s = (2, 5.0) if quick else (10, 20.0)
    with (out / "fairness.md").open("w", encoding="utf-8") as file:

        def say(title: str, text: str) -> None:
            part = f"## {title}\n\n{text.strip()}\n\n"
            file.write(part)
            file.flush()
            print(part, end="", flush=True)

        say("lever arm of a sensor on a turning ego", lever_arm(seeds, duration_s))
        say(
            "whiteness of innovations on consistent noise", whiteness(seeds, duration_s)
        )
        for script, (question, short) in SCRIPTS.items():
            say(
                question,
                printed(script, out / Path(script).stem, jobs, short if quick else ()),
            )


if __name__ == "__main__":
    typer.run(main)
