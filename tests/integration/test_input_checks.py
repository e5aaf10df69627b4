"""`info -c`: a configuration that does not fit the recording is found out before a replay."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from support.messages import drive
from typer.testing import CliRunner

from fgtrack.cli.main import app
from fgtrack.config.settings import Config
from fgtrack.config.yaml_file import dump, validate
from fgtrack.core.types import Detection, DetectionList, EgoState, Message
from fgtrack.inputs.stream import write_stream
from fgtrack.meaning.input_checks import first_contents, input_checks

CONFIG = validate(
    Config,
    {
        "sensors": {
            "lidar": {"std": {"x_m": 0.3, "y_m": 0.3}},
            "radar": {"std": {"x_m": 1.0, "y_m": 1.0}},
        },
        "ego": {"detection_origin_x_m": 0.0},
    },
    "test",
)


def changed(
    change: Callable[[DetectionList], DetectionList], messages: Iterable[Message]
) -> list[Message]:
    return [
        change(item) if isinstance(item, DetectionList) else item for item in messages
    ]


def with_objects(item: DetectionList, **fields: object) -> DetectionList:
    return replace(item, objects=[replace(each, **fields) for each in item.objects])


def found(messages: list[Message], config: Config = CONFIG) -> list[str]:
    return list(map(str, input_checks(messages, config)))


def test_nothing_is_said_of_a_healthy_drive():
    assert found(drive()) == []
    shown = first_contents(drive())
    assert shown["radar (in the frame ego)"] == "x_m 31, y_m 1.5, speed_mps -4"
    assert shown["ego"].startswith("x_m 0, y_m 0, yaw_rad 0.25, speed_mps 50")
    assert set(shown) == {
        "ego",
        "truth",
        "lidar (in the frame ego)",
        "radar (in the frame ego)",
    }


def test_stamps_of_zero_are_found():
    zero = changed(lambda item: replace(item, stamp_ns=0), drive())
    (lidar, radar) = found(zero)
    assert lidar.startswith("lidar: all stamps are 0: set `stamp_from: receipt`")
    assert radar.startswith("radar: all stamps are 0")
    egos = [
        replace(item, stamp_ns=0) if isinstance(item, EgoState) else item
        for item in drive()
    ]
    assert any(line.startswith("ego: all stamps are 0") for line in found(egos))


def test_a_missing_ego_is_found():
    without = [item for item in drive() if not isinstance(item, EgoState)]
    (line,) = found(without)
    assert (
        line
        == "ego: no ego state is read, but lidar is relative to the ego: set its topic (input.ego)"
    )
    in_map = changed(lambda item: replace(item, frame="map"), without)
    assert found(in_map) == []


def test_degrees_for_radians_are_found():
    turned = changed(lambda item: with_objects(item, yaw_rad=45.0), drive())
    lines = found(turned)
    assert [line.partition(":")[0] for line in lines] == ["lidar", "radar"]
    assert (
        "yaw_rad reaches 45, so it is probably in degrees: convert it by `{path: ..., degrees: true}`"
        in lines[0]
    )
    egos = [
        replace(item, yaw_rad=180.0) if isinstance(item, EgoState) else item
        for item in drive()
    ]
    assert found(egos) == [
        "ego: yaw_rad reaches 180, so it is probably in degrees: convert it by `{path: ..., degrees: true}`"
    ]


def far(messages: Iterable[Message]) -> Iterator[Message]:
    """The same drive a kilometre from the origin of the map."""
    for item in messages:
        yield (
            replace(item, x_m=item.x_m + 1000.0) if isinstance(item, EgoState) else item
        )


def test_a_wrong_frame_is_found():
    as_map = changed(lambda item: replace(item, frame="map"), far(drive()))
    lines = found(as_map)
    assert lines[0].startswith("lidar: detections are read in the map, 98")
    assert lines[0].endswith("set `frame: ego` (or sensor)")
    moved = changed(
        lambda item: replace(item, objects=[Detection(x_m=1030.0, y_m=1.0)]),
        far(drive()),
    )
    lines = found(moved)
    assert lines[0].startswith(
        "lidar: detections are read in the frame ego, 1030 m away"
    )
    assert lines[0].endswith("set `frame: map`")
    assert found(list(far(drive()))) == []


def test_components_that_are_never_measured_are_found():
    config = validate(
        Config,
        {
            "sensors": {
                "lidar": {"std": {"x_m": 1.0, "y_m": 1.0}},
                "radar": {"std": {"range_m": 1.0, "bearing_rad": 0.1}},
            }
        },
        "x",
    )
    (line,) = found(drive(), config)
    assert line.startswith(
        "radar: never measures range_m, bearing_rad in its std, only x_m, y_m, speed_mps"
    )


def info(recording: Path, config: Path) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["info", str(recording), "-c", str(config)])
    return done.exit_code, f"{done.output} {done.exception}"


def test_the_command_shows_what_is_read_and_what_becomes_of_it(tmp_path):
    write_stream(tmp_path / "drive.jsonl", drive())
    (tmp_path / "c.yaml").write_text(dump(CONFIG))
    code, text = info(tmp_path / "drive.jsonl", tmp_path / "c.yaml")
    assert code == 0
    assert "first of radar (in the frame ego): x_m 31, y_m 1.5, speed_mps -4" in text
    assert "first 5 s of radar: 9 detections in 10 lists" in text
