"""The rig that `design`, `place` and `redesign` read, and the places in their options."""

from dataclasses import replace
from pathlib import Path

from workbench.rig.rig import Rig
from workbench.structure.domain import Between, Domain, Interval, NamedPoints, Patch, Place, PlaceError


def toml_of(path: Path) -> Path:
    """The TOML file of a rig: the path itself, or case.toml of a case folder."""
    return path / "case.toml" if path.is_dir() else path


def read_structure_rig(path: Path) -> Rig:
    """The rig of a TOML file or a case folder; an actuator at a node is moved to the point of its direction.

    Raises:
        ValueError: modal data without a table of points, whose shapes are known only at the inputs and outputs.
    """
    from workbench.cases.case import read_rig

    found = read_rig(toml_of(path))
    domain = found.modes.domain
    if isinstance(domain, NamedPoints) and domain.positions is None:
        raise ValueError(
            f'{path}: plain modal data have no shapes between points; name a file of points (points = "points.csv"), or'
            " describe a beam, a rod or a plate"
        )
    if isinstance(domain, NamedPoints):
        actuators = [
            replace(a, at=domain.slope(a.at, int(a.kind == "moment"), a.direction)[0][0], direction=None)
            if isinstance(a.at, str)
            else a
            for a in found.actuators
        ]
        return replace(found, actuators=tuple(actuators))
    return found


def typed_place(domain: Domain, text: str, option: str) -> Place:
    """The place of a text: a position in m along a beam, X,Y on a plate, or the name of a point.

    Raises:
        ValueError: another form; the message names the option.
    """
    if isinstance(domain, NamedPoints):
        return text.strip()
    form = "a position in m, such as 0.4" if isinstance(domain, Interval) else "X,Y in m, such as 0.4,0.25"
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != (1 if isinstance(domain, Interval) else 2):
        raise ValueError(f"{option} takes {form}; got {text!r}")
    return numbers[0] if len(numbers) == 1 else (numbers[0], numbers[1])


def place_in(domain: Domain, text: str, option: str) -> Place:
    """The place of a text, which must be on the structure.

    Raises:
        ValueError: another form, or a place outside the structure.
    """
    at = typed_place(domain, text, option)
    try:
        domain.locate(at)
    except PlaceError as error:
        raise ValueError(f"{option}: {error}") from None
    return at


def impulse_place(rig: Rig, at: str | None) -> Place:
    """The place of the impulse: as given, by place or by input, or that of the rig's hammer."""
    inputs = {a.name: a.at for a in rig.actuators if not isinstance(a.at, Between | Patch)}
    if at is not None and at.strip() in inputs:
        return inputs[at.strip()]
    if at is not None:
        try:
            return place_in(rig.modes.domain, at, "--impulse-at")
        except ValueError as error:
            raise ValueError(f"{error}; or name an input: {', '.join(inputs) or 'there is none'}") from None
    hammers = [inputs[a.name] for a in rig.actuators if a.direct and a.name in inputs]
    if not hammers:
        raise ValueError("the place of the impulse is missing: give --impulse-at, or an [[input]] of kind hammer")
    return hammers[0]
