"""The rig that `design` and `place` read, and what their options say about it."""

from pathlib import Path
from typing import Annotated

import typer

from workbench.rig.rig import Rig
from workbench.structure.domain import Interval, position

# a bracket that opens a word would be taken for markup of the help text
RigPath = Annotated[
    Path,
    typer.Argument(help=r"Case folder, or TOML file with \[structure], \[\[input]] and \[\[output]] as in one."),
]
ImpulseAt = Annotated[float | None, typer.Option(help="Place of a unit impulse, m; that of the hammer unless given.")]
Weight = Annotated[float, typer.Option(help="Control weight R: force against motion.")]


def read_structure_rig(path: Path) -> Rig:
    """The rig of a TOML file or a case folder.

    Raises:
        ValueError: a rig of plain modal data, which has no shape between its points.
    """
    from workbench.cases.case import read_rig

    found = read_rig(path / "case.toml" if path.is_dir() else path)
    if found.structure is None:
        raise ValueError(f"{path}: plain modal data have no shapes between points; describe a beam or a rod instead")
    if not isinstance(found.modes.domain, Interval):
        raise ValueError(f"{path}: a design from the command is for a beam or a rod; design on a plate from Python")
    return found


def impulse_place(rig: Rig, at: float | None) -> float:
    """Where the impulse acts, m: as given, or at the rig's hammer."""
    hammers = [actuator.at for actuator in rig.actuators if actuator.direct]
    if at is None and not hammers:
        raise ValueError("the place of the impulse is missing: give --impulse-at, or an [[input]] of kind hammer")
    return position(hammers[0]) if at is None else at
