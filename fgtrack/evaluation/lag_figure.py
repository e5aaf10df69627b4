"""The figure of the error against the lag."""

from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fgtrack.evaluation.figure_style import colour, legend_above, line_style, styled
from fgtrack.evaluation.lagged import LagMetrics

_PANELS = {"position_m": "position RMSE [m]", "speed_mps": "speed RMSE [m/s]"}


@styled
def figure_lag(runs: Mapping[str, Sequence[LagMetrics]]) -> Figure:
    """RMSE of position and speed against the lag, a line per run; level where a run has no lagged states.

    Of a track that ended there are no lagged states of its last moments, so the dotted line beside shows the present
    states of the same tracks at the same stamps: the distance between the two is what waiting brings.
    """
    names = [name for name in _PANELS if any(entry.errors[name].count for one in runs.values() for entry in one)]
    figure = Figure(figsize=(8.0, 1.4 + 2.6 * len(names)))
    panels = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for axes, name in zip(panels, names, strict=True):
        for k, (label, lagged) in enumerate(runs.items()):
            _draw(axes, lagged, name, label, k)
        axes.set_ylabel(_PANELS[name])
        axes.set_ylim(0.0, 1.08 * axes.dataLim.y1)
    legend_above(panels[0], width=120)
    panels[-1].set_xlabel("lag [s] (how long the output waits)")
    figure.suptitle("Error against lag")
    return figure


def _draw(axes: Axes, lagged: Sequence[LagMetrics], name: str, label: str, index: int) -> None:
    color = colour(index)
    curve = [lagged[0], *(entry for entry in lagged if entry.is_lagged)] if lagged else []
    if len(curve) > 1:
        lags_s = [float(entry.lag_s) for entry in curve]
        rmse = [entry.errors[name].rmse for entry in curve]
        axes.plot(lags_s, rmse, ls=line_style(index), lw=1.4, color=color, label=label)
        axes.plot(lags_s, rmse, "o", ms=3.5, color=color)
        present = [entry.present_errors[name].rmse for entry in curve]
        axes.plot(lags_s, present, ls=":", lw=1.2, color=color, label=f"{label}: present states, same stamps")
    elif curve:
        axes.axhline(curve[0].errors[name].rmse, ls="--", lw=1.4, color=color, label=f"{label}: present, has no lag")
