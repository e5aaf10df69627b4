"""docs/delays.md against the code: every model with its parameters, every YAML, and the example as it stands there."""

import re
from dataclasses import fields
from pathlib import Path
from typing import get_args

import pytest
from ruamel.yaml import YAML

from fgtrack.pipeline.load import validate
from fgtrack.sim.clocks import AnyClock
from fgtrack.sim.delays import AnyDelay
from fgtrack.sim.redelay import SensorDelays

DOCUMENT = (Path(__file__).resolve().parents[2] / "docs/delays.md").read_text(encoding="utf-8")
MODELS = [*get_args(get_args(AnyDelay)[0]), *get_args(get_args(AnyClock)[0])]


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", DOCUMENT, re.DOTALL)


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.__name__)
def test_every_model_has_a_row_with_its_parameters(model: type) -> None:
    names = [field.name for field in fields(model) if field.name != "kind"]
    parameters = ", ".join(f"`{name}`" for name in names)
    assert f"| `{model.kind}` | {parameters}{' ' if names else ''}|" in DOCUMENT  # type: ignore[attr-defined]


def test_every_file_of_delays_in_it_is_one() -> None:
    texts = blocks("yaml")
    assert len(texts) == 2
    for text in texts:
        assert validate(dict[str, SensorDelays], YAML(typ="safe").load(text), "docs/delays.md")


def test_the_example_prints_what_stands_below_it(capsys: pytest.CaptureFixture[str]) -> None:
    [code] = blocks("python")
    exec(compile(code, "docs/delays.md", "exec"), {})
    shown = [line.split() for line in DOCUMENT.split(code)[1].split("```")[2].strip().splitlines()]
    found = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert found[0] == shown[0]
    assert [row[:3] for row in found[1:]] == [row[:3] for row in shown[1:]]
    gains, below = ({(row[0], row[1]): float(row[column]) for row in found[1:]} for column in (3, 4))
    assert below["ReplayEkf", "lidar"] == below["ReplayEkf", "radar"] == 0.0
    assert below["RewindForget", "lidar"] > 10.0
    assert gains["ReplayEkf", "lidar"] > gains["RewindForget", "lidar"] > gains["Drop", "lidar"]
