"""An effect: a change of rig, with parameters; their bounds and starts are relative to the rig's own scales."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import combinations, permutations
from typing import Any, ClassVar, Literal, Protocol
from weakref import WeakValueDictionary

import numpy as np

from workbench.arrays import Floats
from workbench.records.record import Record
from workbench.renamed import Renamed, former_arguments
from workbench.rig.rig import Rig
from workbench.rig.simulate import Motion
from workbench.structure.domain import Between, Domain, NamedPoints, Rectangle, Where
from workbench.structure.member import Structure
from workbench.structure.modes import Modes

ALL = "all"
WEAKER, WEAKENINGS = 0.9, 40  # share of the strength of effects that a rig cannot have, and how often it is taken
COORDINATES = ("at", "x", "y")  # parameters that say where, along an interval or on a rectangle


@dataclass(frozen=True)
class Scales:
    """Length (m), mass (kg) and time (s) of a rig: its extent, its mass, and 1 / ω of its lowest elastic mode.

    Points whose positions are not known have an extent of 1; modes that are all rigid have the time of their damping.
    """

    length: float
    mass: float
    time: float

    @classmethod
    def of(cls, rig: Rig) -> "Scales":
        return _scales(rig.modes, rig.structure)

    @property
    def stiffness(self) -> float:
        """N/m."""
        return self.mass / self.time**2

    @property
    def damping(self) -> float:
        """N s/m."""
        return self.mass / self.time

    @property
    def speed(self) -> float:
        """m/s."""
        return self.length / self.time

    @property
    def force(self) -> float:
        """N."""
        return self.stiffness * self.length


@lru_cache(maxsize=64)
def _scales(modes: Modes, structure: object) -> Scales:
    elastic = modes.omega[modes.omega > 0]
    rate = float(elastic.min()) if elastic.size else float(np.diag(modes.damping).max())
    domain = modes.domain
    placed = not isinstance(domain, NamedPoints) or domain.positions is not None
    return Scales((domain.size if placed else 0.0) or 1.0, _mass(modes, structure), 1.0 / (rate or 1.0))


def _mass(modes: Modes, structure: object) -> float:
    if isinstance(structure, Structure):
        x = (np.arange(50) + 0.5) / 50 * structure.length
        return float(np.mean(structure.mass_per_length(x)) * structure.length)
    elastic = int(np.argmax(modes.omega > 0))
    return 1.0 / float(np.mean(modes.phi(modes.domain.grid(12))[:, elastic] ** 2))


@dataclass(frozen=True)
class Parameter:
    """One number of an effect.

    Attributes:
        name: as in the verdict.
        unit: as written beside it.
        low, high: bounds, in the unit.
        logarithmic: fitted as its logarithm; with a negative lower bound as asinh(value / scale), which is the
            logarithm of its size on either side of zero.
        scale: a typical size, which makes the steps of a fit comparable.
        neutral: the value at which the effect changes nothing; None where no single one does.
        prior_std: standard deviation of a normal prior on the free coordinate, centred at 0; None for none.
        sensor: the one whose readings alone it alters, by name; empty where it alters others, or the motion.
    """

    name: str
    unit: str
    low: float
    high: float
    logarithmic: bool = False
    scale: float = 1.0
    prior_std: float | None = None
    neutral: float | None = None
    sensor: str = ""

    def to_free(self, value: float) -> float:
        """From the unit to the coordinate of the fit."""
        if self.logarithmic:
            # an effect may start from nothing, whose logarithm is no number
            return float(np.arcsinh(value / self.scale) if self.low < 0 else np.log(max(value, self.low)))
        return value / self.scale

    def from_free(self, free: float) -> float:
        """From the coordinate of the fit to the unit, inside the bounds."""
        if not self.logarithmic:
            value = free * self.scale
        elif self.low < 0:
            value = self.scale * float(np.sinh(np.clip(free, -700.0, 700.0)))
        else:
            value = float(np.exp(min(free, 700.0)))
        return min(max(value, self.low), self.high)

    def slope(self, value: float) -> float:
        """d value / d free."""
        if not self.logarithmic:
            return self.scale
        return float(np.hypot(value, self.scale)) if self.low < 0 else value


def positive(
    name: str, unit: str, size: float, low: float = 1e-12, high: float = 1e12, neutral: float | None = None
) -> Parameter:
    """A parameter above zero, fitted as its logarithm, within `low` and `high` times a size that the rig has itself."""
    return Parameter(name, unit, low * size, high * size, logarithmic=True, neutral=neutral)


def place_parameters(rig: Rig) -> tuple[Parameter, ...]:
    """The coordinates of a place, as parameters: x along an interval, x and y on a rectangle, none at named points."""
    domain = rig.modes.domain
    if isinstance(domain, NamedPoints):
        return ()
    lengths = domain.length if isinstance(domain, Rectangle) else (domain.size,)
    named = zip(domain.coordinates, lengths, strict=True)
    return tuple(Parameter(name, "m", 0.0, length, scale=0.01 * length) for name, length in named)


def place_of(values: Mapping[str, Any]) -> Any:
    """The place among the values of an effect: x, (x, y), the name of a point, or `Between` two; None without one."""
    return (values["x"], values["y"]) if "x" in values else values.get("at")


def place_values(where: Where) -> dict[str, Any]:
    """A place as values of an effect."""
    if isinstance(where, tuple) and not isinstance(where, Between):
        return {"x": float(where[0]), "y": float(where[1])}
    return {"at": where}


@dataclass(frozen=True, eq=False)
class ForceAndMotion:
    """The unmodelled force at a point and the motion there, one row per record joined end to end.

    Attributes:
        at: on the structure.
        force: (n_total,) N.
        displacement, velocity, acceleration: (n_total,) there, of the real structure as far as the records tell.
        bent: whether errors of the model may have taken linear parts of the force.
    """

    at: Where
    force: Floats
    displacement: Floats
    velocity: Floats
    acceleration: Floats
    absorbed: bool = False

    def strength_along(self, basis: Floats) -> float:
        """The k for which -k basis (n_total,) is nearest to the force, beside any linear force where that is bent."""
        force = self.force
        if self.absorbed:
            force, basis = (each - self._linear @ (self._linear.T @ each) for each in (force, basis))
        return float(-np.dot(force, basis) / max(np.dot(basis, basis), 1e-300))

    @cached_property
    def _linear(self) -> Floats:
        """Orthonormal columns (n_total, 3) that span what errors of stiffness, damping and mass do here."""
        motion = np.column_stack([self.displacement, self.velocity, self.acceleration])
        return np.asarray(np.linalg.qr(motion)[0])


class Measured(Protocol):
    """The fit records, whole and without the samples at their start that are not counted."""

    @property
    def records(self) -> tuple[Record, ...]: ...
    @property
    def counted(self) -> tuple[Record, ...]: ...


class Evidence(Protocol):
    """What a kind of effect may look at to say where a fit starts: rig, records, motion and residuals.

    `workbench.gap.localisation.evidence` computes it all.
    """

    @property
    def rig(self) -> Rig: ...
    @property
    def data(self) -> Measured: ...
    @property
    def motions(self) -> tuple[Motion, ...]: ...
    @property
    def residuals(self) -> tuple[Floats, ...]: ...
    @property
    def domain(self) -> Domain: ...
    @property
    def at_peaks(self) -> Sequence[ForceAndMotion]: ...
    @property
    def places_to_try(self) -> Sequence[Any]: ...


@dataclass(frozen=True, eq=False)
class Kind:
    """A kind of effect in the catalogue: all that a diagnosis knows of it, from where to start a fit to how to draw it.

    Attributes:
        name: as in the vocabulary.
        path: "actuator", "structure", "sensor" or "environment".
        parameters: rig, target -> the parameters there.
        apply: rig, target, values by name -> the changed rig.
        starts: evidence, target -> values to start a fit from (dicts by parameter name).
        targets: rig -> what it can act on: input or output names, "all", an end; (None,) where there is no choice.
        nonlinear: whether it makes the response depend on level.
        phrase: how the sentence of the verdict calls it.
        phrase_between: effect -> how the sentence calls one between two points; None for the same.
        simpler: effect, rig -> its limiting cases at bounds of its parameters, with values to start a fit from.
        more_general: effect -> what it is a limiting case of and records can mistake for it, with values to start a
            fit from.
        merged: effect, another -> the one effect that both together may be, with values to start a fit from; or None.
        signed: whether the change is linear in its one number, which may be of either sign; one start is then enough.
        found_in: "search", where its starts are tried; "readings", where it shows in them as they are; "residual",
            where only its statistics can be found.
        exclusive: whether one rules out another of the kind, whatever its target.
        unpredictable: the part of the response that no model can predict, in a sentence; empty where there is none.
        force_laws: "displacement" or "velocity" -> values, that motion (n,) -> force (n,), where it is a law of that
            alone.
        numbers: effect, rig -> the numbers that a verdict states, by name; None for its values, a place left out.
        without_negligible: effect -> the same less parameters so near zero that records may not show them; itself where
            it has none.
        second_channel, conjunction: of a kind that acts on two inputs or two outputs: what the verdict calls the other,
            and the word between the two in its sentence.
        remark: effect, rig -> what the sentence says in brackets; None for its numbers.
        fixed_place: effect, rig -> its place where no parameter holds it, and what the sentence calls it.
        applied_first: whether it changes the nominal model itself, before any other effect acts on it.
        adds_modes: whether it adds modes to the model, before errors of that: these may leave no structure to solve.
        applied_last: whether it acts on modes as all other effects have made them: where modes keep their damping
            ratios, a damper there before a mass would be of another strength.
    """

    name: str
    path: str
    parameters: Callable[[Rig, Any], tuple[Parameter, ...]]
    apply: Callable[[Rig, Any, dict[str, Any]], Rig]
    starts: Callable[[Evidence, Any], Iterable[dict[str, Any]]]
    targets: Callable[[Rig], tuple[Any, ...]] = lambda rig: (None,)
    nonlinear: bool = False
    phrase: str = ""
    phrase_between: "Callable[[Effect], str] | None" = None
    simpler: Callable[["Effect", Rig], Iterable["Effect"]] = lambda effect, rig: ()
    more_general: Callable[["Effect"], Iterable["Effect"]] = lambda effect: ()
    merged: "Callable[[Effect, Effect], Effect | None]" = lambda effect, other: None
    signed: bool = False
    found_in: Literal["search", "readings", "residual"] = "search"
    exclusive: bool = False
    unpredictable: str = ""
    force_laws: Mapping[str, Callable[[Mapping[str, Any], np.ndarray], np.ndarray]] = field(default_factory=dict)
    numbers: Callable[["Effect", Rig], dict[str, float]] | None = None
    without_negligible: Callable[["Effect"], "Effect"] = lambda effect: effect
    remark: Callable[["Effect", Rig], str] | None = None
    fixed_place: Callable[["Effect", Rig], tuple[float, str]] | None = None
    second_channel: str = "with"
    conjunction: str = " and "
    applied_first: bool = False
    adds_modes: bool = False
    applied_last: bool = False
    wider, alone, remainder = Renamed("more_general"), Renamed("exclusive"), Renamed("unpredictable")
    settled, stands = Renamed("without_negligible"), Renamed("fixed_place")
    first, last, joined = Renamed("applied_first"), Renamed("applied_last"), Renamed("conjunction")
    known: ClassVar[WeakValueDictionary[int, "Kind"]] = WeakValueDictionary()  # by identity: none is equal to another

    def __post_init__(self) -> None:
        Kind.known[id(self)] = self

    @property
    def words(self) -> str:
        return self.phrase or self.name.replace("_", " ")


Kind.__init__ = former_arguments(  # type: ignore[method-assign]
    wider="more_general",
    alone="exclusive",
    remainder="unpredictable",
    settled="without_negligible",
    stands="fixed_place",
    first="applied_first",
    last="applied_last",
    joined="conjunction",
)(Kind.__init__)


@dataclass(frozen=True, eq=False)
class Effect:
    """An effect with its numbers.

    Attributes:
        kind: of the catalogue.
        target: input, output, two of them, "all", an end, or None.
        values: by parameter name; at named points also "at", the name of the point or the two it acts between.
        deviations: standard deviations by parameter name, where it was fitted.
    """

    kind: Kind
    target: Any
    values: dict[str, Any]
    deviations: dict[str, float] = field(default_factory=dict)

    def apply(self, rig: Rig) -> Rig:
        """The rig with the effect in it."""
        return self.kind.apply(rig, self.target, self.values)

    def parameters(self, rig: Rig) -> tuple[Parameter, ...]:
        return self.kind.parameters(rig, self.target)

    @property
    def numbers(self) -> dict[str, Any]:
        """Its values, the place left out."""
        return {name: value for name, value in self.values.items() if name not in COORDINATES}

    def stands_out(self, rig: Rig) -> bool:
        """Whether any number is farther from where it changes nothing than its standard deviation.

        True of an effect without such numbers, and of errors of the nominal model.
        """
        tested = [p for p in self.parameters(rig) if p.neutral is not None and self.deviations.get(p.name, 0.0) > 0]
        off = any(abs(self.values[p.name] - p.neutral) > self.deviations[p.name] for p in tested)
        return off or not tested or self.kind.applied_first

    def is_sure(self, rig: Rig) -> bool:
        """Whether every number that a verdict states, but its place, is farther from nothing than its deviation."""
        nothing = {p.name: p.neutral or 0.0 for p in self.parameters(rig) if p.name not in COORDINATES}
        stated = [(name, value) for name, value in self.stated(rig).items() if name in nothing]
        return all(not abs(value - nothing[name]) < self.deviations.get(name, 0.0) for name, value in stated)

    def stated(self, rig: Rig) -> dict[str, Any]:
        """The numbers that a verdict states, by name."""
        return self.numbers if self.kind.numbers is None else self.kind.numbers(self, rig)

    @property
    def at(self) -> Any:
        """Where it stands: x, (x, y), the name of a point, or `Between` two; None where it has no place."""
        return place_of(self.values)

    def moved_to(self, where: Where) -> "Effect":
        """The same effect elsewhere."""
        return replace(self, values={**self.values, **place_values(where)})

    @property
    def words(self) -> str:
        """How a sentence calls it."""
        between = self.kind.phrase_between
        return between(self) if between is not None and isinstance(self.at, Between) else self.kind.words

    @property
    def label(self) -> str:
        names = ", ".join(self.target) if type(self.target) is tuple else self.target
        return f"{self.kind.name}[{names}]" if isinstance(names, str | int) else self.kind.name


def names_in(target: Any) -> tuple[str, ...]:
    """Inputs, outputs or the end that the target of an effect names; empty where it names none."""
    return tuple(name for name in (target if isinstance(target, tuple) else (target,)) if isinstance(name, str))


# of kinds whose name in words is not their identifier with spaces for underscores
SPELLINGS = (
    ("bouc wen", "Bouc-Wen"),
    ("coulomb", "Coulomb"),
    ("two way friction", "direction-dependent friction"),
    ("one sided", "one-sided"),
)


def label_in_words(label: str) -> str:
    """A label as a figure or a note shows it: actuator gain (F2), Bouc-Wen."""
    words = label.replace("[", " (").replace("]", ")").replace("_", " ")
    for plain, spelt in SPELLINGS:
        words = words.replace(plain, spelt)
    return words


def key_of(effects: Iterable[Effect]) -> tuple[str, ...]:
    """What distinguishes a set of effects from another, but for numbers and order."""
    return tuple(sorted(effect.label for effect in effects))


def apply_all(rig: Rig, effects: Iterable[Effect]) -> Rig:
    """The rig with every effect in it, in order: modes left out, errors of the nominal model, all others, dampers."""
    for effect in sorted(effects, key=lambda e: (e.kind.applied_last, not e.kind.adds_modes, not e.kind.applied_first)):
        rig = effect.apply(rig)
    return rig


def can_be(rig: Rig, effects: Iterable[Effect]) -> bool:
    """Whether a rig can have these effects: one that buckles, or a stretch that leaves the structure, cannot be."""
    try:
        apply_all(rig, effects)
    except (ValueError, np.linalg.LinAlgError):
        return False
    return True


def nearest_possible(rig: Rig, effects: Sequence[Effect], beside: Sequence[Effect] = ()) -> tuple[Effect, ...]:
    """The effects, weaker until a rig can have them beside others: what a stiffer beam bears may buckle this one.

    As they are where no weaker ones can be either.
    """
    for share in WEAKER ** np.arange(WEAKENINGS):
        weaker = tuple(_weakened(effect, rig, float(share)) for effect in effects)
        if can_be(rig, (*weaker, *beside)):
            return weaker
    return tuple(effects)


def _weakened(effect: Effect, rig: Rig, share: float) -> Effect:
    """The effect with a share of what its numbers are off from where they change nothing."""
    numbers = {p.name: p.neutral for p in effect.parameters(rig) if p.neutral is not None}
    moved = {name: none + share * (effect.values[name] - none) for name, none in numbers.items()}
    return replace(effect, values={**effect.values, **moved})


def simpler_forms(effect: Effect, rig: Rig) -> tuple[Effect, ...]:
    """Effects that this one turns into at a bound of its parameters, with values to start a fit from."""
    return tuple(effect.kind.simpler(effect, rig))


def fewer(effects: Sequence[Effect]) -> Iterator[tuple[Effect, ...]]:
    """The set with two effects of one kind made one, with values to start a fit from: two springs may stand for one."""
    for one, other in combinations(effects, 2):
        if one.kind is other.kind and one.target == other.target and one.at is not None:
            rest = [effect for effect in effects if effect is not one and effect is not other]
            yield (*rest, one)
            yield (*rest, one.moved_to(other.at))
            names = [name for name in COORDINATES if isinstance(one.values.get(name), float)]
            if names:
                middle = {name: 0.5 * (one.values[name] + other.values[name]) for name in names}
                yield (*rest, replace(one, values={**one.values, **middle}))


def with_one_simpler(effects: Sequence[Effect], rig: Rig) -> Iterator[tuple[Effect, ...]]:
    """The set with one of its effects as what it turns into at a bound."""
    for i, effect in enumerate(effects):
        for simpler in simpler_forms(effect, rig):
            yield (*effects[:i], simpler, *effects[i + 1 :])


def each_left_out(effects: Sequence[Effect]) -> Iterator[tuple[Effect, ...]]:
    """The set without each of its effects in turn."""
    for effect in effects:
        yield tuple(other for other in effects if other is not effect)


def more_general_sets(effects: Sequence[Effect]) -> Iterator[tuple[Effect, ...]]:
    """The sets with one effect as what it is a limiting case of."""
    for i, effect in enumerate(effects):
        for more_general in effect.kind.more_general(effect):
            yield (*effects[:i], more_general, *effects[i + 1 :])


def merged_sets(effects: Sequence[Effect]) -> Iterator[tuple[Effect, ...]]:
    """The sets with two effects of different kinds as the one that both together may be."""
    for one, other in permutations(effects, 2):
        merged = one.kind.merged(one, other)
        if merged is not None:
            yield (*(effect for effect in effects if effect is not one and effect is not other), merged)


def simpler_sets(effects: Sequence[Effect], rig: Rig) -> Iterator[tuple[Effect, ...]]:
    """The sets that this one comes to at a bound of one effect, or with two as one."""
    yield from fewer(effects)
    yield from with_one_simpler(effects, rig)


def contained(effects: Sequence[Effect], rig: Rig) -> set[tuple[str, ...]]:
    """The keys of all sets that this one comes to at bounds of its parameters."""
    found: set[tuple[str, ...]] = set()
    for simpler in simpler_sets(effects, rig):
        if key_of(simpler) not in found:
            found |= {key_of(simpler)} | contained(simpler, rig)
    return found
