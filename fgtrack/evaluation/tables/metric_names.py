"""Display names of metrics and configuration keys, with units."""

from collections.abc import Mapping

__all__ = ["METRIC_NAMES", "metric_words", "words"]

#: Names of metrics; other metrics are named by their column.
METRIC_NAMES: Mapping[str, str] = {
    "truth.overall.errors.position_m.rmse": "position RMSE [m]",
    "truth.overall.errors.speed_mps.rmse": "speed RMSE [m/s]",
    "truth.overall.errors.yaw_rad.rmse": "yaw RMSE [rad]",
    "consistency.position_nees.mean": "mean NEES of the position",
    "multi_object.gospa.in_view_rms_m": "GOSPA of objects in view [m]",
    "multi_object.gospa.rms_m": "GOSPA [m]",
    "truth.overall.tracked_share_in_view": "share of the time in view that is tracked",
    "truth.overall.tracked_share": "share of the time that is tracked",
    "truth.false_tracks": "false tracks",
    "truth.overall.id_switches": "identity switches",
    "multi_object.clear.mota": "MOTA",
    "multi_object.identity.idf1": "IDF1",
    "multi_object.hota.hota": "HOTA",
}
_UNITS = {"hz": "Hz", "mps": "m/s", "radps": "rad/s", "mps2": "m/s²"} | {
    name: name for name in ("s", "ms", "ns", "m", "rad")
}


def metric_words(metric: str) -> str:
    """Return the display name of a metric, with its unit."""
    if metric in METRIC_NAMES:
        return METRIC_NAMES[metric]
    parts = metric.split(".")
    if parts[0] == "lagged" and parts[-1] == "rmse":
        return f"{words(parts[-2]).replace(' [', ' RMSE [')}, output {'.'.join(parts[1:-3])} s later"
    if metric.endswith(".rmse"):
        return words(parts[-2]).replace(" [", " RMSE [")
    if parts[:2] == ["consistency", "nis"]:
        return f"mean NIS of {parts[2].replace('_', ' ')}"
    return words(metric)


def words(name: str) -> str:
    """Return the display name of a configuration key or column, with its unit: "delay [s]" for "sensors.x.delay_s"."""
    plain = ".".join(name.split(".")[-2:]).replace(".", " ")
    stem, _, unit = plain.rpartition("_")
    text, end = (stem, f" [{_UNITS[unit]}]") if stem and unit in _UNITS else (plain, "")
    proper = {each.lower(): each for each in ("LiDAR", "RADAR", "NEES", "NIS")}
    return (
        " ".join(proper.get(word, word) for word in text.replace("_", " ").split(" "))
        + end
    )
