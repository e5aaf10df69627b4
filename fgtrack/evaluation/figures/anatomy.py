"""The figure of what a delay is made of: sensed, sent, received, taken by a tick."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from fgtrack.core.errors import DataError
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray
from fgtrack.evaluation.figures.style import PALETTE, StyledFigure, legend_above, styled, title, titled
from fgtrack.evaluation.runs import OneRun, one_judged
from fgtrack.evaluation.sendings import Sendings, sendings

_MS = 1e3
_PARTS = {
    "sensed to sent": PALETTE[0],
    "sent to received": PALETTE[1],
    "received to tick": PALETTE[2],
}
_OWN_ROLE = "messages"  # of a topic that fgtrack has written
_WHISKERS = (5.0, 95.0)


@styled
def anatomy(run: OneRun) -> Figure:
    """What the delays of each topic are made of: from sensing to sending, to receipt, and to the tick that takes it.

    Left the means, which add up; right how they are distributed (box: quartiles, line: median, whiskers: 5 and 95 %).
    The time of sending is the publish time of MCAP files; the parts are as good as the clocks of sensor, sender and
    recorder agree, so a part may be negative.

    Raises
    ------
    DataError
        The recording of the run does not know when its messages were sent, or is not there any more.
    """
    one = one_judged(run)
    topics = sendings(one.run)
    if not topics:
        raise DataError(f"{one.label}: its recording does not tell when messages were sent, so nothing to draw")
    figure = StyledFigure(figsize=(10.0, 1.9 + 0.9 * len(topics)))
    means, spread = figure.subplots(1, 2, sharey=True)
    for row, topic in enumerate(topics):
        base = {True: 0.0, False: 0.0}
        for k, (name, values_ms) in enumerate(_parts_ms(topic).items()):
            mean = float(values_ms.mean()) if len(values_ms) else 0.0
            color = _PARTS[name]
            means.barh(row, mean, 0.5, left=base[mean < 0.0], color=color, label="" if row else name)
            base[mean < 0.0] += mean
            if len(values_ms):
                spread.boxplot(
                    [values_ms],
                    positions=[row + 0.25 * (k - 1)],
                    widths=0.18,
                    orientation="horizontal",
                    whis=_WHISKERS,
                    showfliers=False,
                    manage_ticks=False,
                    medianprops={"color": "black"},
                    boxprops={"color": color, "lw": 1.5},
                    whiskerprops={"color": color},
                    capprops={"color": color},
                )
    for axes, what in ((means, "mean [ms]"), (spread, "distribution [ms]")):
        axes.set_xlabel(what)
    means.set_yticks(range(len(topics)), [_named(one) for one in topics])
    means.set_ylim(len(topics) - 0.5, -0.5)
    legend_above(means, figure.get_figwidth() / 2.0)
    title(figure, titled(one.label, "what the delays are made of"))
    return figure


def _named(topic: Sendings) -> str:
    """The topic and what it is used as, where its type does not say that."""
    return topic.topic if topic.role == _OWN_ROLE else f"{topic.topic}\n({topic.role})"


def _parts_ms(topic: Sendings) -> Mapping[str, FloatArray]:
    """The values of each of `_PARTS`."""
    used = topic.used_ns >= 0
    spans = (
        topic.sent_ns - topic.sensed_ns,
        topic.received_ns - topic.sent_ns,
        (topic.used_ns - topic.received_ns)[used],
    )
    return {name: np.asarray(span / NS_PER_S * _MS) for name, span in zip(_PARTS, spans, strict=True)}
