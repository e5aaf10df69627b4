"""Makes `tests/support` importable as `support`, keeps BLAS to one thread, sets how many examples hypothesis draws."""

import os
import sys
from pathlib import Path

import pytest
from hypothesis import settings

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parent))

# The same examples at every run, and few; `--hypothesis-profile=thorough` draws others every time.
settings.register_profile("fast", deadline=None, derandomize=True, max_examples=25)
settings.register_profile("thorough", deadline=None, max_examples=200)
settings.load_profile("fast")

_NIGHTLY = ("_experiment", "_benchmark")
# Units that take seconds of processor time each; `make test-fast` leaves them out.
_LONG = (
    "assumed", "backward_forward", "bearing_sensors", "correlated_errors", "coverage", "crowds", "damping", "entry",
    "evaluation_consistency", "evaluation_figures", "evaluation_tables", "evaluation_visibility", "extent",
    "figure_paper", "figure_texts", "figure_views", "geodetic", "identity", "initiated", "language", "ledger",
    "likelihood", "live", "persistence", "recordings", "replay_bank", "revisits", "run_folder", "run_memory",
    "running", "sim_redelay", "sim_simulate", "singular_noise", "supply_chain", "sweep_config", "sweep_figures",
)  # fmt: skip


def pytest_addoption(parser: pytest.Parser) -> None:
    """How long `tests/fuzz` goes on, how often `tests/faults` kills, and with which random numbers."""
    parser.addoption(
        "--fuzz-seconds",
        type=float,
        default=10.0,
        help="time for each target of the fuzzing tests",
    )
    parser.addoption(
        "--fuzz-seed", type=int, default=0, help="seed of the fuzzing tests"
    )
    parser.addoption(
        "--changes",
        type=int,
        default=1000,
        help="values that tests/fuzz/test_values.py changes",
    )
    parser.addoption(
        "--kills", type=int, default=3, help="kills of each command in tests/faults"
    )


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark whole folders and the experiments as slow, for the night, and the long units."""
    for item in items:
        if item.path.parent.name in (
            "faults",
            "statistical",
        ) or item.path.stem.endswith(_NIGHTLY):
            item.add_marker(pytest.mark.slow)
        if (
            item.path.parent.name == "unit"
            and item.path.stem.removeprefix("test_") in _LONG
        ):
            item.add_marker(pytest.mark.long)
