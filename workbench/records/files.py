"""Reading and writing of records: text tables, NPZ, MAT, HDF5, UFF 58, TDMS and WAV.

Properties without a place in a format (places, noise, which signals are inputs, their hold) are stored as a JSON text:
in a comment of a CSV, an entry of an NPZ or MAT, an attribute of HDF5, the description lines of a UFF. A checksum in it
detects later changes of the file. Files of other programs have no such text: all their signals are outputs, with the
names in the file.
"""

from dataclasses import replace
from pathlib import Path
from types import ModuleType

from workbench.records import csv_file, hdf5_file, mat_file, npz_file, tdms_file, uff_file, wav_file
from workbench.records.assembly import KEY, checksum, facts_of, legible, record_of
from workbench.records.frequency_responses import FrequencyResponses
from workbench.records.frf_arrays import complex_columns, frfs_of, holds_frfs
from workbench.records.limits import DEFAULT, ReadLimits, RecordFileError, check_file, reading
from workbench.records.named_arrays import signals_of
from workbench.records.record import Record
from workbench.records.units import SI, Units

FORMATS: dict[str, ModuleType] = {
    **dict.fromkeys((".csv", ".txt", ".asc", ".dat", ".tsv", ".lvm"), csv_file),
    ".npz": npz_file,
    ".mat": mat_file,
    **dict.fromkeys((".h5", ".hdf5"), hdf5_file),
    **dict.fromkeys((".uff", ".unv"), uff_file),
    ".tdms": tdms_file,
    ".wav": wav_file,
}
READ_ONLY = (".tdms", ".wav")
GIVEN = ("record", "simulated", "free decay")  # names of records that nobody named


def read_record(
    path: str | Path,
    *,
    sample_rate_hz: float | None = None,
    inputs: tuple[str, ...] = (),
    input_hold: str | None = None,
    limits: ReadLimits = DEFAULT,
    units: Units = SI,
) -> Record:
    """A record from a file, whose suffix selects the format.

    Units that the file states, after the names as in `Acc [g]` or beside the data, are converted to SI or to `units`,
    and unequal time steps are resampled; `Record.remarks` lists the changes.

    Args:
        path: of a .csv, .txt, .asc, .dat, .tsv, .npz, .mat, .h5, .hdf5, .uff, .unv, .tdms or .wav file.
        sample_rate_hz: where the file itself has no time.
        inputs: names of the input signals, where the file does not say.
        input_hold: "zero", "first" or "band-limited", the intersample behaviour; by default as the file
            says, else "zero". Files of other programs do not say.
        limits: of memory and processor time, `records.limits.ReadLimits`: 1 GiB and 10 s by default.
        units: of the signals, such as those of a case; numbers without a stated unit are not converted.

    Raises:
        RecordFileError: a file that is no record; the message names file, channel and row, and the remedy. Transfer
            functions; more than the limits allow; a stated unit that cannot be converted to `units`.
    """
    measured = read_measured(
        path, sample_rate_hz=sample_rate_hz, inputs=inputs, input_hold=input_hold, limits=limits, units=units
    )
    if isinstance(measured, FrequencyResponses):
        raise RecordFileError(
            f"{path} is complex: it holds FRFs, no record. Identify their modes by `workbench identify`,"
            " or by read_measured and identify_frf"
        )
    return measured


def read_measured(
    path: str | Path,
    *,
    sample_rate_hz: float | None = None,
    inputs: tuple[str, ...] = (),
    outputs: tuple[str, ...] = (),
    input_hold: str | None = None,
    limits: ReadLimits = DEFAULT,
    units: Units = SI,
) -> Record | FrequencyResponses:
    """The contents of a file: a record, or FRFs where the data are complex.

    FRFs are complex arrays of MAT, NPZ or HDF5, shape ([n_outputs, [n_references,]] n_frequencies) with
    the axes in any order, with their lines (`frequency_hz`, `f`, ..., or `omega`) or a sample rate; data sets 58 of
    UFF of function type 4; tables that begin with a column `frequency`, then `NAME real`, `NAME imag`, or
    `NAME magnitude`, `NAME phase [deg]`.

    Args:
        path, inputs, input_hold, limits, units: as for `read_record`; FRFs are always in SI.
        outputs: names of the outputs to read, all unless given; what other channels hold does not matter then.
        sample_rate_hz: where the file itself has no time, or no lines, which are then from zero to the Nyquist
            frequency.

    Raises:
        RecordFileError: the message names file, channel and row, and the remedy.
    """
    path = Path(path)
    module = _format(path)
    check_file(path)
    with reading(path):
        if module is csv_file:
            contents = csv_file.read(path, limits)
            # in a table with sample instants, a column called F is a force
            arrays = complex_columns(path, contents.signals) if contents.time is None else {}
        else:
            arrays = module.arrays(path, limits)
            if not holds_frfs(arrays):
                contents = signals_of(path, arrays)
    if holds_frfs(arrays):
        if inputs or input_hold is not None:
            raise RecordFileError(f"{path} holds FRFs, which name no inputs; leave them and their hold out")
        frf = frfs_of(path, arrays, sample_rate_hz=sample_rate_hz)
        return frf.select_outputs(outputs) if outputs else frf
    record = record_of(path, contents, sample_rate_hz=sample_rate_hz, inputs=inputs, outputs=outputs, into=units)
    return record if input_hold is None else replace(record, input_hold=input_hold)


def named_by_file(measured: Record | FrequencyResponses, path: Path) -> Record | FrequencyResponses:
    """What was read from a file, by the file's name where it was stored under a name that nobody gave it."""
    unnamed = isinstance(measured, Record) and measured.name in GIVEN
    return replace(measured, name=path.stem) if unnamed else measured


def write_record(record: Record, path: str | Path) -> Path:
    """Write a record to a file, whose suffix selects the format; reading it gives the same record, without remarks.

    UFF 58 stores each channel with its own header; the other formats store all signals together.

    Raises:
        RecordFileError: an unknown suffix, a channel name that is not printable, or a single sample.
    """
    path = Path(path)
    module = _format(path)
    if path.suffix.lower() in READ_ONLY:
        written = ", ".join(sorted(set(FORMATS) - set(READ_ONLY)))
        raise RecordFileError(f"{path}: {path.suffix} is read, not written; use one of {written}")
    if record.n_samples < 2:
        raise RecordFileError(f"{path}: record {record.name!r} has one sample; a file needs two, which state the rate")
    signals = {f"{kind}:{legible(path, channel.name)}": row for kind, channel, row in record.signals()}
    header = {
        "name": record.name,
        "sample_time": record.sample_time,
        "start_time": record.start_time,
        "input_hold": record.input_hold,
        "channels": [facts_of(kind, channel) for kind, channel, _ in record.signals()],
    }
    stored = map(module.as_stored, signals.values()) if module is uff_file else signals.values()
    header[KEY] = checksum(header, stored)
    path.parent.mkdir(parents=True, exist_ok=True)
    module.write(path, record.time, signals, header)
    return path


def _format(path: Path) -> ModuleType:
    if path.is_dir():
        files = (file for depth in ("*", "*/*") for file in sorted(path.glob(depth)) if file.suffix.lower() in FORMATS)
        found = next(filter(Path.is_file, files), None)
        remedy = f"give a file of {', '.join(FORMATS)}" if found is None else f"give a file in it, such as {found}"
        raise RecordFileError(f"{path} is a folder; {remedy}")
    if path.suffix.lower() not in FORMATS:
        raise RecordFileError(f"{path}: the ending {path.suffix!r} names no format; use one of {', '.join(FORMATS)}")
    return FORMATS[path.suffix.lower()]
