"""How often do the intervals of `fgtrack tune` contain the true noise?

    python experiments/advise/noise_intervals.py --fits 100

Draws tracks of CTRV, whose positions two sensors measure in turn, fits the noise from a wrong start, and prints for
each standard deviation in how many fits it is known at least roughly, and how many of these intervals contain it.
"""

from typing import Annotated

import numpy as np
import typer

from fgtrack import (
    CTRV,
    FloatArray,
    Measurement,
    Start,
    initial_state,
    nanoseconds,
    rotation,
)
from fgtrack.noise.likelihood.fit import Problem
from fgtrack.noise.likelihood.series import NoiseSpace, Observation, Series

START = Start(
    position_m=(3.0, -2.0),
    yaw_rad=0.3,
    yaw_std_rad=0.2,
    speed_mps=20.0,
    speed_std_mps=2.0,
)
SPACE = NoiseSpace(
    ("position", "yaw", "speed", "yaw_rate"),
    lambda std: CTRV.from_std_per_step(std, 1.0),
    {"lidar": ("x_m", "y_m"), "radar": ("x_m", "y_m")},
)
NAMES = *SPACE.motion_names, "lidar x", "lidar y", "radar x", "radar y"
#: Of `NAMES`, and odds of outliers too small to count.
TRUE = np.array([0.2, 0.1, 1.0, 0.5, 0.5, 0.3, 1.5, 1.0, 1e-60, 1e-60])
WRONG = np.array([0.4, 0.3, 2.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.01, 0.01])
TRACKS, MEASUREMENTS = 2, 200
ROUGHLY, QUANTILE = 0.5, 1.96


def drawn(rng: np.random.Generator) -> Series:
    motion = SPACE.motion_model(TRUE)
    x, before_s, seen = (
        rng.multivariate_normal(*initial_state(motion, START)),
        0.0,
        list[Observation](),
    )
    for k in range(MEASUREMENTS):
        stamp_s, sensor, axes, nothing = (
            0.1 * (k - k % 7 % 2),
            k % 2,
            rotation(0.01 * k),
            np.zeros((2, 2)),
        )
        if stamp_s > before_s:
            Q = motion.process_noise(x, stamp_s - before_s)
            x = rng.multivariate_normal(
                motion.predict(x, stamp_s - before_s), Q, method="eigh"
            )
        before_s = stamp_s
        z = x[:2] + axes @ (
            TRUE[4 + 2 * sensor : 6 + 2 * sensor] * rng.standard_normal(2)
        )
        own = Measurement.of(
            nanoseconds(stamp_s), x_m=z[0], y_m=z[1], std={"x_m": 1.0, "y_m": 1.0}
        ).seen_by(motion)
        seen.append(
            Observation(
                ("lidar", "radar")[sensor], own, (0, 1), (), axes, nothing, nothing
            )
        )
    return Series(START, seen)


def fitted(seed: int) -> tuple[FloatArray, FloatArray]:
    """Errors of the logarithms of `NAMES`, and their standard errors."""
    rng = np.random.default_rng([11, seed])
    tracks = [drawn(rng) for _ in range(TRACKS)]
    values, likelihood = Problem(tracks, SPACE, WRONG).maximum(
        WRONG, np.ones(len(WRONG), dtype=bool)
    )
    return np.log(values / TRUE)[: len(NAMES)], likelihood.log_std(np.log(values))[
        : len(NAMES)
    ]


def main(fits: Annotated[int, typer.Option(help="Number of fits.")] = 100) -> None:
    errors, stds = map(
        np.array, zip(*(fitted(seed) for seed in range(fits)), strict=True)
    )
    for name, error, std in zip(NAMES, errors.T, stds.T, strict=True):
        known = std <= ROUGHLY
        inside, factor = np.abs(error) <= QUANTILE * std, np.exp(error[known].mean())
        print(
            f"{name}: known in {known.sum()} of {fits}, inside in {inside[known].sum()}, times {factor:.2f}",
            flush=True,
        )


if __name__ == "__main__":
    typer.run(main)
