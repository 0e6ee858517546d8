"""UFF 58 (universal file format, functions at nodal degrees of freedom), by pyuff."""

import json
from pathlib import Path

import numpy as np
import pyuff

from workbench.records.file_error import RecordFileError

# ordinate_spec_data_type of the format
TYPES = {"displacement": 8, "velocity": 11, "acceleration": 12, "force": 13}
QUANTITIES = {code: name for name, code in TYPES.items()}
LINE = 80


def read(path: Path):
    """(time or None, signals by name, header or None)."""
    sets = pyuff.UFF(str(path)).read_sets()
    sets = sets if isinstance(sets, list) else [sets]
    sets = [s for s in sets if s.get("type") == 58]
    if not sets:
        raise RecordFileError(f"{path} holds no data set 58")
    signals, channels, time = {}, [], None
    for number, entry in enumerate(sets, start=1):
        data = np.asarray(entry["data"])
        if np.iscomplexobj(data):
            raise RecordFileError(f"{path}, data set {number} is complex: is it a transfer function?")
        facts = _facts(entry)
        name = facts.get("name") or f"node {entry['rsp_node']} direction {entry['rsp_dir']}"
        facts = {
            "kind": "output",
            "quantity": QUANTITIES.get(entry.get("ordinate_spec_data_type"), ""),
            **facts,
            "name": name,
        }
        key = f"{facts['kind']}:{name}"
        if key in signals:
            raise RecordFileError(f"{path}, data set {number}: a second channel is called {name!r}")
        here = np.asarray(entry["x"], float)
        if time is not None and (
            here.size != time.size or np.abs(here - time).max() > 1e-6 * max(np.abs(time).max(), 1e-300)
        ):
            raise RecordFileError(f"{path}, data set {number} ({name}) has other sample instants than the first")
        time = here if time is None else time
        signals[key] = data.astype(float)
        channels.append(facts)
    header = None
    record = next((f["record"] for f in channels if "record" in f), None)
    if record is not None:
        header = {**record, "channels": channels}
    else:
        step = float(sets[0].get("abscissa_inc") or np.median(np.diff(time)))
        header = {"name": path.stem, "channels": channels, "sample_time": step, "start_time": float(time[0])}
        if np.abs(np.diff(time) - step).max() > 1e-3 * abs(step) or step <= 0:
            raise RecordFileError(f"{path} is not uniformly sampled; resample it first")
    return time, signals, header


def _facts(entry: dict) -> dict:
    """Our own description out of the five text lines, where it is there."""
    text = "".join(str(entry.get(f"id{i}", "")) for i in range(1, 6))
    start = text.find("{")
    try:
        return json.loads(text[start:]) if start >= 0 else {}
    except ValueError:
        return {}


def write(path: Path, time: np.ndarray, signals: dict, header: dict) -> None:
    """Write one data set a signal, in double precision.

    Raises:
        RecordFileError: a channel whose description does not fit the format's five lines of 80 characters.
    """
    path.unlink(missing_ok=True)
    file = pyuff.UFF(str(path))
    for i, (facts, values) in enumerate(zip(header["channels"], signals.values(), strict=True)):
        described = dict(facts)
        if i == 0:
            described["record"] = {k: header[k] for k in ("name", "sample_time", "start_time")}
        text = json.dumps(described, separators=(",", ":"))
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
