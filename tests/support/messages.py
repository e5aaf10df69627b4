"""Made-up messages for tests, and where the shared recordings are."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fgtrack.core.types import (
    DESCRIBING,
    MEASURABLE,
    Detection,
    DetectionList,
    EgoState,
    Message,
    TruthState,
)

SHARED = Path(__file__).resolve().parents[2] / "../shared"
START_NS = 1_700_000_000_000_000_000

times_ns = st.integers(0, (1 << 31) * 1_000_000_000 - 1)
numbers = st.floats(allow_nan=True, allow_infinity=True)
finite = st.floats(allow_nan=False, allow_infinity=False)
ids = st.integers(-(1 << 63), (1 << 63) - 1)


def shared(path: str) -> Path:
    """Path of shared data; skips the test where there is none."""
    found = SHARED / path
    if not found.exists():
        pytest.skip(f"shared data {path} is not on this machine")
    return found


def exact(messages: list[Message]) -> list[str]:
    """Text of every message; equal texts are equal to the bit, NaN and -0.0 included."""
    return [repr(message) for message in messages]


@st.composite
def detections(draw: st.DrawFn) -> Detection:
    names = draw(st.sets(st.sampled_from(MEASURABLE)))
    size = len(names) ** 2
    return Detection(
        **{name: draw(numbers) for name in names},
        covariance=draw(
            st.none() | st.lists(numbers, min_size=size, max_size=size).map(tuple)
        ),
        stamp_ns=draw(st.none() | times_ns),
        object_id=draw(st.none() | ids),
        **{
            name: draw(st.none() | finite)
            for name in DESCRIBING
            if name not in ("class_name", "id")
        },  # a reader gives no other
        class_name=draw(st.none() | st.sampled_from(["", "car", "Straßenbahn, 2"])),
        id=draw(st.none() | st.sampled_from(["4CA911", "244710820"])),
    )


@st.composite
def message_lists(draw: st.DrawFn) -> list[Message]:
    """Messages of all kinds in receipt order, often several at one time."""
    receipts_ns = sorted(
        draw(st.lists(st.one_of(times_ns, st.integers(0, 3)), max_size=8))
    )
    messages: list[Message] = []
    for receipt_ns in receipts_ns:
        times = (draw(times_ns), receipt_ns)
        match draw(st.integers(0, 2)):
            case 0:
                state = [draw(numbers) for _ in range(6)]
                covariance = draw(
                    st.none() | st.lists(numbers, min_size=25, max_size=25).map(tuple)
                )
                messages.append(
                    EgoState(
                        *times, *state, draw(st.none() | st.booleans()), covariance
                    )
                )
            case 1:
                optional = [draw(st.none() | numbers) for _ in range(4)]
                outline = draw(
                    st.none()
                    | st.lists(st.floats(-1e9, 1e9), min_size=6, max_size=6).map(tuple)
                )
                position = (draw(numbers), draw(numbers))
                messages.append(
                    TruthState(
                        *times,
                        draw(ids),
                        *position,
                        *optional,
                        draw(st.booleans()),
                        outline,
                    )
                )
            case _:
                objects = tuple(draw(st.lists(detections(), max_size=3)))
                sensor = draw(st.sampled_from(["lidar", "front radar", "Kamera ü"]))
                frame = draw(st.sampled_from(["map", "ego", "sensor"]))
                messages.append(DetectionList(sensor, *times, objects, frame))
    return messages


def drive(num_ticks: int = 50) -> list[Message]:
    """A short drive: ego at 100 Hz, lidar and radar at 20 Hz and late, truth; some lists are empty."""
    messages: list[Message] = []
    for tick in range(num_ticks):
        now_ns = START_NS + tick * 10_000_000
        x_m = 0.5 * tick
        messages.append(TruthState(now_ns, now_ns, 7, x_m + 30.0, 1.0, 0.1, 40.0))
        messages.append(TruthState(now_ns, now_ns, -1, x_m, 0.0, 0.0, 50.0))
        messages.append(EgoState(now_ns, now_ns, x_m, 0.0, 0.25, 50.0, 0.1, -0.5))
        if tick % 5 == 0:
            stamp_ns = now_ns - 60_000_000
            lidar = (
                ()
                if tick % 10 == 0
                else (Detection(x_m=30.0, y_m=1.0, yaw_rad=-0.2, object_id=3),)
            )
            radar = () if tick == 0 else (Detection(x_m=31.0, y_m=1.5, speed_mps=-4.0),)
            messages.append(DetectionList("lidar", stamp_ns, now_ns, lidar))
            messages.append(DetectionList("radar", stamp_ns - 7, now_ns, radar))
    return messages


def standing(
    count: int,
    *,
    sensor: str = "lidar",
    x_m: float = 20.0,
    delay_ms: int = 50,
    ego_x_m: float = 0.0,
) -> list[Message]:
    """An ego at rest and one car that drives off ahead of it, seen by a sensor every 20 ms."""
    messages: list[Message] = []
    for k in range(count):
        now_ns = START_NS + k * 20_000_000
        messages.append(EgoState(now_ns, now_ns, ego_x_m, 0.0, 0.0, 0.0))
        car = Detection(x_m=x_m + 0.1 * k, y_m=1.0, yaw_rad=0.0)
        messages.append(
            DetectionList(sensor, now_ns - delay_ms * 1_000_000, now_ns, (car,))
        )
    return messages


def tilted(yaw_rad: float, pitch_rad: float = 0.3, roll_rad: float = 0.2) -> np.ndarray:
    """Quaternion w, x, y, z of a yaw after a pitch after a roll, which leave the yaw as it is."""
    x, y, z, w = Rotation.from_euler("ZYX", [yaw_rad, pitch_rad, roll_rad]).as_quat()
    return np.array([w, x, y, z])
