"""A case from records alone: a linear model identified at a low level, and records at a higher level to diagnose."""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from workbench.cases.case import Case
from workbench.identification.driven import identify_driven
from workbench.identification.rig_from import rig_from
from workbench.records.files import read_record
from workbench.records.record import Record
from workbench.rig.sensors import MEASURED

UNSCALED = "no output is at the place of an input"  # how the warning of `rig_from` begins that has another remedy here
NO_SCALE = (
    "so the shapes have no scale: responses to these inputs are right, those to masses, springs or forces elsewhere are"
    " not; give --driving-point INPUT,OUTPUT, an input and the output at its place"
)


def measured_case(
    nominal: Path,
    records: Sequence[Path],
    validation: Sequence[Path] = (),
    *,
    inputs: tuple[str, ...] = (),
    input_hold: str | None = None,
    quantity: str = "",
    driving_point: tuple[str, ...] = (),
) -> Case:
    """The case whose nominal rig is identified from one driven record.

    Args:
        nominal: file of a record at so low a level that the structure is linear.
        records: files of the records to diagnose, with the same channels.
        validation: files of records for validation only.
        inputs: names of the input channels, if the files do not state them.
        input_hold: hold of the inputs between samples, "zero", "first" or "band-limited"; that of the files unless
            given.
        quantity: of outputs whose files state none: "displacement", "velocity" or "acceleration".
        driving_point: an input and the output at its place, which scale the shapes; a pair of the same name or place
            unless given.

    Raises:
        ValueError: no inputs, outputs of unknown quantity, files with different channels, a driving point with unknown
            names, a file given twice, or one that repeats the nominal record.
    """

    def read(path: Path, name: str) -> Record:
        record = read_record(path, inputs=inputs, input_hold=input_hold)
        channels = [replace(c, quantity=c.quantity or quantity, unit=c.unit) for c in record.output_channels]
        return replace(record, output_channels=tuple(channels), name=name)

    every = (*records, *validation)
    names = _names(every)
    low = read(nominal, nominal.stem)
    if not low.n_inputs:
        forces = ",".join(channel.name for channel in low.output_channels if channel.quantity == "force") or "NAME"
        raise ValueError(f"{nominal}: no channel is an input, so no model can be simulated; give --inputs {forces}")
    unknown = [channel.name for channel in low.output_channels if channel.quantity not in MEASURED]
    if unknown:
        raise ValueError(f"{nominal}: the quantity of {', '.join(unknown)} is not stated; give --quantity acceleration")
    if len(driving_point) not in (0, 2):
        raise ValueError(f"--driving-point is INPUT,OUTPUT; got {','.join(driving_point)}")
    pair = (driving_point[0], driving_point[1]) if driving_point else None
    read_all = tuple(map(read, every, names))
    for path, record in zip(every, read_all, strict=True):
        if record.repeats(low):
            raise ValueError(
                f"{path} holds the same measurement as --nominal {nominal}: the model is identified from it, so it"
                " shows no gap; give --nominal a record at low level, and --records and --validation others"
            )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        rig = rig_from(identify_driven([low]), driving_point=pair)
    for each in caught:
        unscaled = str(each.message).startswith(UNSCALED)
        warnings.warn(f"{UNSCALED}, {NO_SCALE}" if unscaled else str(each.message), each.category, stacklevel=2)
    return Case(nominal.stem, rig, read_all[: len(records)], read_all[len(records) :])


def _names(paths: Sequence[Path]) -> list[str]:
    """Names of the records: file names without suffix, preceded by as many folders as make them unique."""
    whole = [path.resolve() for path in paths]
    for depth in range(max(len(path.parts) for path in whole)):
        names = ["/".join((*path.parts[-1 - depth : -1], path.stem)) for path in whole]
        if len(set(names)) == len(names):
            return names
    twice = next(path for path, name in zip(paths, names, strict=True) if names.count(name) > 1)
    raise ValueError(f"{twice} is given twice, or another record differs only in the suffix; give each record once")
