"""YAML of strangers."""

from pathlib import Path

import pytest
from ruamel.yaml.error import YAMLError

from fgtrack.core.errors import CallError
from fgtrack.io.yaml_text import safe_yaml
from fgtrack.pipeline.load import read_yaml


@pytest.mark.parametrize(
    "text",
    [
        "{kind: track, [[0.0, 65.5]]}",
        "? {a: 1}\n: b",
        "a: 2001-99-99",
        "a: !!int x",
        "a: !!python/object:os.system {}",
        "<<: 3",
        f"a: {'9' * 5000}",
    ],
)
def test_what_is_no_plain_value_is_an_error_of_yaml_or_a_text(text: str) -> None:
    try:
        value = safe_yaml(text)
    except YAMLError:
        return
    assert isinstance(value, dict)


def test_a_key_that_is_a_list_is_named(tmp_path: Path) -> None:
    (tmp_path / "x.yaml").write_text("a: 1\nb: {c: 2, [[0.0, 65.5]]}\n")
    with pytest.raises(CallError, match=r"x\.yaml: invalid YAML, a key is a list or a mapping"):
        read_yaml(tmp_path / "x.yaml")
