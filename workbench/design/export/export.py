"""A design handed over: python-control objects, a MAT file, or a step function in C or Python."""

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

LANGUAGES = {".c": "c", ".py": "python"}


def export(
    modes: Modes,
    controller: Controller | Law | OnOffLaw,
    path: str | Path | None = None,
    *,
    sample_rate_hz: float,
    computing_delay: float = 0.0,
    units: Units = SI,
) -> SampledDesign:
    """The controller as a computer runs it once a sample, written to a file where a path is given.

    Its `controller.state_space()` is python-control's discrete `StateSpace` from readings to commands.

    Args:
        modes: of the structure, controlled and residual; the sampled loop of all of them is checked.
        controller: a law through a modal filter, or on an observer.
        path: NAME.c (with NAME.h beside it), NAME.py or NAME.mat.
        sample_rate_hz: at which it is to run, Hz.
        computing_delay: from a reading to the first effect of its command, beside the actuators' own delays, s.
        units: by which the file tells readings, commands and states.

    Raises:
        DesignError: a law that reads no sensors, a loop that is unstable, or a rate too slow for the modes; see
            `sample_design`.
        ValueError: a file name of another kind.
    """
    kind = None if path is None else check_name(Path(path))
    design = sample_design(modes, controller, sample_rate_hz=sample_rate_hz, computing_delay=computing_delay)
    design = replace(design, units=units)
    if path is not None and kind is not None:
        named = replace(design.controller, states=design.states)
        write_controller(named, path, readings=design.readings, commands=design.commands)
    return design


def write_controller(
    controller: DigitalController, path: str | Path, *, readings: tuple[str, ...] = (), commands: tuple[str, ...] = ()
) -> tuple[Path, ...]:
    """The files written: NAME.c and NAME.h, NAME.py or NAME.mat, as the path says.

    Args:
        controller: with all that it makes up for: limits, dead zones, relays, friction.
        path: its ending names the kind; its name that of the functions in C.
        readings, commands: what each is, in words; names of sensors and actuators unless given.

    Raises:
        ValueError: an ending of another kind, or a name that C or Python cannot have.
    """
    path = Path(path)
    kind = check_name(path)
    if kind == "mat":
        savemat(path, _mat(controller, readings, commands))
        return (path,)
    texts = source(controller, kind, path.stem, readings=readings, commands=commands)
    return tuple(path.with_name(name) for name, text in texts.items() if path.with_name(name).write_text(text, "utf-8"))


def check_name(path: Path) -> str:
    """What a file's name says it is to hold: "c", "python" or "mat".

    Raises:
        ValueError: an ending of another kind, or a name that C or Python cannot have.
    """
    kind = "mat" if path.suffix == ".mat" else LANGUAGES.get(path.suffix, "")
    if not kind:
        raise ValueError(f"{path}: a controller is written as .c, .py or .mat; name the file so")
    name = path.stem
    if kind != "mat" and (not (name.isascii() and name.isidentifier()) or keyword.iskeyword(name)):
        raise ValueError(f"{path}: {name!r:.60} cannot name a function; use letters, digits and _, a letter first")
    return kind


def _mat(controller: DigitalController, readings: tuple[str, ...], commands: tuple[str, ...]) -> dict[str, object]:
    """Variables of the MAT file: the five matrices, what is made up for, and what each signal is."""
    one = controller
    content = {
        "name": one.name,
        "sample_time": one.sample_time,
        **{letter.upper(): getattr(one, letter) for letter in "abcde"},
        **{name: getattr(one, name) for name in ("offset", "scale", "limit", "rate", "dead_zone", "onset", "bias")},
        "readings": np.array(readings or one.sensors, object),
        "commands": np.array(commands or one.actuators, object),
        "states": np.array(one.states, object),
    }
    if one.relays is not None:
        content |= {"relay_spread": one.relays.spread, "relay_force": one.relays.force}
        content |= {"relay_dead_band": one.relays.dead_band}
    if one.friction is not None:
        content |= {f"friction_{name}": getattr(one.friction, name) for name in one.friction.__dataclass_fields__}
    return content
