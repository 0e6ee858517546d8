"""Laws at a point that the catalogue does not hold: springs and dampers of any power."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from workbench.arrays import Floats
from workbench.gap.effects.effect import (
    Effect,
    Evidence,
    Kind,
    Parameter,
    Scales,
    place_of,
    place_parameters,
    place_values,
)
from workbench.gap.effects.nonlinear import CUBIC_SPRING, QUADRATIC_DAMPER, with_element
from workbench.gap.effects.structural import GROUND_SPRING, POINT_DAMPER
from workbench.rig.elements import EvenSpring, PowerDamper, PowerSpring

EXPONENTS = (1.5, 2.0, 4.0, 6.0)  # to start from
SAME_POWER = 0.05  # nearer to that of a kind of the catalogue, an exponent differs by small errors, not by another law


def _of_power(v: Mapping[str, Any], motion: Floats) -> Floats:
    """-F |w / w_r|^p."""
    force, rms, exponent = float(v["force_at_rms"]), float(v["rms"]), float(v["exponent"])
    return -force * np.abs(motion / rms) ** exponent


def _power_law(element: type, name: str, motion: str, words: str, *, even: bool = False) -> Kind:
    def starts(evidence: Evidence, _: object) -> Iterator[dict[str, Any]]:
        for place in evidence.at_peaks:
            path = getattr(place, motion)
            rms = float(np.sqrt(np.mean(path**2)))
            for exponent in EXPONENTS if rms > 0 else ():
                basis = (1.0 if even else np.sign(path)) * np.abs(path / rms) ** exponent
                force = place.strength_along(basis)
                yield {**place_values(place.at), "force_at_rms": force, "exponent": exponent, "rms": rms}

    return Kind(
        name=name,
        path="structure",
        parameters=lambda rig, _: (
            *place_parameters(rig),
            Parameter("force_at_rms", "N", -1e15 * Scales.of(rig).force, 1e15 * Scales.of(rig).force),
            Parameter("exponent", "", 1.0, 9.0),
        ),
        apply=lambda rig, _, v: with_element(rig, element(place_of(v), v["force_at_rms"], v["rms"], v["exponent"])),
        starts=starts,
        nonlinear=True,
        phrase=words,
        force_laws={motion: lambda v, u: (1.0 if even else np.sign(u)) * _of_power(v, u)},
    )


POWER_SPRING = _power_law(PowerSpring, "power_spring", "displacement", "a power-law spring")
EVEN_SPRING = _power_law(EvenSpring, "even_spring", "displacement", "an even power-law spring, to one side,", even=True)
POWER_DAMPER = _power_law(PowerDamper, "power_damper", "velocity", "a power-law damper")
BEYOND = (POWER_SPRING, EVEN_SPRING, POWER_DAMPER)

OF_POWER = {
    (POWER_SPRING, 1): (GROUND_SPRING, "stiffness"),
    (POWER_SPRING, 3): (CUBIC_SPRING, "stiffness"),
    (POWER_DAMPER, 1): (POINT_DAMPER, "coefficient"),
    (POWER_DAMPER, 2): (QUADRATIC_DAMPER, "coefficient"),
}


def in_catalogue(law: Effect) -> Effect | None:
    """The effect of the catalogue that a law is, by its power; None where it is none of them."""
    v = law.values
    power = round(v["exponent"])
    if (law.kind, power) not in OF_POWER or abs(v["exponent"] - power) > SAME_POWER:
        return None
    kind, number = OF_POWER[law.kind, power]
    return Effect(kind, None, {**place_values(law.at), number: v["force_at_rms"] / v["rms"] ** power})


def any_beyond(effects: Iterable[Effect]) -> bool:
    """Whether one of the effects is a law that the catalogue does not hold."""
    return any(effect.kind in BEYOND for effect in effects)
