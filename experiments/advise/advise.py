"""Does following `fgtrack advise` lower the error?

    python experiments/advise/advise.py -o out/advise [--autoferry DIR] [--kitti DIR]

Replays recordings with a configuration, and with the one that the advice writes for it, and judges both against truth.
"""

import csv
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated

import typer
from joblib import Parallel, delayed

import fgtrack
from fgtrack import (
    Config,
    DetectionList,
    Message,
    Run,
    evaluate,
    nanoseconds,
    write_recording,
)
from fgtrack.evaluation import average, paired
from fgtrack.sim import restamped

OFFSET_S = 0.08
SEEDS = 8


@dataclass(frozen=True)
class Case:
    """A kind of recording, and what it is replayed with first."""

    name: str
    scenario: str
    config: str
    wrong: str | None = None
    """The sensor whose clock is ahead."""
    tune: bool = False


CASES = (
    Case("radar clock + 80 ms", "default", "smoother", "radar"),
    Case("lidar clock + 80 ms", "default", "smoother", "lidar_cluster"),
    Case("bursts", "bursts", "smoother"),
    Case("bursts, karle2023", "bursts", "karle2023"),
    Case("bursts, --tune", "bursts", "smoother", tune=True),
    Case("healthy", "default", "tuned"),
)


def shifted(messages: Iterator[Message], sensor: str | None) -> Iterator[Message]:
    """`messages` with the clock of `sensor` ahead."""
    for message in messages:
        if isinstance(message, DetectionList) and message.sensor == sensor:
            message = restamped(message, message.stamp_ns + nanoseconds(OFFSET_S))
        yield message


@dataclass(frozen=True)
class Followed:
    """Position RMSE and GOSPA in metres, and identity switches, before and after."""

    rmse_m: float
    gospa_m: float
    switches: int
    rmse_followed_m: float
    gospa_followed_m: float
    switches_followed: int
    changes: str
    noise: str
    """Sensors whose noise does not fit."""


def scores(run: Run) -> tuple[float, float, int]:
    """Position RMSE and GOSPA in metres, and identity switches."""
    found = evaluate(run)
    assert found.truth is not None
    assert found.multi_object is not None
    overall = found.truth.overall
    return (
        overall.errors["position_m"].rmse,
        found.multi_object.gospa["rms_m"],
        overall.id_switches,
    )


def followed(
    recording: Path, config: str | None, track_map: str | None, tune: bool
) -> Followed:
    """Scores before and after the advice is followed, and what it changes."""
    resolved = Config.from_yaml(config).replace(
        {"map.track": track_map, "map.pit": track_map}
    )
    if resolved.estimator == "smoother":  # the same numbers, sooner
        resolved = replace(resolved, estimator="smoother-banded")
    advice = fgtrack.advise(recording, resolved, tune=tune)
    if any(
        one.key == "ignore_sensors" for one in advice.changes
    ):  # without which nothing can be replayed
        resolved = replace(resolved, ignore_sensors=advice.config.ignore_sensors)
    before, after = (
        scores(fgtrack.replay(recording, one)) for one in (resolved, advice.config)
    )
    changes = "; ".join(f"{one.key}={one.value}" for one in advice.changes) or "nothing"
    noise = (
        ", ".join(one.about for one in advice.findings if one.kind == "noise") or "none"
    )
    return Followed(*before, *after, changes, noise)


def simulated(
    case: Case, seed: int, duration_s: float | None, out: Path
) -> tuple[Case, int, Followed]:
    """One case with one seed."""
    recording = (
        out / f"{case.scenario}-{case.wrong}-{case.config}-{case.tune}-{seed}.jsonl"
    )
    messages = fgtrack.simulate(case.scenario, seed=seed, duration_s=duration_s)
    write_recording(recording, shifted(messages, case.wrong), overwrite=True)
    found = followed(recording, case.config, "oval", case.tune)
    recording.unlink()
    return case, seed, found


def recorded(
    autoferry: Path | None, kitti: Path | None
) -> Iterator[tuple[str, Path, str | None, bool]]:
    """Names and paths of recordings, their configurations, and whether noise is fitted."""
    for number in range(6, 1, -1) if autoferry is not None else ():
        folder = Path(str(autoferry)) / f"scenario{number}"
        yield f"Autoferry {number}, defaults", folder, None, True
        yield f"Autoferry {number}, autoferry", folder, "autoferry", True
    for file in sorted((kitti / "oxts").glob("*.txt")) if kitti is not None else ():
        yield f"KITTI {file.stem}, defaults", file, None, True
        yield f"KITTI {file.stem}, kitti", file, "kitti", True


def main(
    out: Annotated[Path, typer.Option("-o", help="Folder of the tables.")] = Path(
        "out/advise"
    ),
    seeds: Annotated[int, typer.Option(help="Seeds of each simulated case.")] = SEEDS,
    duration: Annotated[
        float | None, typer.Option(help="Length of simulated recordings in s.")
    ] = None,
    autoferry: Annotated[
        Path | None, typer.Option(help="Folder of the Autoferry scenarios.")
    ] = None,
    kitti: Annotated[
        Path | None, typer.Option(help="Folder of the KITTI tracking data.")
    ] = None,
    jobs: Annotated[int, typer.Option(help="Processes.")] = 1,
) -> None:
    """Write advise.csv: position RMSE and GOSPA before and after."""
    out.mkdir(parents=True, exist_ok=True)
    rows = list(
        Parallel(n_jobs=jobs)(
            delayed(simulated)(case, seed, duration, out)
            for case in CASES
            for seed in range(1, seeds + 1)
        )
    )
    names = [one.name for one in fields(Followed)]
    with (out / "advise.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["recording", "seed", *names])
        for case, seed, found in rows:
            writer.writerow(
                [case.name, seed, *(getattr(found, name) for name in names)]
            )
        for name, path, config, tune in recorded(autoferry, kitti):
            found = followed(path, config, None, tune)
            writer.writerow([name, "", *(getattr(found, one) for one in names)])
            print(
                f"{name}: RMSE {found.rmse_m:.3f} -> {found.rmse_followed_m:.3f} m, GOSPA {found.gospa_m:.3f} -> "
                f"{found.gospa_followed_m:.3f} m, switches {found.switches} -> {found.switches_followed}, "
                f"changed {found.changes}, noise {found.noise}",
                flush=True,
            )
    for case in CASES:
        mine = [found for one, _, found in rows if one == case]
        for what in ("rmse", "gospa") if mine else ():
            old, new = (
                [getattr(one, f"{what}{side}_m") for one in mine]
                for side in ("", "_followed")
            )
            gain = paired(new, old)
            print(
                f"{case.name}: {what} {average(old).mean:.3f} -> {average(new).mean:.3f} m, "
                f"change {gain.mean:+.3f} ({gain.low:+.3f} to {gain.high:+.3f})"
            )


if __name__ == "__main__":
    typer.run(main)
