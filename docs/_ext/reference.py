"""Pages that are generated from the code: settings, estimators, delay models, the public names.

Everything here gives Markdown and needs Python alone; `setup` makes Sphinx directives of it.
"""

import inspect
import types
from collections.abc import Callable
from enum import Enum
from typing import Any, get_args, get_origin

from fgtrack.config.keys import one_line, settings_page


def estimators_page() -> str:
    """A table of all estimators that come with fgtrack."""
    from fgtrack.estimation.registry import ESTIMATORS, Claims

    lines = ["| name | method | exact in a linear model for |", "|---|---|---|"]
    for name in ESTIMATORS:
        if name not in ESTIMATORS.sources():
            factory = ESTIMATORS.load(name)
            summary = one_line((inspect.getdoc(factory) or "").partition("\n\n")[0])
            lines.append(f"| `{name}` | {summary} | {Claims.of(factory).exact or '-'} |")
    return "\n".join(lines)


def motion_models_page() -> str:
    """A table of all motion models that come with fgtrack."""
    from fgtrack.estimation.registry import MOTION_MODELS

    lines = ["| name | model | state | noise densities |", "|---|---|---|---|"]
    for name in MOTION_MODELS:
        if name not in MOTION_MODELS.sources():
            model = MOTION_MODELS.load(name)
            summary = one_line((inspect.getdoc(model) or "").partition("\n\n")[0])
            entries, densities = (", ".join(f"`{each}`" for each in names) for names in (
                model.state_names, model.density_names()
            ))
            lines.append(f"| `{name}` | {summary} | {entries} | {densities or '-'} |")
    return "\n".join(lines)


_GROUPS = {
    "Recordings, runs, live use": ("inputs", "meaning", "runs", "pipeline", "config", "sim"),
    "Evaluation, figures, reports": ("evaluation", "ranking", "show", "recording_study"),
    "Advice and noise": ("advice", "noise", "clocks"),
    "Messages, reports, errors": ("core",),
    "Estimators": ("estimation", "testing"),
    "Motion, measurement and sensor models": ("models",),
}


def public_names() -> str:
    """Autodoc directives of what `import fgtrack` offers."""
    import fgtrack

    values = {name: getattr(fgtrack, name) for name in dir(fgtrack) if not name.startswith("_")}
    lines = []
    for title, packages in _GROUPS.items():
        lines += [f"## {title}", ""]
        for name, value in values.items():
            if f"{fgtrack._HOMES[name]}.{name}".split(".")[1] in packages:
                lines += ["```{eval-rst}", _autodoc(name, value), "```", ""]
    return "\n".join(lines)


def _autodoc(name: str, value: Any) -> str:
    if isinstance(value, type):
        return f".. autoclass:: fgtrack.{name}\n   :members:" + "\n   :undoc-members:" * issubclass(value, Enum)
    if isinstance(value, types.ModuleType):
        import fgtrack

        own = [one for one in value.__all__ if one not in dir(fgtrack)]  # a public name has an entry of its own
        members = {one: getattr(value, one) for one in own}
        return "\n\n".join(_autodoc(f"{name}.{one}", member) for one, member in members.items() if callable(member))
    if getattr(get_origin(value), "__name__", "") == "ndarray":
        numbers = get_args(get_args(value)[1])[0].__name__
        return f".. py:data:: fgtrack.{name}\n\n   Type of a NumPy array of `{numbers}`."
    if callable(value):
        return f".. autofunction:: fgtrack.{name}"
    return f".. py:data:: fgtrack.{name}\n\n   " + " or ".join(f"`{one.__name__}`" for one in get_args(value))


def _whole_sentences(app: Any, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Break the line behind a colon: what stands before it is no type, as Napoleon has it for an attribute."""
    if what in ("attribute", "property") and lines:
        before, colon, behind = lines[0].partition(": ")
        lines[:1] = [before + colon.strip(), behind] if colon else [before]


def setup(app: Any) -> dict[str, bool]:
    """Directives `settings`, `estimators`, `motion-models` and `public-names` for Sphinx."""
    from docutils.nodes import Node
    from sphinx.util.docutils import SphinxDirective

    def directive(page: Callable[..., str], num_arguments: int) -> type[SphinxDirective]:
        class Generated(SphinxDirective):
            required_arguments = num_arguments

            def run(self) -> list[Node]:
                return self.parse_text_to_nodes(page(*self.arguments), allow_section_headings=True)

        return Generated

    app.add_directive("settings", directive(settings_page, 1))
    app.add_directive("estimators", directive(estimators_page, 0))
    app.add_directive("motion-models", directive(motion_models_page, 0))
    app.add_directive("public-names", directive(public_names, 0))
    app.connect("autodoc-process-docstring", _whole_sentences, priority=100)  # before Napoleon
    return {"parallel_read_safe": True}
