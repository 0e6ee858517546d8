"""An effect: a change of rig, with parameters."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar
from weakref import WeakValueDictionary

import numpy as np

from workbench.rig.rig import Rig
from workbench.structure.domain import Between, Domain, NamedPoints, Rectangle, Where

ALL = "all"
COORDINATES = ("at", "x", "y")  # parameters that say where, along an interval or on a rectangle


@dataclass(frozen=True)
class Parameter:
    """One number of an effect.

    Attributes:
        name: as in the verdict.
        unit: as written beside it.
        low, high: bounds, in the unit.
        logarithmic: fitted as its logarithm; for what is positive by nature.
        scale: a typical size, which makes the steps of a fit comparable.
        prior_std: standard deviation of a normal prior on the free coordinate, centred at 0; None for none.
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


def place_parameters(rig: Rig) -> tuple[Parameter, ...]:
    """The coordinates of a place, as parameters: x along an interval, x and y on a rectangle, none at named points."""
    domain = rig.modes.domain
    lengths = {} if isinstance(domain, NamedPoints) else dict(zip(domain.coordinates, _lengths(domain), strict=True))
    return tuple(Parameter(name, "m", 0.0, length, scale=0.01 * length) for name, length in lengths.items())


def _lengths(domain: Domain) -> tuple[float, ...]:
    return domain.length if isinstance(domain, Rectangle) else (domain.size,)


def place_of(values: Mapping[str, Any]) -> Any:
    """The place among the values of an effect: x, (x, y), the name of a point, or `Between` two; None without one."""
    return (values["x"], values["y"]) if "x" in values else values.get("at")


def place_values(where: Where) -> dict[str, Any]:
    """A place as values of an effect."""
    if isinstance(where, tuple) and not isinstance(where, Between):
        return {"x": float(where[0]), "y": float(where[1])}
    return {"at": where}


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
        first: whether it changes the nominal model itself, before any other effect acts on it.
    """

    name: str
    path: str
    parameters: Callable[[Rig, Any], tuple[Parameter, ...]]
    apply: Callable[[Rig, Any, dict[str, Any]], Rig]
    starts: Callable[[Any, Any], Iterable[dict[str, Any]]]
    targets: Callable[[Rig], tuple] = lambda rig: (None,)
    nonlinear: bool = False
    phrase: str = ""
    first: bool = False
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
        values: by parameter name; at named points also "at", the name of the point or the two it acts between.
        deviations: standard deviations by parameter name, where it was fitted.
    """

    kind: Kind
    target: str | int | None
    values: dict[str, Any]
    deviations: dict[str, float] = field(default_factory=dict)

    def apply(self, rig: Rig) -> Rig:
        """The rig with the effect in it."""
        return self.kind.apply(rig, self.target, self.values)

    def parameters(self, rig: Rig) -> tuple[Parameter, ...]:
        return self.kind.parameters(rig, self.target)

    @property
    def at(self) -> Any:
        """Where it stands: x, (x, y), the name of a point, or `Between` two; None where it has no place."""
        return place_of(self.values)

    def moved_to(self, where: Where) -> "Effect":
        """The same effect elsewhere."""
        return replace(self, values={**self.values, **place_values(where)})

    @property
    def label(self) -> str:
        return f"{self.kind.name}[{self.target}]" if isinstance(self.target, str | int) else self.kind.name


def key_of(effects: Iterable[Effect]) -> tuple[str, ...]:
    """What tells a set of effects from another, numbers and order apart."""
    return tuple(sorted(effect.label for effect in effects))


def apply_all(rig: Rig, effects: Iterable[Effect]) -> Rig:
    """The rig with every effect in it, in order, errors of the nominal model before all others."""
    for effect in sorted(effects, key=lambda e: not e.kind.first):
        rig = effect.apply(rig)
    return rig
