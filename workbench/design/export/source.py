"""A controller as C or Python source, from templates: one function that is called once per sample."""

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from jinja2 import Environment, StrictUndefined

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
    controller: DigitalController,
    language: str,
    name: str,
    *,
    readings: Sequence[str] = (),
    commands: Sequence[str] = (),
) -> dict[str, str]:
    """The source of a controller, {file name: text}.

    Args:
        controller: to write.
        language: "c" or "python".
        name: of the files and, in C, of the functions.
        readings, commands: what each is, in words; by default the names.
    """
    infinite = "INFINITY" if language == "c" else "inf"
    given = _Numbers(controller, infinite)
    words = {
        "name": name,
        "title": fill(f"{_plain(controller.name)}, at {1 / controller.sample_time:.6g} Hz", WIDTH),
        "period": f"{controller.sample_time:.10g}",
        "rate": f"{1 / controller.sample_time:.6g}",
        "equations": "\n".join(_equations(given)),
        "signals": "\n".join(
            [
                *_listed("reading", readings or controller.sensors),
                *_listed("command", commands or controller.actuators),
                *_listed("z", controller.states or ["state of the controller"] * given.sizes["n_states"]),
            ]
        ),
        "matrices": given.matrices,
        "vectors": given.vectors,
        "uses_math": bool(given.vectors.keys() - {"SCALE", "OFFSET", "BIAS"}),
        **given.sizes,
    }
    environment = Environment(undefined=StrictUndefined, keep_trailing_newline=True)
    texts = {end: (HERE / f"step.{end}.jinja").read_text(encoding="utf-8") for end in TEMPLATES[language]}
    return {f"{name}.{end}": environment.from_string(text).render(words) for end, text in texts.items()}


class _Numbers:
    """The matrices and vectors of a controller as text; those without effect are left out."""

    def __init__(self, controller: DigitalController, infinite: str) -> None:
        def text(value: Any) -> Any:
            if np.ndim(value):
                return [text(each) for each in value]
            return repr(float(value)) if np.isfinite(value) else infinite if value > 0 else f"-{infinite}"

        one, relays, friction = controller, controller.relays, controller.friction
        n_states = one.a.shape[0]
        self.sizes = {"n_states": n_states, "n_readings": len(one.sensors), "n_outputs": one.d.shape[0]}
        self.sizes["n_commands"] = len(one.actuators)
        self.matrices: dict[str, Any] = {"D": text(one.d)}
        self.vectors: dict[str, Any] = {}
        if n_states:
            self.matrices |= {"A": text(one.a), "B": text(one.b), "C": text(one.c)}
            if one.e.any():
                self.matrices["E"] = text(one.e)
        if one.offset.any() or (one.scale != 1).any():
            self.vectors |= {"SCALE": text(one.scale), "OFFSET": text(one.offset)}
        if relays is not None:
            self.matrices["SPREAD"] = text(relays.spread)
            self.vectors |= {"FORCE": text(relays.force), "DEAD_BAND": text(relays.dead_band)}
        if friction is not None:
            self.matrices |= {"PUSH": text(friction.push), "SPEED_Y": text(friction.of_reading)}
            if n_states:
                self.matrices["SPEED_Z"] = text(friction.of_state)
            self.vectors |= {"FRICTION": text(friction.force), "SMOOTHING": text(friction.smoothing)}
        for name, values in (("LIMIT", one.limit), ("RATE", one.rate)):
            if np.isfinite(values).any():
                self.vectors[name] = text(values)
        if one.dead_zone.any():
            self.vectors |= {"DEAD_ZONE": text(one.dead_zone), "ONSET": text(one.onset)}
        if one.bias.any():
            self.vectors["BIAS"] = text(one.bias)


def _equations(given: _Numbers) -> list[str]:
    """The equations of one step, line by line."""
    there, states = given.vectors, "z" if given.sizes["n_states"] else ""
    lines = ["y = SCALE (reading - OFFSET)" if "SCALE" in there else "y = reading"]
    lines.append("w = C z + D y" if states else "w = D y")
    if "FORCE" in there:
        lines.append("w <- -SPREAD (FORCE sgn w outside the DEAD_BAND)")
    if "FRICTION" in there:
        lines.append("w <- w + PUSH (FRICTION tanh(speed / SMOOTHING)), speed = SPEED_Z z + SPEED_Y y")
    if "LIMIT" in there or "RATE" in there:
        bounds = [text for name, text in (("LIMIT", "+-LIMIT"), ("RATE", "+-RATE of the previous v")) if name in there]
        lines.append(f"v = w within {' and '.join(bounds)}")
    else:
        lines.append("v = w")
    command = "command = v"
    if "DEAD_ZONE" in there:
        command += " + DEAD_ZONE (v / ONSET within +-1)"
    lines.append(command + (" - BIAS" if "BIAS" in there else ""))
    if states:
        lines.append("z <- A z + B y" + (" + E v" if "E" in given.matrices else ""))
    return lines


def reading_words(domain: Domain, sensors: Sequence[Sensor], units: Units = SI) -> tuple[str, ...]:
    """What each reading is: sensor, quantity, place and unit."""
    return tuple(
        f"{s.name}: {s.quantity} at {domain.text(s.at, DIGITS)}, {units.named(QUANTITIES[s.quantity])}" for s in sensors
    )


def command_words(domain: Domain, actuators: Sequence[Actuator], units: Units = SI) -> tuple[str, ...]:
    """What each command is: actuator, kind, place and unit; with a gain, the force per unit of the command."""
    return tuple(
        f"{a.name}: {a.kind} at {domain.text(a.at, DIGITS)}, {unit}"
        if a.gain == 1
        else f"{a.name}: command at {domain.text(a.at, DIGITS)}, {a.gain:.{DIGITS}g} {unit} per unit"
        for a, unit in ((a, units.named(force_unit(a))) for a in actuators)
    )


def _listed(array: str, words: Sequence[str]) -> list[str]:
    return [f"{array}[{i}]  {_plain(text)}" for i, text in enumerate(words)]


def _plain(text: str) -> str:
    """Text that is safe in a comment: a name in a case file must not end the comment."""
    line = "".join(sign if sign.isprintable() else " " for sign in text)
    return line.replace("\\", "/").replace("*/", "* /").replace('"', "'")
