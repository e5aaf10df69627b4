"""Export of the tracks of a run on Earth: GeoJSON (RFC 7946), or tracks.csv with latitude and longitude."""

import json
from itertools import groupby
from pathlib import Path

import numpy as np

from fgtrack.core.errors import CallError
from fgtrack.core.output import check_no_overlap, check_output, new_path, write_file
from fgtrack.core.time import seconds
from fgtrack.inputs.geodetic import GEODETIC, latitudes_longitudes_deg
from fgtrack.runs import Run
from fgtrack.show.states import with_position

_DIGITS = 7  # of a degree: about a centimetre


def origin_of(run: Run) -> tuple[float, float] | None:
    """Latitude and longitude of the map origin of `run`; None if unknown."""
    origin = run.meta.get("origin")
    return None if origin is None else (origin[GEODETIC[0]], origin[GEODETIC[1]])


def write_geojson(run: Run, out: Path, *, overwrite: bool = False) -> int:
    """Write the tracks of `run` to `out` and return their number.

    A `.csv` file gets the table of the tracks, any other file GeoJSON. A GeoJSON
    feature is the line of one track. Its properties are id, class, identity, and the
    time of each point in s since the first tick. Raises `CallError` for a run without
    an origin.
    """
    origin_deg = origin_of(run)
    if origin_deg is None:
        raise CallError(
            f"{run.path}: the map has no latitude and longitude; set `input.origin` and repeat the run"
        )
    check_output(out, overwrite)
    check_no_overlap(out, [run.path])
    tracks = with_position(run.tables["tracks"])
    objects = run.tables["objects"]
    latitude_deg, longitude_deg = latitudes_longitudes_deg(
        origin_deg, tracks["x_m"], tracks["y_m"]
    )
    ids = tracks["track_id"].tolist()
    if out.suffix == ".csv":
        import pandas

        frame = pandas.DataFrame(dict(tracks)).assign(
            latitude_deg=latitude_deg, longitude_deg=longitude_deg
        )
        with new_path(out, overwrite) as path:
            frame.to_csv(path, index=False)
        return len(set(ids))
    start_ns = (
        int(run.tables["timing"]["now_ns"][0]) if run.tables["timing"].num_rows else 0
    )
    points = np.round(
        np.stack([longitude_deg, latitude_deg], axis=-1), _DIGITS
    ).tolist()
    rows = list(
        zip(objects["class_name"].tolist(), objects["id"].tolist(), strict=True)
    )
    names = dict(zip(objects["track_id"].tolist(), rows, strict=True))
    features = []
    for track_id, members in groupby(
        sorted(range(len(ids)), key=ids.__getitem__), key=ids.__getitem__
    ):
        index = list(members)
        class_name, identity = names.get(track_id, ("", ""))
        times_s = [seconds(int(tracks["now_ns"][row]) - start_ns) for row in index]
        line = (
            [points[row] for row in index] if len(index) > 1 else [points[index[0]]] * 2
        )
        geometry = {"type": "LineString", "coordinates": line}
        properties = {
            "track_id": track_id,
            "class_name": class_name,
            "id": identity,
            "times_s": times_s,
        }
        features.append(
            {"type": "Feature", "geometry": geometry, "properties": properties}
        )
    write_file(
        out,
        json.dumps({"type": "FeatureCollection", "features": features}) + "\n",
        overwrite,
    )
    return len(features)
