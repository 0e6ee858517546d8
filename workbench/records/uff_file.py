"""UFF 58 (universal file format, functions at nodal degrees of freedom), by pyuff."""

import json
import re
from collections.abc import Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pyuff

from workbench.records.assembly import unit_remark
from workbench.records.confined import load_confined
from workbench.records.frf_arrays import description
from workbench.records.limits import ReadLimits, RecordFileError
from workbench.records.named_arrays import HEADER
from workbench.records.units import BY_QUANTITY, UNITS, unit_named

# ordinate_spec_data_type of the format
TYPES = {"displacement": 8, "velocity": 11, "acceleration": 12, "force": 13}
QUANTITIES = {code: name for name, code in TYPES.items()}
LINE = 80
FRF = 4  # func_type of the format
FUNCTIONS = {2: "auto spectrum", 3: "cross spectrum", 5: "transmissibility", 6: "coherence",
             9: "power spectral density", 10: "energy spectral density", 12: "spectrum"}  # fmt: skip
OVER_TIME = (0, 1, 7, 8)  # general or unknown, time response, auto and cross correlation
TIME = (0, 1, 17)  # abscissa_spec_data_type of the format: unknown, general, time
TURNS = ("rpm", "cpm", "1/min")
ALIKE = 1e-3  # relative tolerance of factors of units, which data sets 164 round
SIX_DIGITS = 1e-5  # relative: the rounding of start and step in a data set
MARK = b"    -1"
BINARY = re.compile(rb"^ +58b ", re.MULTILINE)
OURS = ('{"kind"', '"kind":', '"name":')
arrays = partial(load_confined, __name__)  # (path, limits) -> arrays by name, by `load` in a separate process


def load(path: Path, limits: ReadLimits) -> dict[str, np.ndarray]:
    """The signals of all data sets 58, their instants and their header; to be called in a separate process."""
    if not _whole(path.read_bytes()):
        raise RecordFileError(f"{path} is damaged: its last data set has no end")
    every = data_sets(path)
    sets = [s for s in every if s.get("type") == 58]
    if not sets:
        raise RecordFileError(f"{path} holds no data set 58")
    system = next((s for s in every if s.get("type") == 164), None)
    frf = [s for s in sets if s["func_type"] == FRF]
    if frf:
        return _frfs(path, frf, system)
    over_time = [(number, entry) for number, entry in enumerate(sets, start=1)
                 if entry["func_type"] in OVER_TIME and entry["abscissa_spec_data_type"] in TIME]  # fmt: skip
    if not over_time:
        held = [("complex " if np.iscomplexobj(s["data"]) else "")
                + FUNCTIONS.get(s["func_type"], f"type {s['func_type']}") for s in sets]  # fmt: skip
        raise RecordFileError(
            f"{path} holds no signal over time and no FRF, but {', '.join(dict.fromkeys(held))}; export"
            " time responses (function type 1) or FRFs (4)"
        )
    arrays: dict[str, np.ndarray] = {}
    channels, record = [], None
    names = _names([entry for _, entry in over_time])
    for (number, entry), name in zip(over_time, names, strict=True):
        where = f"{path}, data set {number}"
        data = np.asarray(entry["data"])
        if np.iscomplexobj(data):
            raise RecordFileError(f"{where} is complex, but not marked as an FRF (function type 4)")
        if data.size != entry["num_pts"]:
            raise RecordFileError(f"{where} holds {data.size} samples and states {entry['num_pts']}: it is damaged")
        key, facts = _channel(where, entry, name, system)
        record = facts.pop("record", record)
        if key in arrays:
            raise RecordFileError(
                f"{where}: a second channel is called {key.partition(':')[2]!r}; export each with its own node and"
                " direction, or its own text in ID line 1"
            )
        time = _abscissa(where, entry, "time")
        first = arrays.setdefault("t [s]", time)
        if time.size != first.size or np.abs(time - first).max() > 1e-6 * max(np.abs(first).max(), 1e-300):
            raise RecordFileError(f"{where} ({key.partition(':')[2]}) has other sample instants than the first")
        arrays[key] = data
        channels += [facts] if facts else []
    if record is None and any("noise_std" in facts for facts in channels):
        raise RecordFileError(f"{path} is damaged: its description of the record is missing")
    if record is not None:
        arrays["t [s]"] = _unrounded(arrays["t [s]"], record)
    header = (record or {}) | {"channels": channels}
    return arrays | {HEADER: np.array(json.dumps(header))}


def _unrounded(time: np.ndarray, record: dict[str, Any]) -> np.ndarray:
    """The instants that the description of a record states, where those of the file are these to six digits."""
    try:
        start, step = float(record["start_time"]), float(record["sample_time"])
    except (KeyError, TypeError, ValueError):  # damaged, as the assembly of the record says
        return time
    stated = start + step * np.arange(time.size)
    return stated if np.abs(stated - time).max() <= SIX_DIGITS * (abs(start) + step * time.size) else time


def data_sets(path: Path) -> list[dict[str, Any]]:
    """All data sets of a universal file."""
    sets = pyuff.UFF(str(path)).read_sets()
    return sets if isinstance(sets, list) else [sets]


def _whole(data: bytes) -> bool:
    """Whether each data set has its end mark; that of a binary one (58b) follows its last number on the same line."""
    if BINARY.search(data):
        return data.rstrip().endswith(MARK)
    return sum(line.rstrip() == MARK for line in data.splitlines()) % 2 == 0


def _frfs(path: Path, sets: list[dict[str, Any]], system: dict[str, Any] | None) -> dict[str, np.ndarray]:
    """The FRFs of all pairs of response and reference as one array, in SI, with their lines and names."""
    lines = _abscissa(f"{path}, FRF 1", sets[0], "frequency")
    found: dict[tuple[str, str], np.ndarray] = {}
    outputs: dict[str, dict[str, str]] = {}
    remarks: dict[str, None] = {}
    for number, entry in enumerate(sets, start=1):
        where = f"{path}, FRF {number}"
        x = _abscissa(where, entry, "frequency")
        data = np.asarray(entry["data"], complex)
        if x.shape != lines.shape or data.shape != lines.shape or np.abs(x - lines).max() > 1e-6 * np.abs(lines).max():
            raise RecordFileError(f"{where} has other lines than the first; keep those of one measurement")
        pair = _node(entry, "rsp"), _node(entry, "ref")
        if pair in found:
            raise RecordFileError(f"{where}: a second one from {pair[1]} to {pair[0]}; keep one of them")
        quantity, output = _measured(where, entry, "ordinate", system)
        _, reference = _measured(where, entry, "orddenom", system)
        if unit_named(output) is None and "/" in output:  # of both, as in g/N
            output, _, reference = output.rpartition("/")
        top, bottom = unit_named(output.strip("() ")), unit_named(reference)
        found[pair] = data * (top.factor if top else 1.0) / (bottom.factor if bottom else 1.0)
        outputs[pair[0]] = {"quantity": top.quantity if top else quantity, "unit": top.si if top else output}
        remarks |= {unit_remark(name, text, unit): None
                    for name, text, unit in zip(pair, (output, reference), (top, bottom)) if unit}  # fmt: skip
    references = list(dict.fromkeys(pair[1] for pair in found))
    mirrored = [pair for pair in product(outputs, references) if pair not in found]
    for output, reference in mirrored:
        if (reference, output) not in found or outputs[reference] != outputs[output]:
            raise RecordFileError(
                f"{path} lacks the FRF from {reference} to {output}; export those of one reference, or of"
                " all to every output"
            )
    if mirrored:
        named = ", ".join(f"{reference} to {output}" for output, reference in mirrored)
        remarks[f"by reciprocity, those from {named}"] = None
        found |= {(output, reference): found[reference, output] for output, reference in mirrored}
    values = np.array([[found[output, reference] for reference in references] for output in outputs])
    return {"frequency_hz": lines, "frf": values, **description(outputs, references, remarks)}


def as_stored(values: np.ndarray) -> np.ndarray:
    """Values rounded to the twelve digits of the format."""
    return np.array(("%.11e " * values.size % tuple(values)).split(), float)


def _names(entries: Sequence[dict[str, Any]]) -> list[str]:
    """Names of channels: node and direction of the response, or ID line 1 where only that differs between them."""
    nodes = [_node(entry, "rsp") for entry in entries]
    lines = [str(entry.get("id1", "")).strip() for entry in entries]
    return lines if len(set(nodes)) < len(nodes) and len(set(lines)) == len(lines) and all(lines) else nodes


def _channel(where: str, entry: dict[str, Any], name: str, system: dict[str, Any] | None) -> tuple[str, dict[str, Any]]:
    """Key and description of a channel, from the text lines written by this program or from the data set itself.

    The description is empty where a known unit follows the name, of `_names`.
    """
    text = "".join(str(entry.get(f"id{i}", "")) for i in range(1, 6))
    if not any(sign in text for sign in OURS):
        quantity, unit = _measured(where, entry, "ordinate", system)
        if unit_named(unit) is not None:
            return f"output:{name} [{unit}]", {}
        return f"output:{name}", {"kind": "output", "name": name, "quantity": quantity, "unit": unit}
    try:
        facts = json.loads(text[text.index("{") :])
        return f"{facts['kind']}:{facts['name']}", {**facts, "kind": str(facts["kind"]), "name": str(facts["name"])}
    except (ValueError, KeyError, TypeError) as error:
        raise RecordFileError(f"{where}: its description is damaged: {error}") from error


def _node(entry: dict[str, Any], which: str) -> str:
    return f"node {entry[f'{which}_node']} direction {entry[f'{which}_dir']}"


def _label(entry: dict[str, Any], axis: str) -> str:
    """The unit of an axis, as written; empty where none is stated."""
    label = str(entry.get(f"{axis}_axis_units_lab", "")).strip()
    return "" if label.upper() == "NONE" else label


def _abscissa(where: str, entry: dict[str, Any], quantity: str) -> np.ndarray:
    """Instants in s, or lines in Hz."""
    label = _label(entry, "abscissa")
    unit, x = unit_named(label), np.asarray(entry["x"], float)
    if unit is not None and unit.quantity == quantity:
        return x * unit.factor
    if unit is not None and (quantity, unit.quantity) == ("frequency", "angular velocity"):
        return x * (unit.factor / (2.0 * np.pi))
    if quantity == "frequency" and label.lower() in TURNS:
        return x / 60.0
    if label:
        known = ", ".join(name for name, one in UNITS.items() if one.quantity == quantity)
        raise RecordFileError(f"{where}: its abscissa is in {label!r}, which is no unit of {quantity}; export {known}")
    return x


def _measured(where: str, entry: dict[str, Any], axis: str, system: dict[str, Any] | None) -> tuple[str, str]:
    """Quantity, by its code, and unit, as written or else by the file's system of units."""
    quantity, label = QUANTITIES.get(entry[f"{axis}_spec_data_type"], ""), _label(entry, axis)
    unit = unit_named(label)
    if unit is not None and quantity and unit.quantity in TYPES and unit.quantity != quantity:
        raise RecordFileError(
            f"{where} is {quantity} by its type and {unit.quantity} by its unit, {label}; correct one"
        )
    if label or not quantity or system is None:
        return quantity, label
    scale = float(system["force" if quantity == "force" else "length"])  # of its units, in one of SI
    names = BY_QUANTITY[quantity][1]
    named = next((name for name, factor in names.items() if abs(factor * scale - 1.0) < ALIKE), None)
    if named is None:
        raise RecordFileError(f"{where} states no unit, and that of data set 164, {scale:g} in SI's, is not known")
    return quantity, named


def write(path: Path, time: np.ndarray, signals: dict[str, Any], header: dict[str, Any]) -> None:
    """Write one data set per signal, in double precision, its description in the format's five lines of text."""
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
        lines = {f"id{j + 1}": text[j * LINE : (j + 1) * LINE] or " " for j in range(5)}
        point = {"rsp_node": i + 1, "rsp_dir": 3, "ref_node": 1, "ref_dir": 3}
        axes = {"abscissa_spacing": 1, "abscissa_spec_data_type": 17, "orddenom_spec_data_type": 0,
                "ordinate_spec_data_type": TYPES.get(facts["quantity"], 0)}  # fmt: skip
        numbers = {"x": time, "data": np.asarray(values, float)}
        file.write_sets({"type": 58, "func_type": 1, **lines, **point, **axes, **numbers}, mode="add")
