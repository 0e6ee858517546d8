"""Effects: parametrised changes of a rig, with bounds and start values relative to the rig's own scales."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import combinations, permutations
from typing import Any, ClassVar, Literal, Protocol
from weakref import WeakValueDictionary

import numpy as np

from workbench.arrays import Floats
from workbench.records.record import Record
from workbench.renamed import former_fields
from workbench.rig.motion import Motion
from workbench.rig.rig import Rig
from workbench.structure.domain import Between, Domain, Location, NamedPoints, Rectangle
from workbench.structure.member import Structure
from workbench.structure.modes import Modes

ALL = "all"
WEAKER, WEAKENINGS = 0.9, 40  # factor on the strength of physically impossible effects, and how often it is applied
COORDINATES = ("at", "x", "y")  # parameters of a place, along an interval or on a rectangle


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
    """One parameter of an effect.

    Attributes:
        name: as in the verdict.
        unit: as written beside it.
        low, high: bounds, in the unit.
        logarithmic: fitted as its logarithm; with a negative lower bound as asinh(value / scale), the signed logarithm.
        scale: a typical size, which makes the steps of a fit comparable.
        neutral: the value at which the effect changes nothing; None if there is no such value.
        prior_std: standard deviation of a normal prior on the free coordinate, centred at 0; None for no prior.
        sensor: name of the only sensor whose readings it alters; empty if it alters others, or the motion.
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
            # an effect may start from zero, which has no logarithm
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


Parameters = Callable[[Rig, Any], tuple[Parameter, ...]]


def positive(
    name: str, unit: str, size: float, low: float = 1e-12, high: float = 1e12, neutral: float | None = None
) -> Parameter:
    """A positive parameter, fitted as its logarithm, between `low` and `high` times a typical size of the rig."""
    return Parameter(name, unit, low * size, high * size, logarithmic=True, neutral=neutral)


def place_parameters(rig: Rig) -> tuple[Parameter, ...]:
    """The coordinates of a place, as parameters: x along an interval, x and y on a rectangle, none at named points."""
    domain = rig.modes.domain
    if isinstance(domain, NamedPoints):
        return ()
    lengths = domain.length if isinstance(domain, Rectangle) else (domain.size,)
    named = zip(domain.coordinates, lengths, strict=True)
    return tuple(Parameter(name, "m", 0.0, length, scale=0.01 * length) for name, length in named)


def at_a_place(*of_scales: Callable[[Scales], Parameter]) -> Parameters:
    """The coordinates of a place, and further parameters from the scales of a rig."""
    return lambda rig, _: (*place_parameters(rig), *(parameter(Scales.of(rig)) for parameter in of_scales))


def place_of(values: Mapping[str, Any]) -> Any:
    """The place among the values of an effect: x, (x, y), the name of a point, or `Between` two; None without one."""
    return (values["x"], values["y"]) if "x" in values else values.get("at")


def place_values(where: Location) -> dict[str, Any]:
    """A place as values of an effect."""
    if isinstance(where, tuple) and not isinstance(where, Between):
        return {"x": float(where[0]), "y": float(where[1])}
    return {"at": where}


@dataclass(frozen=True, eq=False)
class ForceAndMotion:
    """The unmodelled force at a point and the motion there, all records end to end.

    Attributes:
        at: place on the structure.
        force: (n_total,) N.
        displacement, velocity, acceleration: (n_total,) estimates of the real motion there.
        absorbed: whether nominal errors may have absorbed linear parts of the force.
    """

    at: Location
    force: Floats
    displacement: Floats
    velocity: Floats
    acceleration: Floats
    absorbed: bool = False

    def strength_along(self, basis: Floats) -> float:
        """Least-squares k of force ≈ -k basis (n_total,), plus any linear force if nominal errors may absorb one."""
        force = self.force
        if self.absorbed:
            force, basis = (each - self._linear @ (self._linear.T @ each) for each in (force, basis))
        return float(-np.dot(force, basis) / max(np.dot(basis, basis), 1e-300))

    @cached_property
    def _linear(self) -> Floats:
        """Orthonormal columns (n_total, 3) that span the forces of stiffness, damping and mass errors here."""
        motion = np.column_stack([self.displacement, self.velocity, self.acceleration])
        return np.asarray(np.linalg.qr(motion)[0])


class Measured(Protocol):
    """The fit records, whole (`records`) and without the transient at their start (`counted`)."""

    @property
    def records(self) -> tuple[Record, ...]: ...
    @property
    def counted(self) -> tuple[Record, ...]: ...


class Reconstruction(Protocol):
    """What a kind of effect derives its start values from: rig, records, motion and residuals.

    `workbench.gap.localisation.force_reconstruction` computes it.
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


Starts = Callable[[Reconstruction, Any], Iterable[dict[str, Any]]]


@former_fields(
    wider="more_general",
    alone="exclusive",
    remainder="unpredictable",
    settled="without_negligible",
    stands="fixed_place",
    first="applied_first",
    last="applied_last",
    joined="conjunction",
)
@dataclass(frozen=True, eq=False, repr=False)
class Kind:
    """A kind of effect in the catalogue: all that a diagnosis knows of it, from start values to drawings.

    Attributes:
        name: as in the vocabulary.
        path: "actuator", "structure", "sensor" or "environment".
        parameters: rig, target -> its parameters.
        apply: rig, target, values by name -> the changed rig.
        starts: reconstruction, target -> start values of a fit (dicts by parameter name).
        targets: rig -> its possible targets: names of inputs or outputs, "all", an end; (None,) if there is no choice.
        nonlinear: whether the response then depends on level.
        phrase: its name in the sentence of the verdict.
        phrase_between: effect -> its name between two points; None for the same.
        simpler: effect, rig -> its limiting cases at bounds of its parameters, with start values.
        more_general: effect -> effects that it is a limiting case of and that records can mistake for it, with start
            values.
        merged: effect, another -> the one effect that both together may be, with start values; or None.
        other_starts: effect, rig -> the same with other start values, where a fit may end in another minimum.
        signed: whether the change is linear in its one parameter, of either sign, so that one start is enough.
        found_in: "search" if it is found by fits; "readings" if it shows in the readings themselves; "residual" if
            only the statistics of the residual show it.
        exclusive: whether a set may have only one effect of the kind, whatever its target.
        unpredictable: the part of the response that no model can predict, in a sentence; empty if there is none.
        force_laws: "displacement" or "velocity" -> values, that motion (n,) -> force (n,), if the force is a function
            of it alone.
        numbers: effect, rig -> the parameters that a verdict states, by name; None for all but the place.
        without_negligible: effect -> the same without parameters so small that records may not show them; itself if it
            has none.
        second_channel, conjunction: for a kind that acts on two inputs or two outputs, the verdict's name of the
            second, and the word between the two in its sentence.
        remark: effect, rig -> remark of the sentence in brackets; None for its parameters.
        fixed_place: effect, rig -> its place, if it is no parameter, and its name in the sentence.
        applied_first: whether it changes the nominal model itself, before all other effects.
        adds_modes: whether it adds modes to the model, before nominal errors, which may leave no structure to solve.
        applied_last: whether it acts on the modes with all other effects: if modes keep their damping ratios, a damper
            added before a mass would change in strength.
    """

    name: str
    path: str
    parameters: Parameters
    apply: Callable[[Rig, Any, dict[str, Any]], Rig]
    starts: Starts
    targets: Callable[[Rig], tuple[Any, ...]] = lambda rig: (None,)
    nonlinear: bool = False
    phrase: str = ""
    phrase_between: "Callable[[Effect], str] | None" = None
    simpler: Callable[["Effect", Rig], Iterable["Effect"]] = lambda effect, rig: ()
    more_general: Callable[["Effect"], Iterable["Effect"]] = lambda effect: ()
    merged: "Callable[[Effect, Effect], Effect | None]" = lambda effect, other: None
    other_starts: Callable[["Effect", Rig], Iterable["Effect"]] = lambda effect, rig: ()
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
    known: ClassVar[WeakValueDictionary[int, "Kind"]] = WeakValueDictionary()  # by identity: none is equal to another

    def __post_init__(self) -> None:
        Kind.known[id(self)] = self

    def __repr__(self) -> str:
        return f"Kind(name={self.name!r}, path={self.path!r})"

    @property
    def words(self) -> str:
        """Its name in a sentence."""
        return self.phrase or self.name.replace("_", " ")


@former_fields(deviations="std")
@dataclass(frozen=True, eq=False)
class Effect:
    """An effect with values of its parameters.

    Attributes:
        kind: of the catalogue.
        target: input, output, two of them, "all", an end, or None.
        values: by parameter name; at named points also "at", the name of the point or the two it acts between.
        std: standard error by parameter name, where it was fitted.
    """

    kind: Kind
    target: Any
    values: dict[str, Any]
    std: dict[str, float] = field(default_factory=dict)

    def apply(self, rig: Rig) -> Rig:
        """The rig with the effect."""
        return self.kind.apply(rig, self.target, self.values)

    def parameters(self, rig: Rig) -> tuple[Parameter, ...]:
        return self.kind.parameters(rig, self.target)

    @property
    def numbers(self) -> dict[str, Any]:
        """Its values without the place."""
        return {name: value for name, value in self.values.items() if name not in COORDINATES}

    def stands_out(self, rig: Rig) -> bool:
        """Whether any parameter differs from its neutral value by more than its standard deviation.

        True for an effect without neutral values, and for nominal errors.
        """
        tested = [p for p in self.parameters(rig) if p.neutral is not None and self.std.get(p.name, 0.0) > 0]
        off = any(abs(self.values[p.name] - p.neutral) > self.std[p.name] for p in tested)
        return off or not tested or self.kind.applied_first

    def is_sure(self, rig: Rig) -> bool:
        """Whether every stated parameter but the place differs from neutral by more than its standard deviation."""
        nothing = {p.name: p.neutral or 0.0 for p in self.parameters(rig) if p.name not in COORDINATES}
        stated = [(name, value) for name, value in self.stated(rig).items() if name in nothing]
        return all(not abs(value - nothing[name]) < self.std.get(name, 0.0) for name, value in stated)

    def stated(self, rig: Rig) -> dict[str, Any]:
        """The parameters that a verdict states, by name."""
        return self.numbers if self.kind.numbers is None else self.kind.numbers(self, rig)

    @property
    def is_in_readings(self) -> bool:
        """Whether the readings themselves show it, as those of a sensor that clips: no search adds or alters it."""
        return self.kind.found_in == "readings"

    @property
    def at(self) -> Any:
        """Its place: x, (x, y), the name of a point, or `Between` two; None if it has none."""
        return place_of(self.values)

    def moved_to(self, where: Location) -> "Effect":
        """The same effect at another place."""
        return replace(self, values={**self.values, **place_values(where)})

    def of_kind(self, kind: Kind, **values: float) -> "Effect":
        """An effect of another kind, without a target, at the same place."""
        return Effect(kind, None, {**place_values(self.at), **values})

    @property
    def words(self) -> str:
        """Its name in a sentence."""
        between = self.kind.phrase_between
        return between(self) if between is not None and isinstance(self.at, Between) else self.kind.words

    @property
    def label(self) -> str:
        """Name of the kind with its target."""
        names = ", ".join(self.target) if type(self.target) is tuple else self.target
        return f"{self.kind.name}[{names}]" if isinstance(names, str | int) else self.kind.name


def names_in(target: Any) -> tuple[str, ...]:
    """Names of the inputs, outputs or the end that an effect acts on; empty if there are none."""
    return tuple(name for name in (target if isinstance(target, tuple) else (target,)) if isinstance(name, str))


# Names in words that differ from the identifier with spaces for underscores.
SPELLINGS = (
    ("bouc wen", "hysteretic spring (Bouc-Wen)"),
    ("coulomb", "Coulomb"),
    ("two way friction", "asymmetric Coulomb friction"),
    ("modulus error", "overall stiffness error"),
    ("swapped inputs", "exchange of inputs"),
    ("swapped outputs", "exchange of outputs"),
    ("one sided", "one-sided"),
    ("crosstalk", "cross-talk"),
)


def label_in_words(label: str) -> str:
    """A label as shown in figures and notes: actuator gain (F2), one-sided stop."""
    name, _, target = label.partition("[")
    words = name.replace("_", " ")
    for plain, spelt in SPELLINGS:
        words = words.replace(plain, spelt)
    return words + (f" ({target.removesuffix(']').replace('][', ') (')})" if target else "")


def key_of(effects: Iterable[Effect]) -> tuple[str, ...]:
    """Identity of a set of effects, whatever their parameters and order."""
    return tuple(sorted(effect.label for effect in effects))


def apply_all(rig: Rig, effects: Iterable[Effect]) -> Rig:
    """The rig with all effects, applied in this order: added modes, nominal errors, others, dampers."""
    for effect in sorted(effects, key=lambda e: (e.kind.applied_last, not e.kind.adds_modes, not e.kind.applied_first)):
        rig = effect.apply(rig)
    return rig


def can_be(rig: Rig, effects: Iterable[Effect]) -> bool:
    """Whether a rig with these effects is physically possible: no buckling, no segment beyond the structure."""
    try:
        apply_all(rig, effects)
    except (ValueError, np.linalg.LinAlgError):
        return False
    return True


def nearest_possible(rig: Rig, effects: Sequence[Effect], beside: Sequence[Effect] = ()) -> tuple[Effect, ...]:
    """The effects, weakened until a rig with them and others (`beside`) is possible; unchanged if none is.

    A load that a stiffer beam bears may buckle this one.
    """
    for share in WEAKER ** np.arange(WEAKENINGS):
        weaker = tuple(_weakened(effect, rig, float(share)) for effect in effects)
        if can_be(rig, (*weaker, *beside)):
            return weaker
    return tuple(effects)


def _weakened(effect: Effect, rig: Rig, share: float) -> Effect:
    """The effect with its parameters at a share of their distance from neutral."""
    numbers = {p.name: p.neutral for p in effect.parameters(rig) if p.neutral is not None}
    moved = {name: none + share * (effect.values[name] - none) for name, none in numbers.items()}
    return replace(effect, values={**effect.values, **moved})


def simpler_forms(effect: Effect, rig: Rig) -> tuple[Effect, ...]:
    """Limiting cases of an effect at bounds of its parameters, with start values."""
    return tuple(effect.kind.simpler(effect, rig))


def with_two_as_one(effects: Sequence[Effect]) -> Iterator[tuple[Effect, ...]]:
    """The sets with two effects of one kind replaced by one, with start values: two springs may approximate one."""
    for one, other in combinations(effects, 2):
        if one.kind is other.kind and one.target == other.target and one.at is not None:
            rest = [effect for effect in effects if effect is not one and effect is not other]
            names = [name for name in COORDINATES if isinstance(one.values.get(name), float)]
            middle = {name: 0.5 * (one.values[name] + other.values[name]) for name in names}
            yield (*rest, one)
            yield (*rest, one.moved_to(other.at))
            if middle:
                yield (*rest, replace(one, values={**one.values, **middle}))


def _with_one_replaced(
    effects: Sequence[Effect], others: Callable[[Effect], Iterable[Effect]]
) -> Iterator[tuple[Effect, ...]]:
    """The sets with one effect replaced by each of the others of it."""
    for i, effect in enumerate(effects):
        yield from ((*effects[:i], other, *effects[i + 1 :]) for other in others(effect))


def with_one_simpler(effects: Sequence[Effect], rig: Rig) -> Iterator[tuple[Effect, ...]]:
    """The sets with one effect replaced by a limiting case."""
    return _with_one_replaced(effects, lambda effect: simpler_forms(effect, rig))


def each_left_out(effects: Sequence[Effect]) -> Iterator[tuple[Effect, ...]]:
    """The sets with one effect left out, each in turn."""
    for effect in effects:
        yield tuple(other for other in effects if other is not effect)


def more_general_sets(effects: Sequence[Effect]) -> Iterator[tuple[Effect, ...]]:
    """The sets with one effect replaced by one that it is a limiting case of."""
    return _with_one_replaced(effects, lambda effect: effect.kind.more_general(effect))


def merged_sets(effects: Sequence[Effect]) -> Iterator[tuple[Effect, ...]]:
    """The sets with two effects of different kinds replaced by the one that both together may be."""
    for one, other in permutations(effects, 2):
        merged = one.kind.merged(one, other)
        if merged is not None:
            yield (*(effect for effect in effects if effect is not one and effect is not other), merged)


def from_other_starts(effects: Sequence[Effect], rig: Rig) -> Iterator[tuple[Effect, ...]]:
    """The sets with one effect at other start values, where its fit may end in another minimum."""
    return _with_one_replaced(effects, lambda effect: effect.kind.other_starts(effect, rig))


def simpler_sets(effects: Sequence[Effect], rig: Rig) -> Iterator[tuple[Effect, ...]]:
    """The limiting cases of a set: two effects of one kind as one, or one effect as its limiting case."""
    yield from with_two_as_one(effects)
    yield from with_one_simpler(effects, rig)


def contained(effects: Sequence[Effect], rig: Rig) -> set[tuple[str, ...]]:
    """The keys of all limiting cases of a set, and of their limiting cases."""
    found: set[tuple[str, ...]] = set()
    for simpler in simpler_sets(effects, rig):
        if key_of(simpler) not in found:
            found |= {key_of(simpler)} | contained(simpler, rig)
    return found
