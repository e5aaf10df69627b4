"""The page of `fgtrack advise`: sentences, two tables, and the configuration that follows them."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from textwrap import TextWrapper

from fgtrack.advice.outcome import Outcome
from fgtrack.clocks.arrivals import Arrivals
from fgtrack.config.settings import Config
from fgtrack.core.finding import Finding
from fgtrack.evaluation.tables import NO_VALUE, Column, Table, Tables, Value
from fgtrack.inputs.info import OTHER_CLOCK_S
from fgtrack.pipeline.assumptions.assumption import Assumption

__all__ = ["Advice", "rounded_ms"]

_COMMENT = 110  # characters in a line of a file


@dataclass(frozen=True)
class Advice:
    """Problems of a recording and its configuration; `str` shows them as a page of plain sentences."""

    recording: str
    findings: tuple[Finding, ...]
    """The most important first."""
    fine: tuple[str, ...]
    """Checks without a finding."""
    config: Config = field(repr=False)
    """The configuration with these changes; with noise fitted to the recording where that was asked for."""
    arrivals: tuple[Arrivals, ...] = field(repr=False)
    """Arrivals of the sensors that are used, with the stamps that the advice gives them."""
    overtaken: Mapping[str, float] = field(repr=False)
    """Share of the lists of each sensor that came after a newer one."""
    before: Outcome | None = field(repr=False)
    """Outcome of a replay with the configuration; None where nothing can be tracked."""
    after: Outcome | None = field(repr=False)
    """The same with these changes."""
    broken: str | None
    """Why the recording breaks off, where it does; what came before was used."""
    ledger: Table | None = field(repr=False, default=None)
    """Errors of policies with these changes, where they were asked for."""

    @property
    def changes(self) -> tuple[Assumption, ...]:
        """The settings that the findings change with their reasons, the most important first."""
        result: dict[str, Assumption] = {}
        for one in self.findings:
            for key, value in one.settings.items():
                result[key] = Assumption(
                    tuple(key.split(".")), value, f"{one.about}: {one.text}"
                )
        return tuple(result.values())

    @property
    def sentences(self) -> tuple[str, ...]:
        """The findings, and a line of what is fine."""
        return (
            *map(str, self.findings),
            *([f"Fine: {', '.join(self.fine)}."] if self.fine else []),
        )

    @property
    def tables(self) -> Tables:
        """`outcome` of the replays, `lateness` of each sensor, and `ledger`, where it was asked for."""
        own = {} if self.ledger is None else {"ledger": self.ledger}
        return Tables(
            {"outcome": self._outcome(), "lateness": self._lateness(), **own},
            verdict=self.sentences,
        )

    def __str__(self) -> str:
        return str(self.tables)

    def _outcome(self) -> Table:
        columns = {"before": self.before} | (
            {"advised": self.after} if self.changes else {}
        )
        rows = {
            name: dict(() if item is None else item.rows())
            for name, item in columns.items()
        }
        names = dict.fromkeys(key for values in rows.values() for key in values)
        records = [
            {"replayed": name}
            | {column: values.get(name) for column, values in rows.items()}
            for name in names
        ]
        title = "Replays with the settings before and as advised"
        return Table(
            title,
            records,
            [Column("replayed", left=True), *map(Column, rows)],
            ("replayed",),
        )

    def _lateness(self) -> Table:
        records = [
            {
                "sensor": item.name,
                "lists": len(item.counts),
                "period_s": item.period_s,
                "delay_p50_s": item.quantile_s(0.5),
                "delay_p95_s": item.quantile_s(0.95),
                "delay_max_s": float(item.delays_s[item.usable].max()),
                "overtaken": self.overtaken[item.name],
                "object_late": item.object_late,
                "lost": item.lost,
            }
            for item in self.arrivals
        ]
        columns = [
            Column("sensor", left=True),
            Column("lists"),
            Column("period\n[ms]", "period_s", scale=1e3),
            Column(
                "delay [ms]\np50/p95/max",
                "delay_p50_s delay_p95_s delay_max_s",
                "{}/{}/{}",
                1e3,
                text=rounded_ms,
            ),
            Column("late [%]\nstream/object", "overtaken object_late", "{}/{}", 100.0),
            Column("lost\n[%]", "lost", scale=100.0),
        ]
        return Table(
            "Lists by sensor, with the stamps advised", records, columns, ("sensor",)
        )

    def as_dict(self) -> dict[str, object]:
        """Plain values for JSON."""
        return {
            "recording": self.recording,
            "findings": [asdict(item) for item in self.findings],
            "fine": list(self.fine),
            "changes": [
                {"key": item.key, "value": item.value, "why": item.reason}
                for item in self.changes
            ],
            "broken": self.broken,
            **self.tables.to_dict(),
        }

    def comments(self) -> list[str]:
        """Return the reason of each changed setting, and what no setting corrects."""
        changes = [f"{one.key} = {one.value}: {one.reason}" for one in self.changes]
        rest = [str(one) for one in self.findings if not one.settings]
        lines = _wrapped(changes) if changes else ["Nothing is changed."]
        return [
            *lines,
            *(["", "Without a setting that corrects it:"] if rest else []),
            *_wrapped(rest),
        ]


def _wrapped(texts: Sequence[str]) -> list[str]:
    how = TextWrapper(
        _COMMENT, initial_indent="- ", subsequent_indent="  ", break_long_words=False
    )
    return [line for text in texts for line in how.wrap(text)]


def rounded_ms(value: Value) -> str:
    """Whole milliseconds; of a recorder with another clock than the sensor nothing."""
    return f"{value:.0f}" if abs(float(value)) < 1e3 * OTHER_CLOCK_S else NO_VALUE
