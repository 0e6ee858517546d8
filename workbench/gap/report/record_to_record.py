"""A figure that differs from record to record: by how much, in words, and in records that no fit has seen."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.effects.nominal import deviations_of, parted
from workbench.gap.effects.record_to_record import TENSION, label_of
from workbench.gap.effects.structural import buckling_load
from workbench.gap.report.budget import mean_square
from workbench.records.record import Record
from workbench.rig.rig import Rig

REACH = 4.0  # standard deviations from record to record: no unseen record is farther from the common value
SURELY = 1e-3  # of that reach: how exactly a record's own deviation is found


@dataclass(frozen=True, eq=False)
class RecordToRecord:
    """A figure of the nominal model that differs from record to record, as it was fitted.

    Attributes:
        figure: "stiffness" or "axial load".
        values: by name of record, what it is there less the common value: relative, or a force.
        force: name of its unit.
    """

    figure: str
    values: dict[str, float]
    force: str = "N"

    @classmethod
    def of(cls, rig: Rig, effects: Sequence[Effect]) -> "RecordToRecord | None":
        """Of effects that were fitted to records of a nominal rig; None where nothing differs between records."""
        between = next((found for found in (parted(e)[1] for e in effects) if found is not None), None)
        if between is None:
            return None
        figure = between.target.figure
        unit = buckling_load(rig) if figure == TENSION else 1.0
        return cls(figure, {name: unit * value for name, value in deviations_of(between.values).items()})

    @property
    def label(self) -> str:
        """As in the budget."""
        return label_of(self.figure)

    @property
    def spread(self) -> float:
        """Standard deviation from record to record."""
        return float(np.std(list(self.values.values()), ddof=1))

    @property
    def words(self) -> str:
        """Such as: 0.8 %: record low is 1.1 % stiffer than record high."""
        less, more = (pick(self.values, key=lambda name: self.values[name]) for pick in (min, max))
        apart = self._written(self.values[more] - self.values[less])
        how = f"has {apart} more than" if self.figure == TENSION else f"is {apart} stiffer than"
        return f"{self._written(self.spread)}: record {more} {how} record {less}"

    def _written(self, size: float) -> str:
        return f"{size:.2g} {self.force}" if self.figure == TENSION else f"{100.0 * size:.2g} %"

    def to_json(self) -> dict[str, Any]:
        """Plain numbers: relative, or N."""
        by_record = {name: float(f"{value:.4g}") for name, value in self.values.items()}
        return {"figure": self.figure, "std": float(f"{self.spread:.4g}"), "by_record": by_record}


def with_held_out(
    rig: Rig, effects: Sequence[Effect], records: Sequence[Record], *, settle: float = 0.0
) -> tuple[Effect, ...]:
    """The effects, and what a figure that differs from record to record deviates by in records that no fit has seen.

    It is that which leaves least of them, within what it differs by between the records fitted: an account of what is
    left of them, not a prediction. The effects as they are where nothing differs.
    """
    errors = next((e for e in effects if parted(e)[1] is not None), None)
    if errors is None:
        return tuple(effects)
    others = [e for e in effects if e is not errors]
    reach = REACH * errors.target.record
    values = dict(errors.values)
    for record in records:
        name = f"record_{record.name}"
        if name in values:
            continue

        def left(deviation: float, record: Record = record, name: str = name) -> float:
            own = replace(errors, values={**errors.values, name: deviation})
            return mean_square(apply_all(rig, (*others, own)), record, settle)

        found = minimize_scalar(left, bounds=(-reach, reach), method="bounded", options={"xatol": SURELY * reach})
        values[name] = float(found.x)
    return (*others, replace(errors, values=values))
