"""Arguments and options that several commands have."""

from pathlib import Path
from typing import Annotated

import typer

DAMPING = 0.1  # ratio, unless given
ESTIMATORS = ("luenberger", "kalman", "modal-filter")

JsonPath = Annotated[Path | None, typer.Option("--json", help="Write the results to this file as JSON.")]
Memory = Annotated[float, typer.Option(help="Memory that reading a file may take, GiB.")]
SampleRate = Annotated[float | None, typer.Option(help="Sampling rate, Hz, where the file has no time axis.")]
InputHold = Annotated[
    str | None,
    typer.Option(
        metavar="HOLD",
        help="Intersample behaviour of the inputs: zero (held, as a command), band-limited (as a force measured behind"
        " an anti-alias filter) or first (first-order hold, linear); as the file says unless given.",
    ),
]
PagePath = Annotated[Path | None, typer.Option("--page", help="HTML file to write; default out/NAME.html.")]
CasePath = Annotated[Path, typer.Argument(help="Case folder: case.toml and its records.")]
VerdictPath = Annotated[
    Path | None, typer.Option(help="Verdict that `workbench diagnose --json` wrote; diagnosed now unless given.")
]
Workers = Annotated[int | None, typer.Option(help="Processes that share the diagnosis; one per core unless given.")]
# a bracket that opens a word would be taken for markup of the help text
RigPath = Annotated[
    Path, typer.Argument(help=r"Case folder, or TOML file with \[structure], \[\[input]] and \[\[output]].")
]
ImpulseAt = Annotated[
    str | None,
    typer.Option(
        metavar="PLACE",
        help="Place of the impulse: m (X,Y on a plate), a point or an input by name; unless given, that of"
        " the input of kind hammer.",
    ),
]
Weight = Annotated[
    float, typer.Option(help="Control weight R: of forces in the cost and coupled LQR, of modal forces in IMSC.")
]
LawName = Annotated[str, typer.Option(help="Control law: imsc, coupled, poles or on-off.")]
LinearLawName = Annotated[str, typer.Option("--law", help="Control law: imsc, coupled or poles.")]
Control = Annotated[
    int | None,
    typer.Option(
        "--controlled-modes", help="Number of controlled modes, lowest first; as many as actuators unless given."
    ),
]
LawWeight = Annotated[
    float | None,
    typer.Option("--weight", help="Control weight R of forces (imsc: of modal forces), in place of --damping."),
]
Damping = Annotated[
    float | None,
    typer.Option(
        help=f"Damping ratio of the controlled modes, {DAMPING:g} unless given: exact for poles; approximate for imsc"
        " and coupled, where it is small, and the output says which ratios result; not for on-off."
    ),
]
Disturbance = Annotated[
    float,
    typer.Option(
        help="For the Kalman filter: intensity of white modal forces; a smaller one makes it slower. The sensors' noise"
        " is noise_std of the outputs."
    ),
]
RecordName = Annotated[
    str, typer.Argument(metavar="RECORD", help="File with a column for each input, or a record of the case by name.")
]
Draws = Annotated[int, typer.Option(help="Draws of the uncertain model from which the bands are computed, 40 or more.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the draws and of the noise.")]
