"""`fgtrack verify`: what keeps the contract and what does not."""

import json
import re

import numpy as np
import pytest

from fgtrack.cli.main import run
from fgtrack.estimation.base import Measurement, UpdateResult, UpdateStatus
from fgtrack.estimation.filters.replay import ReplayEkf
from fgtrack.estimation.registry import ESTIMATORS

Capture = pytest.CaptureFixture[str]


class Careless(ReplayEkf):
    """Ignores what is late."""

    def update(self, measurement: Measurement) -> UpdateResult:
        if self.window_ns[0] <= measurement.stamp_ns < self.window_ns[1]:
            return UpdateResult(
                UpdateStatus.OUT_OF_SEQUENCE, np.zeros(len(measurement.z)), 0.0
            )
        return super().update(measurement)


def test_the_command_prints_a_table_and_a_closing_line(capsys: Capture) -> None:
    assert run(["verify", "-e", "ekf-replay"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"all \d+ promises are kept", lines[-1])
    assert any("ekf-replay" in line and "any lag, any number" in line for line in lines)


def test_the_command_prints_json_and_nothing_else(capsys: Capture) -> None:
    assert run(["verify", "--json", "--estimator", "drop"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    values = json.loads(out)
    assert values.pop("promises") > 8
    assert values == {"met": True, "checked": ["drop"], "broken": {}}


def test_a_broken_promise_is_shown_with_its_measurements_and_fails_the_command(
    capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ESTIMATORS, "load", lambda name: Careless)
    assert run(["verify", "-e", "ekf-replay"]) == 1
    out, err = capsys.readouterr()
    assert (
        "ekf-replay: broken promise: it gives the dense joint posterior in any order"
        in out
    )
    assert "measurements in the order of arrival" in out
    assert re.fullmatch(r"fgtrack: error: [1-9]\d* of \d+ promises are broken\n", err)
    assert run(["verify", "-e", "ekf-replay", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["met"] is False


def test_an_estimator_that_does_not_exist_cannot_be_verified(capsys: Capture) -> None:
    assert run(["verify", "-e", "drops"]) == 2
    assert "drops" in capsys.readouterr().err
