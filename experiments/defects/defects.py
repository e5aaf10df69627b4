"""What each defect of the published code costs: one component switched at a time.

    python experiments/defects/defects.py STREAM --map TRACK.csv --pit-map PIT.csv -o OUT

Every defect is switched twice: repaired in the published tracker, and added to the clean one. The map buffers,
the birth covariance and all parameters are the same everywhere.
"""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from fgtrack import Config, Run, evaluate, replay

CONFIGS = Path(__file__).parents[2] / "configs"

#: Defect -> its name under `defects`, or the sections of the configuration that hold it, with the keys there.
DEFECTS: dict[str, str | dict[str, list[str]]] = {
    "Q2 yaw sticks at its limit": "saturated_yaw",
    "Q3 heading interpolated through its jump": "heading_jump",
    "Q3, Q4 whole map look-up": "heading_jump",
    "Q5 acceleration drives the speed": {"motion": ["std_per_s"]},
    "Q6 noise per step": "noise_per_step",
    "Q8 present state not stored": "stale_present",
    "Q9, Q15, Q22 ageing": {"lifecycle": [], "sensors": []},
    "Q10 gate after the assignment": {"association": []},
    "Q11 merge not transitive": {"merge": []},
    "Q12 one slot per sensor": "one_slot",
    "Q13 ego filtered again and again": "refiltered_ego",
    "Q14 tracking time leads the clock": "leading_clock",
}
#: Q3 alone is the step between the published look-up and the same with the heading on the circle.
HEADING = "Q3 heading interpolated through its jump"


def switched(config: Config, other: Config, defect: str) -> Config:
    """`config` with the parts that hold `defect` taken from `other`."""
    parts = DEFECTS[defect]
    if isinstance(parts, str):
        mine = set(config.defects) - {parts} | ({parts} & set(other.defects))
        return replace(config, defects=tuple(sorted(mine)))
    for section, keys in parts.items():
        part = getattr(other, section)
        if keys:
            part = replace(
                getattr(config, section), **{key: getattr(part, key) for key in keys}
            )
        config = replace(config, **{section: part})
    return config


def variants(published: Config, clean: Config) -> dict[str, Config]:
    """All configurations by name."""
    found = {"published": published, "clean": clean}
    for defect in DEFECTS:
        if defect == HEADING:
            circular = tuple(
                sorted({*published.defects, "circular_heading"} - {"heading_jump"})
            )
            found[f"published without {defect}"] = replace(published, defects=circular)
            continue
        found[f"published without {defect}"] = switched(published, clean, defect)
        found[f"clean with {defect}"] = switched(clean, published, defect)
    return found


def row(name: str, run: Run) -> str:
    """A line of the table."""
    metrics = evaluate(run)
    assert metrics.truth is not None, "the stream has no truth"
    errors = metrics.truth.overall.errors
    cells = [
        f"{errors[part].rmse:.3f}" for part in ("position_m", "along_m", "across_m")
    ]
    cells.append(f"{errors['yaw_rad'].rmse:.4f}")
    cells.append(f"{errors['speed_mps'].rmse:.2f}")
    for sensor in ("lidar_cluster", "radar"):
        residuals = metrics.sensors[sensor].residuals
        cells.append(
            " / ".join(f"{residuals[part].std:.3f}" for part in ("along_m", "across_m"))
        )
    cells += [
        str(metrics.num_tracks),
        str(metrics.num_confirmed),
        f"{100 * metrics.truth.overall.tracked_share:.1f}",
    ]
    return f"| {name} | " + " | ".join(cells) + " |"


def main(
    stream: Path,
    track_map: Annotated[str, typer.Option("--map")],
    pit_map: Annotated[str, typer.Option("--pit-map")],
    out: Annotated[Path, typer.Option("-o", "--out")] = Path("out/defects"),
) -> None:
    """Print the table as Markdown; the runs stay in OUT."""
    maps = {"map.track": track_map, "map.pit": pit_map}
    published = Config.from_yaml(CONFIGS / "karle2023_reference.yaml").replace(maps)
    clean = Config.from_yaml(CONFIGS / "karle2023.yaml").replace(maps)
    print(
        "| tracker | position [m] | along [m] | across [m] | yaw [rad] | speed [m/s] "
        "| LiDAR residual std along / across [m] | RADAR residual std along / across [m] "
        "| tracks | confirmed | tracked [%] |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for number, (name, config) in enumerate(variants(published, clean).items()):
        run = replay(stream, config, out=out / f"{number:02d}")
        print(row(name, run), flush=True)


if __name__ == "__main__":
    typer.run(main)
