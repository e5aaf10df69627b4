"""Entries of JSON files as they come: the same as the whole file at once."""

import json
from pathlib import Path

import pytest

from fgtrack.core.errors import DataError
from fgtrack.io.adapters.json_entries import list_entries, object_entries


def test_entries_are_those_of_the_whole_file(tmp_path: Path) -> None:
    entries = [{"a": [1, 2.5, "x"], "b": {"c": None}}, 3, -0.1, 10**15, "text", [], True]
    (tmp_path / "list.json").write_text(json.dumps(entries, indent=1))
    assert list(list_entries(tmp_path / "list.json")) == entries
    results = {str(number): entry for number, entry in enumerate(entries)}
    (tmp_path / "object.json").write_text(json.dumps({"meta": [1, {}], "results": results, "more": 2}))
    assert dict(object_entries(tmp_path / "object.json", "results")) == results


@pytest.mark.parametrize("text", ["", "[1, 2", "[1 2]", "[nope]", "[[" * 100_000])
def test_what_is_not_json_is_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(DataError, match=r"x\.json: is not JSON of the expected form"):
        list(list_entries(tmp_path / "x.json"))
    with pytest.raises(DataError, match="cannot be read"):
        list(list_entries(tmp_path / "none.json"))
