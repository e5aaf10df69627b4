"""The page of a report: its parts as HTML, put into one file that loads nothing."""

import base64
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from typing import Any

from matplotlib.figure import Figure

from fgtrack.evaluation.cautions import cautions, noise_cautions
from fgtrack.evaluation.comparison import compare
from fgtrack.evaluation.figures.style import png
from fgtrack.evaluation.recordings import recordings_caution
from fgtrack.evaluation.report.scene import scene
from fgtrack.evaluation.report.settings import differing, flattened
from fgtrack.evaluation.runs import JudgedRun
from fgtrack.evaluation.tables import Table, cell_rows

_SCRIPTS = ("data.js", "drawing.js", "strip.js", "links.js", "controls.js", "viewer.js")
_NONE = "–"
_LONG = 40  # characters of a cell that may be broken
_DPI = 110.0  # of figures: sharp at the width at which they are shown


def page(
    runs: Sequence[JudgedRun], figures: Iterable[tuple[str, Figure]], version: str, notes: Sequence[str] = ()
) -> str:
    """The report of `runs` as one HTML file: the same runs and figures give the same text.

    Parameters
    ----------
    runs
        What it is about, under their labels.
    figures
        By name, in the order in which they are shown.
    version
        Of fgtrack.
    notes
        What is not in the report, a line each.

    Raises
    ------
    DataError
        A run or its map is damaged.
    """
    tables = compare(*runs)
    shown = scene(runs)
    warnings = recordings_caution(runs)
    warnings += [f"{one.label}: {line}" for one in runs for line in (*cautions(one.run), *noise_cautions(one.run))]
    filled = {name: table for name, table in tables.items() if table.num_rows}
    dispositions = filled.pop("dispositions", None)
    parts = {
        "Verdict": _list(tables.verdict) or "<p>Nothing to judge: no errors and no innovations.</p>",
        "Warnings": _list(dict.fromkeys((*warnings, *shown.notes, *notes)), "warnings"),
        "Viewer": _template("viewer.html"),
        "Tables": "".join(map(_table, filled.values())),
        "Figures": _figures(figures),
        "Dispositions": _table(dispositions) if dispositions is not None else "",
        "Configuration": _configuration(runs),
        "Runs": _runs(runs),
    }
    parts = {name: content for name, content in parts.items() if content}
    labels = ", ".join(one.label for one in runs)
    return _filled(
        _template("page.html"),
        {
            "version": escape(version),
            "title": escape(f"fgtrack report: {labels}" if len(runs) == 1 else f"fgtrack report of {len(runs)} runs"),
            "subtitle": escape(labels),
            "style": _template("page.css"),
            "contents": " ".join(f'<a href="#{_anchor(name)}">{name}</a>' for name in parts),
            "parts": "".join(
                f'<section id="{_anchor(name)}">\n<h2>{name}</h2>\n{content}</section>\n'
                for name, content in parts.items()
            ),
            "scene": _json(shown.values),
            "scripts": "".join(f"<script>\n{_template(name)}</script>\n" for name in _SCRIPTS),
        },
    )


def _template(name: str) -> str:
    return (files(__package__) / name).read_text(encoding="utf-8")


def _filled(template: str, contents: Mapping[str, str]) -> str:
    """`template` with each {{name}} replaced once; what is put in is not searched again."""
    return re.sub(r"\{\{(\w+)\}\}", lambda found: contents[found[1]], template)


def _json(values: Any) -> str:  # Any: JSON values
    """`values` as JSON that may stand in a script element."""
    return json.dumps(values, allow_nan=False, separators=(",", ":")).replace("<", r"\u003c")


def _anchor(name: str) -> str:
    return f"part-{name.lower()}"


def _list(lines: Iterable[str], kind: str = "") -> str:
    items = "".join(f"<li>{escape(line)}</li>\n" for line in lines)
    name = f' class="{kind}"' if kind else ""
    return f"<ul{name}>\n{items}</ul>\n" if items else ""


def _table(table: Table) -> str:
    """A table as people read it; the name of a run is in its first row only."""
    head = "".join(_cell("th", column.heading, column.left) for column in table.shown)
    rows = []
    for row in cell_rows(table.shown, lambda text, bold: (text, bold)):
        cells = (_cell("td", text, column.left, bold) for column, (text, bold) in zip(table.shown, row, strict=True))
        rows.append(f"<tr>{''.join(cells)}</tr>\n")
    return _wide(table.title, head, "".join(rows)) + _list(table.notes, "soft")


def _wide(title: str, head: str, rows: str) -> str:
    """A table that scrolls sideways where the page is narrower."""
    name = escape(title)
    return (
        f'<h3>{name}</h3>\n<div class="wide" tabindex="0" role="region" aria-label="{name}"><table>\n'
        f"<thead><tr>{head}</tr></thead>\n<tbody>\n{rows}</tbody>\n</table></div>\n"
    )


def _cell(tag: str, text: str, is_left: bool, is_bold: bool = False) -> str:
    content = escape(text).replace("\n", "<br>")
    kinds = [name for name, has in (("left", is_left), ("long", len(text) > _LONG)) if has]
    kind = f' class="{" ".join(kinds)}"' if kinds else ""
    return f"<{tag}{kind}>{f'<b>{content}</b>' if is_bold else content}</{tag}>"


def _figures(figures: Iterable[tuple[str, Figure]]) -> str:
    content = "".join(_figure(name, figure) for name, figure in figures)
    return f'<div class="figures">\n{content}</div>\n' if content else ""


def _figure(name: str, figure: Figure) -> str:
    text, picture = escape(name), base64.b64encode(png(figure, _DPI)).decode()
    width, height = (round(inches * _DPI) for inches in figure.get_size_inches())
    return (
        f'<figure class="figure" id="figure-{text}" tabindex="0"><img alt="{text}" width="{width}" height="{height}" '
        f'decoding="async" loading="lazy" '
        f'src="data:image/png;base64,{picture}"><figcaption>{text}</figcaption></figure>\n'
    )


def _configuration(runs: Sequence[JudgedRun]) -> str:
    """The keys whose values differ between runs, then everything of each run."""
    settings = {one.label: flattened(one.run.config) for one in runs}
    keys = differing(settings.values())
    parts = []
    if len(runs) > 1 and keys:
        head = "".join(_cell("th", text, True) for text in ("key", *settings))
        rows = (_row([key, *(known.get(key, _NONE) for known in settings.values())]) for key in keys)
        parts.append(_wide("Where the runs differ", head, "".join(rows)))
    elif len(runs) > 1:
        parts.append("<p>All runs have the same configuration.</p>\n")
    for one in runs:
        parts.append(
            f"<details><summary>{escape(one.label)}: config.yaml</summary>"
            f"<pre>{escape(one.run.config_text)}</pre></details>\n"
        )
    return "".join(parts)


def _runs(runs: Sequence[JudgedRun]) -> str:
    """What each run was made of, by whom and how long it took."""
    names = ("run", "estimator", "recording", "detections", "time [s]", "versions", "digest")
    head = "".join(_cell("th", name, True) for name in names)
    return _wide("What they were made of", head, "".join(_row(_facts(one)) for one in runs))


def _facts(one: JudgedRun) -> list[str]:
    meta = one.run.meta
    versions: Mapping[str, Any] = meta.get("versions") or {}
    wall_s = meta.get("wall_s")
    end = "" if meta.get("complete", True) else " (did not finish)"
    return [
        one.label,
        str(meta.get("estimator", _NONE)),
        str((meta.get("input") or {}).get("path", _NONE)) + end,
        str(meta.get("detections_received", _NONE)),
        f"{wall_s:.1f}" if isinstance(wall_s, int | float) else _NONE,
        ", ".join(f"{name} {version}" for name, version in versions.items()),
        str(meta.get("digest", _NONE)),
    ]


def _row(texts: Sequence[str]) -> str:
    return f"<tr>{''.join(_cell('td', text, True) for text in texts)}</tr>\n"
