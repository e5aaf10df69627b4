"""Tables without settings, as other programs write them: roles, times and columns are found."""

import math
from datetime import UTC, datetime

import pytest

from fgtrack.core.types import DetectionList, EgoState
from fgtrack.meaning.draft import opened

START_S = 1_700_000_000


def at(k, form):
    return datetime.fromtimestamp(START_S + 0.1 * k, UTC).strftime(form)


def drive(folder, ego, radar, time):
    """Folder with an ego on a straight road and a RADAR; `ego` gives the cells of a position."""
    folder.mkdir(exist_ok=True)
    head, cells = ego
    lines = [
        f"{time[0]},{head}",
        *(f"{time[1](k)},{cells(2.0 * k)}" for k in range(100)),
    ]
    (folder / "ego.csv").write_text("\n".join(lines) + "\n")
    rows = [
        f"{time[1](k)},{20.0 + 5.0 * i},{2.0 * i + 0.01 * (k % 7)}{radar}"
        for k in range(100)
        for i in range(3)
    ]
    (folder / "radar.csv").write_text(f"{time[0]},x,y\n" + "\n".join(rows) + "\n")
    return folder


EPOCH = ("time", lambda k: START_S + 0.1 * k)
FULL = ("x,y,yaw,speed", lambda x: f"{x},0,0,20")
TIMES = {
    "epoch": EPOCH,
    "iso": ("Timestamp", lambda k: at(k, "%Y-%m-%dT%H:%M:%S.%fZ")),
    "comma": ("time", lambda k: f'"{at(k, "%Y-%m-%d %H:%M:%S,%f")}"'),
    "danish": ("# Timestamp", lambda k: at(k, "%d/%m/%Y %H:%M:%S.%f")),
    "american": ("datetime", lambda k: at(k, "%m/%d/%Y %I:%M:%S.%f %p")),
    "german": ("Time", lambda k: at(k, "%d.%m.%Y %H:%M:%S.%f")),
    "matlab": ("t", lambda k: at(k, "%d-%b-%Y %H:%M:%S.%f")),
    "of day": ("time", lambda k: at(k, "%H:%M:%S.%f")),
    "two columns": ("Date,Time", lambda k: at(k, "%Y-%m-%d,%H:%M:%S.%f")),
    "two others": ("Time,Date", lambda k: at(k, "%H:%M:%S.%f,%d.%m.%Y")),
}


@pytest.mark.parametrize("name", TIMES)
def test_times_of_other_programs_are_found(tmp_path, name):
    draft = opened(drive(tmp_path / "a", FULL, "", TIMES[name]))
    messages = list(draft.source.messages())
    egos = [each for each in messages if isinstance(each, EgoState)]
    lists = [each for each in messages if isinstance(each, DetectionList)]
    assert (len(egos), len(lists)) == (100, 100)
    assert egos[10].stamp_ns - egos[0].stamp_ns == pytest.approx(1e9, abs=1e3)
    if name != "of day":
        assert egos[0].stamp_ns == START_S * 10**9


EGOS = {
    "without speed": ("x,y,yaw", lambda x: f"{x},0,0"),
    "quaternion": ("px,py,pz,qx,qy,qz,qw", lambda x: f"{x},0,0,0,0,0,1"),
    "of another order": ("qw,qx,qy,qz,tx_m,ty_m,tz_m", lambda x: f"1,0,0,0,{x},0,0"),
    "positions": ("x,y", lambda x: f"{x},0"),
    "geodetic": ("lat,lon", lambda x: f"48.0,{11.0 + x / 74_600.0:.9f}"),
    "tiny degrees": (
        "latitude,longitude",
        lambda x: f"480000000,{round(1.1e8 + x / 74_600e-7)}",
    ),
    "km/h": ("X [m],Y [m],Heading [deg],Speed [km/h]", lambda x: f"{x},0,0,72"),
    "a wrong unit": ("x,y,yaw,speed_kmh", lambda x: f"{x},0,0,20"),
}


@pytest.mark.parametrize("name", EGOS)
def test_an_ego_without_speed_or_heading_is_found(tmp_path, name):
    draft = opened(drive(tmp_path / "a", EGOS[name], "", EPOCH))
    egos = [each for each in draft.source.messages() if isinstance(each, EgoState)]
    assert len(egos) == 100
    for each in egos:
        assert each.speed_mps == pytest.approx(20.0, rel=0.02)
        assert math.remainder(each.yaw_rad, math.tau) == pytest.approx(0.0, abs=0.01)


def test_a_trailing_comma_and_an_unnamed_column_are_no_obstacle(tmp_path):
    draft = opened(drive(tmp_path / "a", FULL, ",", EPOCH))
    lists = [
        each for each in draft.source.messages() if isinstance(each, DetectionList)
    ]
    assert len(lists) == 100


def test_a_trajectory_as_text_is_an_ego(tmp_path):
    rows = "".join(f"{START_S + 0.1 * k} {2.0 * k} 0 0 0 0 0 1\n" for k in range(50))
    (tmp_path / "ego.txt").write_text(rows)
    draft = opened(tmp_path)
    egos = list(draft.source.messages())
    assert len(egos) == 50
    assert egos[30].speed_mps == pytest.approx(20.0)


def test_messages_of_an_adsb_receiver_need_no_header(tmp_path):
    rows = "".join(
        f"MSG,3,1,1,4CA1FA,1,2023/11/14,22:13:{20 + k}.100,2023/11/14,22:13:{20 + k}.500,"
        f",35000,,,{51.0 + 1e-3 * k:.5f},0.10000,,,0,0,0,0\n"
        for k in range(30)
    )
    (tmp_path / "adsb.csv").write_text(rows)
    lists = list(opened(tmp_path / "adsb.csv").source.messages())
    assert len(lists) == 30
    assert {each.sensor for each in lists} == {"adsb"}
    assert {each.receipt_ns - each.stamp_ns for each in lists} == {4 * 10**8}
    assert lists[0].stamp_ns == START_S * 10**9 + 10**8
    assert lists[0].objects[0].id == "4CA1FA"


def test_notes_and_lists_of_labels_are_no_tables(tmp_path):
    (tmp_path / "README.txt").write_text(
        "A drive, on Monday.\n\nNothing happened, really.\n"
    )
    drive(tmp_path / "a", FULL, "", EPOCH)
    (tmp_path / "a" / "notes.txt").write_text("rain, 12 degrees\nno wind\n")
    assert len(opened(tmp_path / "a").parts) == 2
