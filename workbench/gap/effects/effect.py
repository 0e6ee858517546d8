"""An effect: a change of rig, with parameters."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, ClassVar
from weakref import WeakValueDictionary

import numpy as np

from workbench.rig.rig import Rig

ALL = "all"


@dataclass(frozen=True)
class Parameter:
    """One number of an effect.

    Attributes:
        name: as in the verdict.
        unit: as written beside it.
        low, high: bounds, in the unit.
        logarithmic: fitted as its logarithm; for what is positive by nature.
        scale: a typical size, which makes the steps of a fit comparable.
        prior_std: where the value at the start is believed, how far its free coordinate may stray.
    """

    name: str
    unit: str
    low: float
    high: float
    logarithmic: bool = False
    scale: float = 1.0
    prior_std: float | None = None

    def to_free(self, value: float) -> float:
        """From the unit to the coordinate of the fit."""
        return float(np.log(value)) if self.logarithmic else value / self.scale

    def from_free(self, free: float) -> float:
        """From the coordinate of the fit to the unit, inside the bounds."""
        value = float(np.exp(min(free, 700.0))) if self.logarithmic else free * self.scale
        return min(max(value, self.low), self.high)

    def slope(self, value: float) -> float:
        """d value / d free."""
        return value if self.logarithmic else self.scale


@dataclass(frozen=True, eq=False)
class Kind:
    """A kind of effect in the catalogue.

    Attributes:
        name: as in the vocabulary.
        path: "actuator", "structure", "sensor" or "environment".
        parameters: rig, target -> the parameters there.
        apply: rig, target, values by name -> the changed rig.
        starts: evidence, target -> values to start a fit from (dicts by parameter name).
        targets: rig -> what it can act on: input or output names, "all", an end; (None,) where there is no choice.
        nonlinear: whether it makes the response depend on level.
        phrase: how the sentence of the verdict calls it.
        last: whether it acts on the modes that all other effects have made.
    """

    name: str
    path: str
    parameters: Callable[[Rig, Any], tuple[Parameter, ...]]
    apply: Callable[[Rig, Any, dict[str, float]], Rig]
    starts: Callable[[Any, Any], Iterable[dict[str, float]]]
    targets: Callable[[Rig], tuple] = lambda rig: (None,)
    nonlinear: bool = False
    phrase: str = ""
    last: bool = False
    known: ClassVar[WeakValueDictionary[int, "Kind"]] = WeakValueDictionary()  # by identity: none is equal to another

    def __post_init__(self) -> None:
        Kind.known[id(self)] = self

    @property
    def words(self) -> str:
        return self.phrase or self.name.replace("_", " ")


@dataclass(frozen=True, eq=False)
class Effect:
    """An effect with its numbers.

    Attributes:
        kind: of the catalogue.
        target: input, output, "all", an end, or None.
        values: by parameter name.
        deviations: standard deviations by parameter name, where it was fitted.
    """

    kind: Kind
    target: str | int | None
    values: dict[str, float]
    deviations: dict[str, float] = field(default_factory=dict)

    def apply(self, rig: Rig) -> Rig:
        """The rig with the effect in it."""
        return self.kind.apply(rig, self.target, self.values)

    def parameters(self, rig: Rig) -> tuple[Parameter, ...]:
        return self.kind.parameters(rig, self.target)

    @property
    def label(self) -> str:
        return self.kind.name if self.target is None else f"{self.kind.name}[{self.target}]"


def key_of(effects: Iterable[Effect]) -> tuple[str, ...]:
    """What tells a set of effects from another, numbers and order apart."""
    return tuple(sorted(effect.label for effect in effects))


def apply_all(rig: Rig, effects: Iterable[Effect]) -> Rig:
    """The rig with every effect in it, in order, those that come last at the end."""
    for effect in sorted(effects, key=lambda e: e.kind.last):
        rig = effect.apply(rig)
    return rig
