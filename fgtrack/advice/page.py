"""The page of `fgtrack advise`: findings, two tables, and the advised configuration."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from textwrap import TextWrapper

from fgtrack.advice.checks import Check
from fgtrack.advice.run_quality import RunQuality
from fgtrack.clocks.arrivals import Arrivals
from fgtrack.config.settings import Config
from fgtrack.core.finding import Finding
from fgtrack.evaluation.tables import NO_VALUE, Column, Table, Tables, Value
from fgtrack.inputs.info import OTHER_CLOCK_S
from fgtrack.meaning.assumption import Assumption

__all__ = ["Advice", "rounded_ms"]

_COMMENT = 110  # characters in a line of a file


@dataclass(frozen=True)
class Advice:
    """Findings on a recording and its configuration; `str` shows them as a page of sentences and tables."""

    recording: str
    findings: tuple[Finding, ...]
    """The findings, the most important first."""
    checks: tuple[Check, ...] = field(repr=False)
    """All tests, with their numbers, or with the reason why a test was not made."""
    config: Config = field(repr=False)
    """The advised configuration. It contains fitted noise if that was requested."""
    arrivals: tuple[Arrivals, ...] = field(repr=False)
    """Arrivals of the used sensors, with the advised stamps."""
    overtaken: Mapping[str, float] = field(repr=False)
    """Share of each sensor's lists that arrived after a newer list of any sensor."""
    before: RunQuality | None = field(repr=False)
    """RunQuality of a replay with the given configuration; None if nothing can be tracked."""
    after: RunQuality | None = field(repr=False)
    """RunQuality of a replay with the advised configuration."""
    broken: str | None
    """Reason why the recording could be read only in part, or None. The readable part was used."""
    ledger: Table | None = field(repr=False, default=None)
    """Errors of policies with the advised configuration, if requested."""

    @property
    def changes(self) -> tuple[Assumption, ...]:
        """The settings that the findings change, with their reasons, the most important first."""
        result: dict[str, Assumption] = {}
        for one in self.findings:
            for key, value in one.settings.items():
                result[key] = Assumption(
                    tuple(key.split(".")), value, f"{one.about}: {one.text}"
                )
        return tuple(result.values())

    @property
    def fine(self) -> tuple[str, ...]:
        """Line of the passed tests, with their numbers, for each sensor, the ego and the tracks."""
        return self._lines("fine", "Fine")

    @property
    def untested(self) -> tuple[str, ...]:
        """Line of the tests that were not made, with the reasons, for each sensor, the ego and the tracks."""
        return self._lines("untested", "Not tested")

    def _lines(self, verdict: str, word: str) -> tuple[str, ...]:
        by_subject: dict[str, list[str]] = {}
        for one in self.checks:
            if one.verdict == verdict:
                by_subject.setdefault(one.about, []).append(str(one))
        return tuple(
            f"{word}, {about}: {'; '.join(texts)}."
            for about, texts in by_subject.items()
        )

    @property
    def sentences(self) -> tuple[str, ...]:
        """The findings, the passed tests, and the tests that were not made."""
        return (*map(str, self.findings), *self.fine, *self.untested)

    @property
    def tables(self) -> Tables:
        """Tables `outcome` of the replays and `lateness` of each sensor; `ledger` if requested."""
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
        title = "Replays with the given and the advised settings"
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
                "lost": item.lost_share,
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
            "Lists by sensor, with the advised stamps", records, columns, ("sensor",)
        )

    def as_dict(self) -> dict[str, object]:
        """Return plain values for JSON."""
        return {
            "recording": self.recording,
            "findings": [asdict(item) for item in self.findings],
            "checks": [asdict(item) for item in self.checks],
            "changes": [
                {"key": item.key, "value": item.value, "why": item.reason}
                for item in self.changes
            ],
            "broken": self.broken,
            **self.tables.to_dict(),
        }

    def comments(self) -> list[str]:
        """Return lines with the reason of each changed setting, and the findings without a setting."""
        changes = [f"{one.key} = {one.value}: {one.reason}" for one in self.changes]
        rest = [str(one) for one in self.findings if not one.settings]
        lines = _wrapped(changes) if changes else ["Nothing is changed."]
        return [
            *lines,
            *(["", "No setting corrects these findings:"] if rest else []),
            *_wrapped(rest),
        ]


def _wrapped(texts: Sequence[str]) -> list[str]:
    how = TextWrapper(
        _COMMENT, initial_indent="- ", subsequent_indent="  ", break_long_words=False
    )
    return [line for text in texts for line in how.wrap(text)]


def rounded_ms(value: Value) -> str:
    """Return whole milliseconds; no value if the clocks of sensor and recorder are unrelated."""
    return f"{value:.0f}" if abs(float(value)) < 1e3 * OTHER_CLOCK_S else NO_VALUE
