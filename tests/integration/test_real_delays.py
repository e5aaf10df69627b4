"""The experiment with recordings that were late by themselves: its judge, and a recording where it is there."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fgtrack.core.types import Detection, DetectionList
from tests.support.scripts import load

DATA = Path(__file__).resolve().parents[2] / "../shared/data/real_delays"
S = 10**9
experiment = load("real_delays")


def test_the_judge_fits_all_reports_but_the_last_one_that_had_been_received():
    times_s = np.arange(20.0)
    x_m = 3.0 + 2.0 * times_s + 0.5 * times_s**2
    lists = [
        DetectionList(
            "adsb",
            round(t * S),
            round((t + 0.5) * S),
            (Detection(x, -x, id="A"),),
            "map",
        )
        for t, x in zip(times_s.tolist(), x_m.tolist(), strict=True)
    ]
    copy = replace(
        lists[10], stamp_ns=lists[10].stamp_ns + S, receipt_ns=lists[10].receipt_ns + S
    )
    far = replace(lists[9], objects=(Detection(1e4, 1e4, id="A"),))
    standing = [
        replace(each, objects=(Detection(7.0, 0.02 * k, id="B"),))
        for k, each in enumerate(lists)
    ]
    judge = experiment.Judge([*lists[:9], far, *lists[10:], copy, *standing], 5.0)
    assert len(judge.reports["A"]) == 20
    exact = pytest.approx([76.03125, -76.03125], abs=1e-6)
    assert (
        judge.position_m("A", 10.25, 9.7) == exact
    )  # without what was received at 9.5
    assert judge.position_m("A", 10.25, 8.7) != exact
    assert judge.position_m("A", 0.0, 30.0) is None
    assert judge.position_m("B", 10.25, 9.7) is None


@pytest.mark.skipif(not DATA.is_dir(), reason="needs ../shared/data/real_delays")
def test_dropping_costs_nothing_where_reports_come_in_order(monkeypatch):
    monkeypatch.setattr(experiment, "POLICIES", ("drop", "ekf-replay"))
    recording = replace(experiment.RECORDINGS["car over 5G"], longest_s=20.0)
    dropped, replayed = experiment.policies("car", recording, DATA)
    assert dropped["moments"] == replayed["moments"] > 50
    assert replayed["less_than_drop_m"] == pytest.approx(0.0, abs=1e-6)
    assert 0.0 < replayed["error_3s_m"] < replayed["error_0s_m"] < 1.0
    assert replayed["gaps"] == 0.0
