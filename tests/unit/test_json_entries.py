"""Entries of JSON files as they come: the same as the whole file at once, wherever the blocks end."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fgtrack.core.errors import DataError
from fgtrack.core.files import read_whole
from fgtrack.io.adapters import json_entries
from fgtrack.io.adapters.json_entries import list_entries, object_entries

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=4),
    max_leaves=12,
)


@given(entries=st.lists(VALUES, max_size=6), indent=st.sampled_from([None, 1]), block=st.integers(1, 40))
def test_a_list_gives_its_entries(
    tmp_path_factory: pytest.TempPathFactory, entries: list[object], indent: int | None, block: int
) -> None:
    file = tmp_path_factory.mktemp("json") / "x.json"
    file.write_text(json.dumps(entries, indent=indent), encoding="utf-8")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(json_entries, "_BLOCK", block)
        assert list(list_entries(file)) == entries


@given(entries=st.dictionaries(st.text(max_size=4), VALUES, max_size=5), block=st.integers(1, 40))
def test_an_object_gives_what_it_holds_under_a_name(
    tmp_path_factory: pytest.TempPathFactory, entries: dict[str, object], block: int
) -> None:
    file = tmp_path_factory.mktemp("json") / "x.json"
    file.write_text(json.dumps({"meta": [1, {}], "results": entries, "more": 2}), encoding="utf-8")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(json_entries, "_BLOCK", block)
        assert dict(object_entries(file, "results")) == entries


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("{}", "expected"),
        ("", "expected"),
        ("[1, 2", "expected"),
        ("[1 2]", "expected"),
        ("[1,]", "Expecting value"),
        ("[nope]", "Expecting value"),
        ("[" + "[" * 100_000, "nested too deeply|Expecting value"),
        ("[[" + "{}," * 1_450_000, "an entry of more than 4 MB"),
    ],
)
def test_what_is_no_list_is_said_in_a_line(tmp_path: Path, text: str, problem: str) -> None:
    file = tmp_path / "x.json"
    file.write_text(text)
    with pytest.raises(DataError, match=rf"x\.json: is not JSON of the expected form \(.*({problem})"):
        for _ in list_entries(file):
            pass


def test_what_is_missing_no_text_or_too_large_is_said(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot be read"):
        list(list_entries(tmp_path / "none.json"))
    (tmp_path / "x.json").write_bytes(b'["\xff"]')
    with pytest.raises(DataError, match="no UTF-8 text"):
        list(list_entries(tmp_path / "x.json"))
    (tmp_path / "x.json").write_text('{"meta": {}}')
    with pytest.raises(DataError, match="holds no results"):
        list(object_entries(tmp_path / "x.json", "results"))
    with (tmp_path / "x.json").open("wb") as file:
        file.seek(3_000_000_000)
        file.write(b"]")
    with pytest.raises(DataError, match=r"is larger than 2\.1 GB"):
        list(list_entries(tmp_path / "x.json"))
    with pytest.raises(DataError, match="is larger than 20 MB"):
        read_whole(tmp_path / "x.json", 20.0)
