"""Export of a design: python-control objects, a MAT file, or a step function in C or Python."""

import keyword
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.io import savemat

from workbench.design.estimation.controller import Controller
from workbench.design.estimation.digital import DigitalController
from workbench.design.export.sampled import SampledDesign, sample_design
from workbench.design.export.source import source
from workbench.design.laws.law import Law
from workbench.design.laws.on_off import OnOffLaw
from workbench.records.units import SI, Units
from workbench.structure.modes import Modes

FORMATS = {".c": "c", ".py": "python", ".mat": "mat"}


def export(
    modes: Modes,
    controller: Controller | Law | OnOffLaw,
    path: str | Path | None = None,
    *,
    sample_rate_hz: float,
    computing_delay: float = 0.0,
    units: Units = SI,
) -> SampledDesign:
    """The controller discretised at a sampling rate, written to a file where a path is given.

    `controller.state_space()` of the result is python-control's discrete `StateSpace` from readings to commands.

    Args:
        modes: of the structure, controlled and residual; the sampled loop of all of them is checked.
        controller: a law through a modal filter, or on an observer.
        path: NAME.c (with NAME.h beside it), NAME.py or NAME.mat.
        sample_rate_hz: of the controller, Hz.
        computing_delay: from a reading to the first effect of its command, beside the actuators' own delays, s.
        units: of the readings, commands and states in the file.

    Raises:
        DesignError: a law that reads no sensors, a loop that is unstable, or a rate too slow for the modes; see
            `sample_design`.
        ValueError: another file suffix.
    """
    if path is not None:
        check_name(Path(path))
    design = sample_design(modes, controller, sample_rate_hz=sample_rate_hz, computing_delay=computing_delay)
    design = replace(design, units=units)
    if path is not None:
        named = replace(design.controller, states=design.states)
        write_controller(named, path, readings=design.readings, commands=design.commands)
    return design


def write_controller(
    controller: DigitalController, path: str | Path, *, readings: tuple[str, ...] = (), commands: tuple[str, ...] = ()
) -> tuple[Path, ...]:
    """Write a controller to NAME.c and NAME.h, NAME.py or NAME.mat, and return the paths.

    Args:
        controller: with its limits, dead zones, relays and friction feed-forward.
        path: the suffix selects the format; NAME is also the name of the functions in C.
        readings, commands: what each is, in words; by default the names of sensors and actuators.

    Raises:
        ValueError: another suffix, or a name that is no identifier in C or Python.
    """
    path = Path(path)
    kind = check_name(path)
    if kind == "mat":
        savemat(path, _mat(controller, readings, commands))
        return (path,)
    texts = source(controller, kind, path.stem, readings=readings, commands=commands)
    return tuple(path.with_name(name) for name, text in texts.items() if path.with_name(name).write_text(text, "utf-8"))


def check_name(path: Path) -> str:
    """The format of a file by its suffix, "c", "python" or "mat"; the name is checked to be an identifier."""
    kind = FORMATS.get(path.suffix, "")
    if not kind:
        raise ValueError(f"{path}: a controller is written as .c, .py or .mat; use one of these suffixes")
    name = path.stem
    if kind != "mat" and (not (name.isascii() and name.isidentifier()) or keyword.iskeyword(name)):
        raise ValueError(f"{path}: {name!r:.60} cannot name a function; use letters, digits and _, a letter first")
    return kind


def _mat(controller: DigitalController, readings: tuple[str, ...], commands: tuple[str, ...]) -> dict[str, object]:
    """Variables of the MAT file: the matrices, the compensation of actuators and sensors, and what each signal is."""
    one = controller
    compensation = ("offset", "scale", "limit", "rate", "dead_zone", "onset", "bias")
    content = {
        **{name: getattr(one, name) for name in ("name", "sample_time", *"ABCDE", *compensation)},
        "readings": np.array(readings or one.sensors, object),
        "commands": np.array(commands or one.actuators, object),
        "states": np.array(one.states, object),
    }
    for prefix, part in (("relay", one.relays), ("friction", one.friction)):
        content |= {f"{prefix}_{name}": value for name, value in vars(part).items()} if part else {}
    return content
