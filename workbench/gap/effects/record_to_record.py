"""A figure of the structure that differs from record to record: stiffness, temperature by way of it, or axial load."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from workbench.gap.effects.effect import Kind
from workbench.gap.effects.structural import AXIAL_LOAD, MODULUS_ERROR, buckling_load
from workbench.rig.rig import Rig
from workbench.structure.member import Beam

STIFFNESS, TENSION = "stiffness", "axial load"  # the first stands for all that warmth does to a modulus too


@dataclass(frozen=True)
class OfOneRecord:
    """What a figure is in one record, as a change of rig.

    Attributes:
        kind: of the catalogue, with no target and one number.
        name, value: of that number.
    """

    kind: Kind
    name: str
    value: float

    def __call__(self, rig: Rig) -> Rig:
        return self.kind.apply(rig, None, {self.name: self.value})


def figures_of(rig: Rig) -> tuple[str, ...]:
    """Figures of a rig that may differ from record to record."""
    if not rig.modes.omega.any():
        return ()
    return (STIFFNESS, TENSION) if isinstance(rig.structure, Beam) else (STIFFNESS,)


def differing(rig: Rig, figure: str, deviations: Mapping[str, float]) -> Rig:
    """The rig with a figure that differs from record to record.

    Args:
        figure: of `figures_of`.
        deviations: by name of record: of all stiffness, relative; of the axial load, over that which buckles the beam.
    """

    def change(deviation: float) -> OfOneRecord:
        if figure == TENSION:
            return OfOneRecord(AXIAL_LOAD, "tension", deviation * buckling_load(rig))
        return OfOneRecord(MODULUS_ERROR, "factor", 1.0 + deviation)

    changes = tuple((name, change(deviation)) for name, deviation in deviations.items() if deviation)
    return replace(rig, by_record=changes) if changes else rig


def label_of(figure: str) -> str:
    """What a budget calls a figure that differs from record to record."""
    return f"{figure.replace(' ', '_')}_record_to_record"
