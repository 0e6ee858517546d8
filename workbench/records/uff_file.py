"""UFF 58 (universal file format, functions at nodal degrees of freedom), by pyuff."""

import json
import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyuff

from workbench.records.confined import load_confined
from workbench.records.limits import Limits, RecordFileError
from workbench.records.named_arrays import HEADER
from workbench.records.transfer_functions import DESCRIPTION

# ordinate_spec_data_type of the format
TYPES = {"displacement": 8, "velocity": 11, "acceleration": 12, "force": 13}
QUANTITIES = {code: name for name, code in TYPES.items()}
LINE = 80
TRANSFER = 4  # func_type of the format
MARK = b"    -1"
BINARY = re.compile(rb"^ +58b ", re.MULTILINE)
OURS = ('{"kind"', '"kind":', '"name":')
arrays = partial(load_confined, __name__)  # (path, limits) -> what `load` finds, by name


def load(path: Path, limits: Limits) -> dict[str, np.ndarray]:
    """The signals of all data sets 58, their instants and their header; to be called in a process of its own."""
    if not _whole(path.read_bytes()):
        raise RecordFileError(f"{path} is damaged: its last data set has no end")
    sets = [s for s in data_sets(path) if s.get("type") == 58]
    if not sets:
        raise RecordFileError(f"{path} holds no data set 58")
    transfer = [s for s in sets if s["func_type"] == TRANSFER]
    if transfer:
        return _transfer(path, transfer)
    arrays: dict[str, np.ndarray] = {}
    channels, record = [], None
    for number, entry in enumerate(sets, start=1):
        where = f"{path}, data set {number}"
        data = np.asarray(entry["data"])
        if np.iscomplexobj(data):
            raise RecordFileError(f"{where} is complex, but not marked as a transfer function (function type 4)")
        if data.size != entry["num_pts"]:
            raise RecordFileError(f"{where} holds {data.size} samples and says {entry['num_pts']}: it is damaged")
        facts = _facts(where, entry)
        record = facts.pop("record", record)
        key = f"{facts['kind']}:{facts['name']}"
        if key in arrays:
            raise RecordFileError(f"{where}: a second channel is called {facts['name']!r}")
        time = np.asarray(entry["x"], float)
        first = arrays.setdefault("t", time)
        if time.size != first.size or np.abs(time - first).max() > 1e-6 * max(np.abs(first).max(), 1e-300):
            raise RecordFileError(f"{where} ({facts['name']}) has other sample instants than the first")
        arrays[key] = data
        channels.append(facts)
    if record is None and any("noise_std" in facts for facts in channels):
        raise RecordFileError(f"{path} is damaged: its description of the record is missing")
    header = (record or {}) | {"channels": channels}
    return arrays | {HEADER: np.array(json.dumps(header))}


def data_sets(path: Path) -> list[dict[str, Any]]:
    """All data sets of a universal file."""
    sets = pyuff.UFF(str(path)).read_sets()
    return sets if isinstance(sets, list) else [sets]


def _whole(data: bytes) -> bool:
    """Whether each data set has its end; that of a binary one (58b) stands behind its last number, on no line of its
    own."""
    if BINARY.search(data):
        return data.rstrip().endswith(MARK)
    return sum(line.rstrip() == MARK for line in data.splitlines()) % 2 == 0


def _transfer(path: Path, sets: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    """All pairs of response and reference as one array, with their lines and names."""
    lines = np.asarray(sets[0]["x"], float)
    found: dict[tuple[str, str], np.ndarray] = {}
    outputs: dict[str, str] = {}
    for number, entry in enumerate(sets, start=1):
        where, x = f"{path}, transfer function {number}", np.asarray(entry["x"], float)
        data = np.asarray(entry["data"], complex)
        if x.shape != lines.shape or data.shape != lines.shape or np.abs(x - lines).max() > 1e-6 * np.abs(lines).max():
            raise RecordFileError(f"{where} has other lines than the first; keep those of one measurement")
        pair = (f"node {entry['rsp_node']} direction {entry['rsp_dir']}",
                f"node {entry['ref_node']} direction {entry['ref_dir']}")  # fmt: skip
        if pair in found:
            raise RecordFileError(f"{where}: a second one from {pair[1]} to {pair[0]}; keep one of them")
        found[pair] = data
        outputs[pair[0]] = QUANTITIES.get(entry["ordinate_spec_data_type"], "")
    references = list(dict.fromkeys(pair[1] for pair in found))
    for pair in ((output, reference) for output in outputs for reference in references):
        if pair not in found:
            raise RecordFileError(
                f"{path} lacks the transfer function from {pair[1]} to {pair[0]}; the others are there"
            )
    values = np.array([[found[output, reference] for reference in references] for output in outputs])
    described = {"outputs": [{"name": n, "quantity": q} for n, q in outputs.items()], "references": references}
    return {"frequency_hz": lines, "transfer": values, DESCRIPTION: np.array(json.dumps(described))}


def as_stored(values: np.ndarray) -> np.ndarray:
    """Values as the format's twelve digits keep them."""
    return np.array(("%.11e " * values.size % tuple(values)).split(), float)


def _facts(where: str, entry: dict[str, Any]) -> dict[str, Any]:
    """Our own description out of the five text lines, or what the data set itself says."""
    text = "".join(str(entry.get(f"id{i}", "")) for i in range(1, 6))
    if not any(sign in text for sign in OURS):
        name = f"node {entry['rsp_node']} direction {entry['rsp_dir']}"
        return {"kind": "output", "name": name, "quantity": QUANTITIES.get(entry["ordinate_spec_data_type"], "")}
    try:
        facts = json.loads(text[text.index("{") :])
        return {**facts, "kind": str(facts["kind"]), "name": str(facts["name"])}
    except (ValueError, KeyError, TypeError) as error:
        raise RecordFileError(f"{where}: its description is damaged: {error}") from error


def write(path: Path, time: np.ndarray, signals: dict[str, Any], header: dict[str, Any]) -> None:
    """Write one data set a signal, in double precision.

    Raises:
        RecordFileError: a channel whose description does not fit the format's five lines of 80 characters.
    """
    path.unlink(missing_ok=True)
    file = pyuff.UFF(str(path))
    for i, (facts, values) in enumerate(zip(header["channels"], signals.values(), strict=True)):
        described = dict(facts)
        if i == 0:
            described["record"] = {key: value for key, value in header.items() if key != "channels"}
        # spaces at the end of a line would be lost
        text = json.dumps(described, separators=(",", ":")).replace(" ", r"\u0020")
        if len(text) > 5 * LINE:
            raise RecordFileError(f"{path}: the names of channel {facts['name']!r} are too long for UFF; shorten them")
        lines = {f"id{j + 1}": text[j * LINE : (j + 1) * LINE].ljust(LINE, " ") or " " for j in range(5)}
        file.write_sets(
            pyuff.prepare_58(
                **lines,
                binary=0,
                func_type=1,
                rsp_node=i + 1,
                rsp_dir=3,
                ref_node=1,
                ref_dir=3,
                ver_num=0,
                ord_data_type=4,
                abscissa_spacing=1,
                num_pts=values.size,
                abscissa_min=float(time[0]),
                abscissa_inc=header["sample_time"],
                abscissa_spec_data_type=17,
                orddenom_spec_data_type=0,
                z_axis_spec_data_type=0,
                ordinate_spec_data_type=TYPES.get(facts["quantity"], 0),
                x=time,
                data=np.asarray(values, float),
                return_full_dict=False,
            ),
            mode="add",
        )
