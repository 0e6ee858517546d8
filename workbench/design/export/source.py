"""A controller as C or Python source, from templates: one function that is called once per sample."""

from collections.abc import Collection, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from jinja2 import Environment, StrictUndefined

from workbench.arrays import Floats
from workbench.design.estimation.digital import DigitalController
from workbench.records.record import QUANTITIES
from workbench.records.units import SI, Units
from workbench.rig.actuators import Actuator, force_unit
from workbench.rig.sensors import Sensor
from workbench.structure.domain import Domain

HERE = Path(__file__).parent
TEMPLATES = {"c": ("h", "c"), "python": ("py",)}
WIDTH = 108
DIGITS = 6  # of a place, to distinguish channels


def source(
    controller: DigitalController, language: str, name: str, *, readings: Sequence[str], commands: Sequence[str]
) -> dict[str, str]:
    """The source of a controller, {file name: text}.

    Args:
        controller: to write.
        language: "c" or "python".
        name: of the files and, in C, of the functions.
        readings, commands: what each is, in words; where empty, the names.
    """
    infinite = "INFINITY" if language == "c" else "inf"
    matrices, vectors = _numbers(controller)
    n_states, n_readings, n_commands = len(controller.A), len(controller.sensors), len(controller.actuators)
    words = {
        "name": name,
        "title": fill(f"{_plain(controller.name)}, at {1 / controller.sample_time:.6g} Hz", WIDTH),
        "period": f"{controller.sample_time:.10g}",
        "rate": f"{1 / controller.sample_time:.6g}",
        "equations": "\n".join(_equations(matrices, vectors)),
        "signals": "\n".join(
            f"{array}[{i}]  {_plain(text)}"
            for array, texts in (
                ("reading", readings or controller.sensors),
                ("command", commands or controller.actuators),
                ("z", controller.states or ["state of the controller"] * n_states),
            )
            for i, text in enumerate(texts)
        ),
        "matrices": {key: _literals(values, infinite) for key, values in matrices.items()},
        "vectors": {key: _literals(values, infinite) for key, values in vectors.items()},
        "uses_math": bool(vectors.keys() - {"SCALE", "OFFSET", "BIAS"}),
        "n_states": n_states,
        "n_readings": n_readings,
        "n_commands": n_commands,
        "n_outputs": len(controller.D),
    }
    environment = Environment(undefined=StrictUndefined, keep_trailing_newline=True)
    texts = {end: (HERE / f"step.{end}.jinja").read_text(encoding="utf-8") for end in TEMPLATES[language]}
    return {f"{name}.{end}": environment.from_string(text).render(words) for end, text in texts.items()}


def _numbers(controller: DigitalController) -> tuple[dict[str, Floats], dict[str, Floats]]:
    """The matrices and the vectors of a controller, without those that have no effect."""
    one, relays, friction = controller, controller.relays, controller.friction
    matrices: dict[str, Floats] = {"D": one.D}
    vectors: dict[str, Floats] = {}
    if len(one.A):
        matrices |= {"A": one.A, "B": one.B, "C": one.C}
        if one.E.any():
            matrices["E"] = one.E
    if one.offset.any() or (one.scale != 1).any():
        vectors |= {"SCALE": one.scale, "OFFSET": one.offset}
    if relays is not None:
        matrices["ALLOCATION"] = relays.allocation
        vectors |= {"FORCE": relays.force, "DEAD_BAND": relays.dead_band}
    if friction is not None:
        matrices |= {"FRICTION_GAIN": friction.gain, "SPEED_Y": friction.of_reading}
        if len(one.A):
            matrices["SPEED_Z"] = friction.of_state
        vectors |= {"FRICTION": friction.force, "SMOOTHING": friction.smoothing}
    vectors |= {name: most for name, most in (("LIMIT", one.limit), ("RATE", one.rate)) if np.isfinite(most).any()}
    if one.dead_zone.any():
        vectors |= {"DEAD_ZONE": one.dead_zone, "ONSET": one.onset}
    if one.bias.any():
        vectors["BIAS"] = one.bias
    return matrices, vectors


def _literals(values: Any, infinite: str) -> Any:
    """Numbers as text that is read back to the last digit."""
    if np.ndim(values):
        return [_literals(each, infinite) for each in values]
    return repr(float(values)) if np.isfinite(values) else infinite if values > 0 else f"-{infinite}"


def _equations(matrices: Collection[str], vectors: Collection[str]) -> list[str]:
    """The equations of one step, line by line."""
    lines = ["y = SCALE (reading - OFFSET)" if "SCALE" in vectors else "y = reading"]
    lines.append("w = C z + D y" if "C" in matrices else "w = D y")
    if "FORCE" in vectors:
        lines.append("w <- -ALLOCATION (FORCE sgn w outside the DEAD_BAND)")
    if "FRICTION" in vectors:
        lines.append("w <- w + FRICTION_GAIN (FRICTION tanh(speed / SMOOTHING)), speed = SPEED_Z z + SPEED_Y y")
    bounds = [text for name, text in (("LIMIT", "+-LIMIT"), ("RATE", "+-RATE of the previous v")) if name in vectors]
    lines.append(f"v = w within {' and '.join(bounds)}" if bounds else "v = w")
    command = "command = v"
    if "DEAD_ZONE" in vectors:
        command += " + DEAD_ZONE (v / ONSET within +-1)"
    lines.append(command + (" - BIAS" if "BIAS" in vectors else ""))
    if "A" in matrices:
        lines.append("z <- A z + B y" + (" + E v" if "E" in matrices else ""))
    return lines


def reading_words(domain: Domain, sensors: Sequence[Sensor], units: Units = SI) -> tuple[str, ...]:
    """What each reading is: sensor, quantity, place and unit."""
    return tuple(
        f"{s.name}: {s.quantity} at {domain.text(s.at, DIGITS)}, {units.named(QUANTITIES[s.quantity])}" for s in sensors
    )


def command_words(domain: Domain, actuators: Sequence[Actuator], units: Units = SI) -> tuple[str, ...]:
    """What each command is: actuator, kind, place and unit; with a gain, the force per unit of the command."""
    return tuple(
        f"{a.name}: {a.quantity} at {domain.text(a.at, DIGITS)}, {unit}"
        if a.gain == 1
        else f"{a.name}: command at {domain.text(a.at, DIGITS)}, {a.gain:.{DIGITS}g} {unit} per unit"
        for a, unit in ((a, units.named(force_unit(a))) for a in actuators)
    )


def _plain(text: str) -> str:
    """Text that is safe in a comment: a name in a case file must not end the comment."""
    line = "".join(sign if sign.isprintable() else " " for sign in text)
    return line.replace("\\", "/").replace("*/", "* /").replace('"', "'")
