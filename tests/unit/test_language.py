"""Docstrings, comments, messages and pages use the words of the field."""

import ast
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MODULES = sorted((ROOT / "fgtrack").rglob("*.py"))
DOCS = sorted((ROOT / "docs").glob("*.md"))
EXPERIMENTS = sorted((ROOT / "experiments").rglob("*.md"))
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS, *EXPERIMENTS]
#: Words with which no docstring begins: it begins with what is returned, or with a noun.
OPENINGS = ("What", "Whether", "Of", "Those", "How", "So")
#: Words of which the field has others: an index, a result, reported, specified, recomputed, corrected, unusual.
BANNED = re.compile(
    r"\b(places?|found|told|tells?|said|says?|knows?|(?<!there )(is|are) (?-i:none)|anew"
    r"|(computed|estimated|filtered|fitted|solved|taken|begins?) again|mend(ed|s)?|spoil(t|s)?|nasty|strangers?|odd"
    r"|guilty|believed?|in place of|the like|forth and back|noise (that )?fits|sensed|errors that last|lasting errors?"
    r"|rewinds|unaware|contest(ants?)?|caution|sendings|judging|relied|who is late|whose clock)\b",
    re.IGNORECASE,
)


def texts(module: Path) -> Iterator[tuple[int, str]]:
    """Comments and strings of a module without the code in them, with their lines."""
    with module.open("rb") as file:
        for token in tokenize.tokenize(file.readline):
            if token.type in (tokenize.COMMENT, tokenize.STRING):
                is_format = re.match("[rR]?[fF]", token.string)
                text = (
                    re.sub(r"\{[^{}]*\}", "", token.string)
                    if is_format
                    else token.string
                )
                yield token.start[0], re.sub("`[^`]*`", "", text)


@pytest.mark.parametrize(
    "folder", sorted({each.relative_to(ROOT / "fgtrack").parts[0] for each in MODULES})
)
def test_no_docstring_begins_with_a_question_word(folder: str) -> None:
    modules = [
        each
        for each in MODULES
        if each.relative_to(ROOT / "fgtrack").parts[0] == folder
    ]
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    for module in modules:
        for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
            text = ast.get_docstring(node) if isinstance(node, documented) else None
            first = (text or "-").split(maxsplit=1)[0].rstrip(",.:")
            assert first not in OPENINGS, f"{module}: {text}"


def test_package_and_tutorials_use_the_words_of_the_field() -> None:
    modules = [
        *MODULES,
        *(
            file
            for name in ("_ext", "example", "live", "tutorials")
            for file in (ROOT / "docs" / name).rglob("*.py")
        ),
    ]
    banned = [
        f"{module}:{line}: {text}"
        for module in modules
        for line, text in texts(module)
        if BANNED.search(text)
    ]
    assert not banned, "\n".join(banned)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_page_uses_the_words_of_the_field(page: Path) -> None:
    text = re.sub(
        "```.*?```|`[^`]*`", "", page.read_text(encoding="utf-8"), flags=re.DOTALL
    )
    banned = BANNED.search(text)
    assert banned is None, f"{page.name}: {banned}"
