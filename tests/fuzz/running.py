"""Runs commands on files that are not right, and looks at what they say and write."""

import re
import shutil
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from support.server import Outcome, Server

from fgtrack.estimation.failures import Failure
from fgtrack.runs import load_run
from fuzz.inputs import Files
from fuzz.targets import RUN, Target

MOST_MB, LONGEST_S, LONGEST_LINE = 2000.0, 20.0, 2000
#: What a user cannot read: exceptions that tell nothing of the file.
_OF_PYTHON = re.compile(
    r"\b(Key|Type|Attribute|Index|Assertion|Name|UnboundLocal|Recursion)Error\b"
)
_WARNING = re.compile(r"\.py:\d+: \w*Warning")


@cache
def healthy(target: Target) -> list[Files]:
    """The inputs of a target that are right; skips the test where the package that reads them is not installed."""
    if target.needs is not None:
        pytest.importorskip(target.needs, reason=f"{target.needs} is not installed")
    return list(target.healthy())


def problem_of(
    server: Server, target: Target, files: Files, folder: Path, right: bool = False
) -> str | None:
    """What is wrong with what the commands make of `files` in a new `folder`; `right` ones end with 0."""
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    for command in target.commands:
        done = server(command, folder, kill_after_s=10.0 * LONGEST_S)
        problem = _problem(done) or _problem_of_run(folder / RUN)
        if problem is None and right and done.code:
            problem = (
                f"exit code {done.code} for an input that is right: {done.said.strip()}"
            )
        if problem is not None:
            return f"{command[0]}: {problem}"
    shutil.rmtree(folder)
    return None


def _problem(done: Outcome) -> str | None:
    if (
        "internal error" in done.said
        or "Traceback" in done.said
        or _WARNING.search(done.said)
    ):
        return done.said.strip()[-600:]
    if _OF_PYTHON.search(done.said):
        return f"speaks of Python: {done.said.strip()[-600:]}"
    if done.code not in (0, 1, 2) or (done.code and not done.said.strip()):
        return f"exit code {done.code}, said {done.said!r}"
    for line in done.said.splitlines():
        if not line.isprintable() or (
            line.startswith("fgtrack: ") and len(line) > LONGEST_LINE
        ):
            return f"prints {line[:200]!r}"
    if done.cpu_s > LONGEST_S or done.peak_mb > MOST_MB:
        return f"takes {done.cpu_s:.0f} s and {done.peak_mb:.0f} MB"
    return None


def _problem_of_run(path: Path) -> str | None:
    """Dispositions that do not add up, states that are not finite."""
    if not (path / "meta.json").is_file():
        return None
    found = load_run(path)
    if not found.meta.get("complete"):
        return "leaves an incomplete run"
    counted = sum(sum(counts.values()) for counts in found.meta["counts"].values())
    if not len(found.updates) == counted == found.meta["detections_received"]:
        return f"{found.meta['detections_received']} detections, {counted} counted, {len(found.updates)} rows"
    hidden = (
        Failure.LIST_FAILED,
        Failure.ESTIMATOR_RAISED,
    )  # what the guards hide is a defect all the same
    if raised := [kind for kind in hidden if found.meta.get("failures", {}).get(kind)]:
        return f"{', '.join(raised)}: {found.meta['first_failure']}"
    for table in (found.tables["tracks"], found.tables["smoothed"]):
        for name in (
            "x_m",
            "y_m",
            "yaw_rad",
            "speed_mps",
            *(name for name in table if name.startswith("p_")),
        ):
            if not np.isfinite(table[name]).all():
                return f"{name} is not finite"
            if (
                name in ("p_x_x", "p_y_y", "p_yaw_yaw", "p_speed_speed")
                and not (table[name] > 0.0).all()
            ):
                return f"{name} is not positive"
    return None
