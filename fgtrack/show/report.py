"""Report of runs: a self-contained HTML file with verdict, viewer, figures, tables and configuration."""

import base64
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path

import pandas as pd

import fgtrack
from fgtrack.core.errors import printable
from fgtrack.core.output import new_file
from fgtrack.evaluation.diagnostics import diagnostics, noise_diagnostics
from fgtrack.evaluation.runs import EvaluatedRun, recordings_warning
from fgtrack.evaluation.tables import Column, Table, Tables
from fgtrack.show.playback import Moment, playback

#: Kinds of figures that are shown unfolded; a kind may have several figures, by object or run.
_FIRST = ("close_up", "errors", "error_against_delay", "error_against_lag", "map")
_CAPTIONS = {
    "error_against_delay": "error against delay: a sweep over ten races that is shipped with fgtrack"
}
# Largest numbers of unfolded figures and warnings.
_MOST_OPEN = 3
_MOST_WARNINGS = 3
_NONE = "–"


@dataclass(frozen=True)
class ReportHead:
    """First part of a report."""

    sentences: Sequence[str] = ()
    """Verdict of the report; if empty, the verdict of the comparison."""
    assumptions: Sequence[str] = ()
    """Decisions and assumptions about settings that the user has not given; they come first."""
    advice: Sequence[str] = ()
    """Sentences of the advice."""
    moment: Moment | None = None
    """Time [ns], x and y [m] that the viewer shows first; None: the viewer chooses an early late detection."""
    missing: Sequence[str] = ()
    """A line for each content that the report lacks."""


def write_report(
    runs: Sequence[EvaluatedRun],
    tables: Tables,
    pictures: Iterable[tuple[str, bytes]],
    out: Path,
    head: ReportHead,
    overwrite: bool,
) -> int:
    """Write the report of `runs` to the HTML file `out`, and return its size in bytes.

    Verdict, warnings, viewer and three figures are unfolded, the rest is folded.
    `pictures` are PNG images by name, in display order. Equal runs and pictures give
    equal bytes. Raises `CallError` if the file exists, and `DataError` if a run or its
    map is damaged.
    """
    # Names from files may not be valid UTF-8.
    text = _page(runs, tables, pictures, head).encode("utf-8", "backslashreplace")
    with new_file(out, overwrite) as file:
        file.write(text)
    return len(text)


def _page(
    runs: Sequence[EvaluatedRun],
    tables: Tables,
    pictures: Iterable[tuple[str, bytes]],
    head: ReportHead,
) -> str:
    scene, notes = playback(runs, head.moment)
    warnings = recordings_warning(runs)
    warnings += [
        f"{one.label}: {line}" for one in runs for line in diagnostics(one.run)
    ]
    # The noise is the same for all runs, as in the output of `replay`.
    warnings += map(str, noise_diagnostics(runs[0].run))
    warnings = list(dict.fromkeys((*warnings, *notes, *head.missing)))
    figures = {name: _figure(name, picture) for name, picture in pictures}
    first = [
        next((name for name in figures if name.startswith(kind)), "") for kind in _FIRST
    ]
    first = list(dict.fromkeys(name for name in (*first, *figures) if name))[
        :_MOST_OPEN
    ]
    few = _list(warnings[:_MOST_WARNINGS], "warnings")
    more = _list(warnings[_MOST_WARNINGS:])
    nothing = "<p>Nothing to evaluate: no errors against truth and no innovations.</p>"
    shown = [table for table in tables.in_full().tables.values() if table.records]
    open_parts = {
        "Assumptions": _list(head.assumptions),
        "Verdict": _list(head.sentences or tables.verdict) or nothing,
        "Warnings": few + _folded("More warnings", more),
        "Viewer": _template("viewer.html"),
        "Figures": _figures(text for name, text in figures.items() if name in first),
    }
    folded_parts = {
        "Advice": _list(head.advice),
        "Tables": "".join(
            _wide(one.title, one.to_html()) + _list(one.notes, "soft") for one in shown
        ),
        "More figures": _figures(
            text for name, text in figures.items() if name not in first
        ),
        "Configuration": _configuration(runs),
        "Runs": _grid("Sources", [_facts(one) for one in runs]),
    }
    sections = [
        f'<section id="part-{name.lower()}">\n<h2>{name}</h2>\n{content}</section>\n'
        for name, content in open_parts.items()
        if content
    ]
    sections += [_folded(name, content) for name, content in folded_parts.items()]
    labels = ", ".join(one.label for one in runs)
    paths = [(one.run.meta.get("input") or {}).get("path") for one in runs]
    recordings = ", ".join(dict.fromkeys(Path(path).name for path in paths if path))
    contents = {
        "version": escape(fgtrack.__version__),
        "title": escape(
            f"fgtrack report: {labels}"
            if len(runs) == 1
            else f"fgtrack report of {len(runs)} runs"
        ),
        "subtitle": escape(
            printable(f"{recordings}: {labels}" if recordings else labels)
        ),
        "style": _template("page.css"),
        "parts": "".join(sections),
        "scene": json.dumps(scene, allow_nan=False, separators=(",", ":")).replace(
            "<", r"\u003c"
        ),
        "script": _template("viewer.js"),
    }
    # Each {{name}} is replaced once; inserted text is not searched again.
    return re.sub(
        r"\{\{(\w+)\}\}", lambda match: contents[match[1]], _template("page.html")
    )


def _folded(title: str, content: str) -> str:
    """Return content in a folded section; empty without content."""
    anchor = f"part-{title.lower().replace(' ', '-')}"
    return (
        f'<details id="{anchor}"><summary>{title}</summary>\n{content}</details>\n'
        if content
        else ""
    )


def _template(name: str) -> str:
    return (files(__package__) / "page" / name).read_text(encoding="utf-8")


def _list(lines: Iterable[str], kind: str = "") -> str:
    items = "".join(f"<li>{escape(printable(line))}</li>\n" for line in lines)
    name = f' class="{kind}"' if kind else ""
    return f"<ul{name}>\n{items}</ul>\n" if items else ""


def _grid(title: str, records: Sequence[Mapping[str, str]]) -> str:
    """Return an HTML table of texts."""
    columns = [Column(name, [name], left=True) for name in records[0]]
    return _wide(title, Table(title, records, columns).to_html())


def _wide(title: str, content: str) -> str:
    """Return an HTML table that scrolls sideways on a narrow page."""
    name = escape(printable(title))
    region = f'<div class="wide" tabindex="0" role="region" aria-label="{name}">'
    return f"<h3>{name}</h3>\n{region}<table>\n{content}</table></div>\n"


def _figures(texts: Iterable[str]) -> str:
    content = "".join(texts)
    return f'<div class="figures">\n{content}</div>\n' if content else ""


def _figure(name: str, picture: bytes) -> str:
    text = escape(name)
    data = base64.b64encode(picture).decode()
    image = f'<img alt="{text}" src="data:image/png;base64,{data}">'
    caption = f"<figcaption>{_CAPTIONS.get(name, text.replace('_', ' '))}</figcaption>"
    return f'<figure class="figure" id="figure-{text}" tabindex="0">{image}{caption}</figure>\n'


def _configuration(runs: Sequence[EvaluatedRun]) -> str:
    """Return the keys with different values between runs, then the configuration of each run."""
    settings = pd.DataFrame(
        {
            one.label: pd.json_normalize(one.run.config).to_dict("records")[0]
            for one in runs
        }
    )
    texts = settings.map(
        lambda value: (
            value if isinstance(value, str) else json.dumps(value, default=str)
        )
    )
    settings = texts.replace("NaN", _NONE)
    differing = settings[settings.nunique(axis=1) > 1]
    rows = [{"key": str(key)} | row for key, row in differing.to_dict("index").items()]
    text = _grid("Where the runs differ", rows) if rows else ""
    for one in runs:
        config = f"<pre>{escape(one.run.config_text)}</pre>"
        text += f"<details><summary>{escape(one.label)}: config.yaml</summary>{config}</details>\n"
    return text


def _facts(one: EvaluatedRun) -> dict[str, str]:
    """Return the origin of a run as texts."""
    meta = one.run.meta
    wall_s = meta.get("wall_s")
    end = "" if meta.get("complete", True) else " (did not finish)"
    return {
        "run": one.label,
        "estimator": str(meta.get("estimator", _NONE)),
        "recording": str((meta.get("input") or {}).get("path", _NONE)) + end,
        "detections": str(meta.get("detections_received", _NONE)),
        "time [s]": f"{wall_s:.1f}" if isinstance(wall_s, int | float) else _NONE,
        "versions": ", ".join(
            f"{name} {version}"
            for name, version in (meta.get("versions") or {}).items()
        ),
        "digest": str(meta.get("digest", _NONE)),
    }
