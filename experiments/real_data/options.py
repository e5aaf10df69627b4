"""Options that the scripts of this folder share."""

from pathlib import Path
from typing import Annotated

import typer

_KITTI = typer.Option(help="Folder of the KITTI tracking data set.")
Kitti = Annotated[Path, _KITTI]
OptionalKitti = Annotated[Path | None, _KITTI]
OptionalAutoferry = Annotated[
    Path | None, typer.Option(help="Folder with a folder per scenario.")
]
Scenarios = Annotated[
    str, typer.Option(help="Scenarios of Autoferry, separated by commas, all if empty.")
]
Sequences = Annotated[
    str, typer.Option(help="Sequences of KITTI, separated by commas.")
]
Estimators = Annotated[str, typer.Option(help="Estimators, separated by commas.")]
Out = Annotated[Path, typer.Option("-o", help="Folder for the tables.")]
Jobs = Annotated[int, typer.Option(help="Replays at a time.")]
