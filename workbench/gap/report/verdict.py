"""The verdict on a gap: where it acts, its causes and their shares, in a sentence and as JSON."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from workbench.gap.effects.effect import ALL, COORDINATES, Effect, names_in
from workbench.gap.effects.nominal import NOMINAL_ERRORS
from workbench.gap.effects.nonlinear import any_beyond
from workbench.gap.localisation.breakdown import GapBreakdown
from workbench.gap.report.budget import MOSTLY, REMARKED, Budget, RecordToRecord, Shrinkage, labels_of
from workbench.gap.report.experiment import Detectability, Experiment
from workbench.gap.search.attribute import Attribution
from workbench.records.units import SI, Units
from workbench.renamed import Renamed
from workbench.rig.rig import Rig
from workbench.structure.domain import Between, NamedPoints
from workbench.structure.modes import Modes
from workbench.structure.printed import all_rounded, joined_in_words, rounded

NEAR = 0.05  # of the gap: a set that closes less is not stated as the best fit
SHOWN = 0.005  # of the gap: smaller shares are not stated
NEARLY_ALL = 0.99  # of the gap: a single force that explains more lacks only what noise shows
PROPORTIONAL = 1e-6  # relative: deviation of the shape at a point from a multiple of that at another
SAME_PLACE = 0.02  # of the extent: places as close as this agree
AT_FLOOR = 1.05  # times the noise floor: nothing is said of what a smaller gap is beyond it
ALL_OF_REST = 0.8  # of the power beyond the noise floor: a cause of more is said to be the rest
ALTERNATIVES = 3  # that are printed


@dataclass(frozen=True, eq=False)
class Verdict:
    """The result of a diagnosis.

    Attributes:
        case: name of the case.
        outcome: "none" (no gap beyond noise or a tolerance), "explained", "part" (explained in part) or "unknown".
        effects: the set that explains the gap; empty for "none"; the best-fitting set for "part" and "unknown"; with
            errors of the nominal model if they were fitted jointly.
        budget: shares of the gap: of each effect, of errors of the nominal model, of noise, and the unexplained one.
        alternatives: (label of another set that the records do not exclude, probability), most probable first; their
            sum and `probability`, that of the named set, is one.
        where: the gap by path, mode, frequency band, sensor and record, and the place of a point force.
        shrinkage: of the gap on validation records; None without any.
        corrected: the rig with the effects.
        nominal: the rig before the diagnosis.
        attribution: the result of the search for effects.
        detectability: effects that the records can show and distinguish, before any fit.
        experiment: the next measurement, if alternatives remain.
        tolerance: share of the signal's rms; a smaller gap beyond the noise is not searched for a cause.
        disagreeing: names of validation records that have a gap although the fitted ones have none; the outcome is then
            "unknown".
        units: names of the units of all numbers.
        notes: further remarks, a sentence each.
    """

    case: str
    outcome: str
    effects: tuple[Effect, ...]
    alternatives: tuple[tuple[str, float], ...]
    where: GapBreakdown
    shrinkage: Shrinkage | None
    corrected: Rig
    nominal: Rig
    attribution: Attribution
    detectability: Detectability
    budget: Budget
    experiment: Experiment | None = None
    tolerance: float = 0.0
    disagreeing: tuple[str, ...] = ()
    units: Units = SI
    notes: tuple[str, ...] = ()

    rivals, place_stands = Renamed("alternatives_in_words"), Renamed("is_located")
    readiness = Renamed("detectability")

    @property
    def shows_gap(self) -> bool:
        """Whether the fitted records have a gap, so that it can be located."""
        return self.outcome != "none" and not self.disagreeing

    @property
    def is_decided(self) -> bool:
        """Whether the gap is explained, or there is none."""
        return self.outcome in ("none", "explained")

    @property
    def probability(self) -> float:
        """Probability of the named set against its alternatives; 1 without any."""
        return max(1.0 - sum(probability for _, probability in self.alternatives), 0.0)

    @property
    def _named(self) -> tuple[Effect, ...]:
        """The effects without nominal errors; quantisation or clipping of all sensors is stated as one effect.

        Its step or limit is in the unit of the readings, so they must be of one quantity.
        """
        shown = [e for e in self.effects if e.kind is not NOMINAL_ERRORS]
        is_one_quantity = len({sensor.quantity for sensor in self.nominal.sensors}) == 1
        for kind in dict.fromkeys(e.kind for e in shown if e.kind.found_in == "readings"):
            same = [e for e in shown if e.kind is kind]
            if is_one_quantity and len(same) == len(self.nominal.sensors) > 1:
                shown = [e for e in shown if e.kind is not kind]
                median = {name: float(np.median([e.values[name] for e in same])) for name in same[0].values}
                shown.insert(0, Effect(kind, ALL, median))
        return tuple(shown)

    @property
    def is_located(self) -> bool:
        """Whether a single point force, of any law, explains the gap, at a place that agrees with a named effect."""
        if not self.where.place.is_single_force:
            return False
        return self.outcome != "explained" or self._agrees(self._acting)

    @property
    def _acting(self) -> tuple[Effect, ...]:
        """The effects that act at a place of the structure."""
        return tuple(e for e in self.effects if e.at is not None and e.kind.path in ("structure", "environment"))

    def _agrees(self, acting: tuple[Effect, ...]) -> bool:
        """Whether the place of a single point force is that of one of the effects, within its error."""
        domain = self.nominal.modes.domain
        if isinstance(domain, NamedPoints):
            return any(domain.separation(effect.at, self.where.at) == 0 for effect in acting)
        tolerance = max(3.0 * self.where.at_std / domain.size, SAME_PLACE)
        return any(domain.separation(effect.at, self.where.at) < tolerance for effect in acting)

    @property
    def location_in_words(self) -> str:
        """Where the unmodelled point force acts, or that no single one does; empty if neither is certain.

        Small errors of the model act all over the structure, so nothing is said where they cause most of the gap; nor
        where the place is another than that of the effects that explain it.
        """
        place, explained = self.where.place, self.outcome == "explained"
        if explained and self.budget.nominal > MOSTLY:
            return ""
        at = place_in_words(place.at, dict.fromkeys(COORDINATES, place.at_std))
        if self.is_located:
            return f"{at} (unmodelled point force, no force law assumed)"
        elsewhere = explained and self._acting and not self._agrees(self._acting)
        if place.is_single_force is not False or elsewhere:
            return ""
        residual = f"the residual is {_percent(float(np.sqrt(1.0 - place.share)))}"
        if place.share > NEARLY_ALL:
            return f"with a single point force, {at}, {residual} of the gap's rms, more than noise"
        return f"no single point force explains all of the gap; with the best, {at}, {residual} of its rms"

    @property
    def nominal_errors(self) -> Effect | None:
        """Errors of the nominal model that were fitted jointly with the effects; None if none were."""
        return next((effect for effect in self.effects if effect.kind is NOMINAL_ERRORS), None)

    @property
    def record_to_record(self) -> RecordToRecord | None:
        """A nominal parameter that varies from record to record; None if its share of the gap is negligible."""
        varying = RecordToRecord.of(self.nominal, self.effects)
        if varying is None or self.budget.effects.get(varying.label, 0.0) < SHOWN:
            return None
        return replace(varying, force=self.units.force)

    @property
    def sentence(self) -> str:
        """The verdict in one sentence."""
        if self.disagreeing:
            text = self._no_gap_in_words
            return f"In the records that were fitted, {text[0].lower()}{text[1:-1]}; but {self._disagreement}."
        if not self.shows_gap:
            return self._no_gap_in_words
        stated = sorted(self._named, key=self._share_of, reverse=True)
        named = [_described(effect, self.nominal, self.units) for effect in stated]
        words = joined_in_words(named)
        closed = "" if self.shrinkage is None else f"{100 * max(self.shrinkage.overall, 0.0):.0f} % of its rms"
        if self.outcome == "explained":
            shares = [self._share_of(effect) for effect in stated]
            if len(named) == 1:
                text = f"{words} causes {_percent(shares[0])} of the gap"
            else:
                each = joined_in_words([_percent(share) for share in shares])
                text = f"{words} cause {_percent(sum(shares))} of the gap ({each})"
            if any(effect.kind.unpredictable for effect in self.effects):
                text += ", part of which is unpredictable"
            text += self._rest + self._not_excluded
            return text[0].upper() + text[1:]
        text = "No effect of the catalogue, alone or with another, explains the gap"
        if self.attribution.is_cut:
            text = "None of the effects tried before the time limit explains the gap"
        if any_beyond(self.effects):
            if self.alternatives:
                return f"{text} as well as {words}, which explains {closed or 'it'}{self._not_excluded}"
            return f"{text}; {words} explains {closed or 'it'}."
        if not words or (self.shrinkage is not None and self.shrinkage.overall < NEAR):
            return f"{text}{self._rest}."
        beside = f" with {self._errors_named}" if self.budget.nominal >= SHOWN else ""
        return f"{text}; the best fit, {words}{beside}, would close {closed or 'part of it'}."

    @property
    def _no_gap_in_words(self) -> str:
        """The sentence if the fitted records have no gap, or only errors of the nominal model."""
        if self.nominal_errors is None:
            louder = self.budget.noise_ratio > REMARKED and self.budget.unexplained < SHOWN
            beyond, tolerance = self.where.beyond_noise, self.tolerance
            if louder or not 0.0 < beyond < tolerance:  # if a gap above the tolerance was searched, it is noise
                return "There is no gap beyond the noise of the sensors."
            below = f"below the tolerance of {100.0 * tolerance:g} %"
            return f"The gap beyond the noise is {_percent(beyond)} of the signal, {below}."
        if self.record_to_record is not None:
            varying = self.record_to_record
            share = _percent(self.budget.effects.get(varying.label, 0.0))
            how = f"The {varying.parameter} varies from record to record ({varying.words})"
            return f"{how}. This causes {share} of the gap{self._rest}."
        if self.budget.errors_are_small:
            return f"There is no gap beyond small errors of the nominal model{self._errors_in_words} and noise."
        return (
            "Errors of the nominal model explain the gap, but they are implausibly large"
            f"{self._errors_in_words}: an effect outside the catalogue may be missing."
        )

    @property
    def _disagreement(self) -> str:
        """The residuals of the validation records that disagree, over their signals, and the remedy."""
        sizes = {} if self.shrinkage is None else {n: _percent(self.shrinkage.after[n]) for n in self.disagreeing}
        if len(sizes) == 1:
            ((name, size),) = sizes.items()
            return f"the residual of validation record {name} is {size} of its signal: include it in the fit"
        names, each = joined_in_words(list(sizes)), joined_in_words(list(sizes.values()))
        return f"the residuals of validation records {names} are {each} of their signals: include them in the fit"

    def _share_of(self, effect: Effect) -> float:
        """Share of the gap that an effect causes; summed over sensors if it stands for all of them."""
        shares, named = self.budget.effects, [e for e in self.effects if not e.kind.applied_first]
        labels = dict(zip(named, labels_of(named, self.nominal.modes.domain), strict=True))
        label = labels.get(effect, effect.label)
        if label in shares:
            return shares[label]
        return sum(share for label, share in shares.items() if label.split("[")[0] == effect.kind.name)

    @property
    def _rest(self) -> str:
        """The shares of the gap that the effects do not cause, in words."""
        parts, varying = [], self.record_to_record
        if varying is not None and self.shows_gap:
            share = _percent(self.budget.effects.get(varying.label, 0.0))
            parts.append(f"{share} is due to the variation of {varying.parameter} between records ({varying.words})")
        if self.budget.nominal >= SHOWN:
            due = "may be due to" if self._is_unexplained else "is due to"
            parts.append(f"{_percent(self.budget.nominal)} {due} {self._errors_named}")
        if self.budget.unexplained >= SHOWN:
            parts.append(f"{_percent(self.budget.unexplained)} remains unexplained")
        if self.budget.noise >= SHOWN:
            parts.append(f"{_percent(self.budget.noise)} is noise")
        return "; " + ", ".join(parts) if parts else ""

    @property
    def _is_unexplained(self) -> bool:
        """Whether most of the gap is unexplained, so that fitted nominal errors have over-fitted it."""
        return self.outcome == "unknown" and self.budget.is_mostly_unexplained

    @property
    def _errors_named(self) -> str:
        """Nominal errors, such as: small errors of the model (stiffness 0.4 %); no sizes if they are over-fitted."""
        if self._is_unexplained:
            return "errors of the model"
        size = "small" if self.budget.errors_are_small else "implausibly large"
        return f"{size} errors of the model{self._errors_in_words}"

    @property
    def _errors_in_words(self) -> str:
        """Sizes of the nominal errors, such as: (stiffness 0.4 %, damping 12 %)."""
        sizes = self.budget.errors
        percent = {name.removesuffix("_percent"): size for name, size in sizes.items() if name.endswith("percent")}
        words = [f"{name} {size:.2g} %" for name, size in percent.items() if size > 0.01]
        common, delays = sizes.get("common_delay_ms", 0.0), sizes.get("delays_ms", 0.0)
        if common:
            late = "late" if common > 0 else "early"
            words.append(f"all sensors, or the actuators, {late} by {self._delay_in_words(abs(common))}")
        elif delays > 0:
            words.append(f"timing of sensors {self._delay_in_words(delays)}")
        return f" ({', '.join(words)})" if words else ""

    def _delay_in_words(self, delay: float) -> str:
        """A delay, in thousandths of the unit of time, with its unit."""
        time = self.units.time
        return f"{delay:.2g} ms" if time == "s" else f"{1e-3 * delay:.2g} {time}"

    @property
    def alternatives_in_words(self) -> tuple[tuple[str, float], ...]:
        """The alternatives in words: (set, probability), most probable first."""
        return tuple(
            (joined_in_words([_named_with_target(e) for e in fit.effects if not e.kind.applied_first]), probability)
            for fit, probability in self.attribution.alternatives
        )

    @property
    def _not_excluded(self) -> str:
        """The end of the sentence: the alternatives that cannot be excluded."""
        likely = [words for words, probability in self.alternatives_in_words if probability > 0.01]
        return f"; {', or '.join(likely)} cannot be excluded." if likely else "."

    def __str__(self) -> str:
        """The sentence, the place, the gap of each record, the alternatives and the notes, by lines."""
        lines, where, gap = [self.sentence], self.where, self._gap
        if self.shows_gap:  # without a gap the residual is noise, and has no place
            amplitude = {True: "; depends on amplitude", False: "; does not depend on amplitude", None: ""}
            lines.append(f"subsystem  {where.path}{amplitude[where.amplitude_dependent]}")
            lines.append(f"modes      {', '.join(map(str, where.modes)) or 'none'}")
        if self.shows_gap and where.path in ("structure", "environment") and self.location_in_words:
            lines.append(f"place      {self.location_in_words}")
        lines += [f"record {name!r}: {_gap_in_words(gap, name)}" for name in gap["before"]]
        if self.alternatives and self.outcome == "explained":
            lines.append(f"probability {self.probability:.2g} of the set named")
        alternatives = self.alternatives_in_words[:ALTERNATIVES]
        lines += [f"alternative {words} ({probability:.2g})" for words, probability in alternatives]
        return "\n  ".join([*lines, *self.notes])

    @property
    def _gap(self) -> dict[str, dict[str, Any]]:
        """The gap of each validation record: rms error / rms signal before and after, and of noise alone."""
        shrink, logged = self.shrinkage, self.budget.input_noise
        if shrink is None:
            return {"before": {}, "after": {}, "floor": {}}
        gaps = {"before": shrink.before, "after": shrink.after, "floor": shrink.floor}
        of_inputs = {n: gap * float(np.sqrt(logged[n])) for n, gap in shrink.before.items() if n in logged}
        gaps |= {"input_noise": of_inputs} if of_inputs else {}
        return {name: all_rounded(by_record) for name, by_record in gaps.items()}

    def __repr__(self) -> str:
        return f"<Verdict on {self.case}: {self.sentence}>"

    def to_json(self) -> dict[str, Any]:
        """The verdict as the case format writes it, with the shares and estimates behind it."""
        effects = [effect_json(effect, self.nominal, self.units) for effect in self._named]
        shrink, guessed = self.shrinkage, self.attribution.search.data.guessed
        return {
            "case": self.case,
            "units": asdict(self.units),
            "outcome": self.outcome,
            "sentence": self.sentence,
            "effects": effects if self.is_decided else [{"kind": "unknown", "parameters": {}}],
            "best_fit": [] if self.is_decided else effects,
            "probability": rounded(self.probability) if self.outcome == "explained" else None,
            "alternatives": [
                {"kind": label, "words": words, "probability": rounded(p)}
                for (label, p), (words, _) in zip(self.alternatives, self.alternatives_in_words, strict=True)
            ],
            "where": breakdown_json(self.where),
            "gap": self._gap,
            "shrinkage": {**all_rounded(shrink.share), "ci95": all_rounded(shrink.ci95)} if shrink else {},
            "residual": {
                "nominal": rounded(self.attribution.nominal_cost),
                "corrected": rounded(self.attribution.best.cost),
            },
            "check": {
                "undetectable": list(self.detectability.undetectable),
                "indistinguishable": [list(pair[:2]) for pair in self.detectability.indistinguishable],
            },
            "next_experiment": None if self.experiment is None else self.experiment.sentence,
            "budget": self.budget.to_json(),
            "nominal": all_rounded(dict(self.budget.errors)),
            "record_to_record": None if self.record_to_record is None else self.record_to_record.to_json(),
            "noise": {
                "stated": [None if s.name in guessed else rounded(s.noise_std) for s in self.nominal.sensors],
                "found": all_rounded(self.budget.noise_found),
                "found_at_most": list(self.budget.is_noise_at_bound),
            },
            "notes": list(self.notes),
        }


def effect_json(effect: Effect, nominal: Rig, named_units: Units = SI) -> dict[str, Any]:
    """An effect as the case format writes it: kind, parameters with deviations and units, place, input or output."""
    kind = effect.kind
    stated = effect.stated(nominal)
    entry: dict[str, Any] = {"kind": kind.name, "parameters": all_rounded(stated)}
    deviations = {n: rounded(d) for n, d in effect.std.items() if n in stated}
    if deviations:
        entry["parameters_std"] = deviations
    units = {p.name: named_units.named(p.unit) for p in effect.parameters(nominal) if p.unit and p.name in stated}
    if units:
        entry["parameters_unit"] = units
    if kind.path in ("actuator", "sensor"):
        side, target = "input" if kind.path == "actuator" else "output", effect.target
        entry |= {side: target[0], kind.second_channel: target[1]} if isinstance(target, tuple) else {side: target}
    if kind.fixed_place is not None:
        entry["at"], entry["at_std"] = kind.fixed_place(effect, nominal)[0], 0.0
    elif effect.at is not None:
        entry |= _place_json(effect.at)
        spread = [rounded(effect.std.get(name, 0.0)) for name in COORDINATES if name in effect.values]
        entry["at_std"] = spread if len(spread) > 1 else spread[0]
        alike = proportional_points(effect.at, nominal.modes)
        if alike:
            entry["or_at"] = list(alike)
    return entry


def _place_json(where: Any) -> dict[str, Any]:
    """A place as the case format writes it: x, [x, y], the name of a point, or the two it is between."""
    if isinstance(where, Between):
        return {"between": list(where)}
    if isinstance(where, tuple):
        return {"at": all_rounded(where)}
    return {"at": where if isinstance(where, str) else rounded(where)}


def breakdown_json(where: GapBreakdown) -> dict[str, Any]:
    """The location of a gap as plain numbers."""
    by_record = zip(where.record_names, where.record_gaps, where.input_levels, where.time_shares, strict=True)
    return {
        "path": where.path,
        "modes": list(where.modes),
        "amplitude_dependent": where.amplitude_dependent,
        "linear_share": rounded(where.linear_share),
        "above_last_mode": rounded(where.share_above),
        "point": {
            **_place_json(where.at),
            "at_std": rounded(where.at_std),
            "share": rounded(where.place.share),
            "single_force": where.place.is_single_force,
        },
        "by_mode": all_rounded(where.mode_shares),
        "by_band": {"edges_hz": all_rounded(where.band_edges_hz), "shares": all_rounded(where.band_shares)},
        "by_sensor": all_rounded(where.sensor_shares),
        "by_record": {
            name: {"gap": rounded(gap), "input_rms": rounded(level), "by_eighth": all_rounded(shares)}
            for name, gap, level, shares in by_record
        },
    }


def _named_with_target(effect: Effect) -> str:
    """An effect in words without its parameters, such as: a constant force of an actuator (F2)."""
    _, _, target = effect.label.removesuffix("]").partition("[")
    return effect.words + (f" ({target})" if target else "")


def _described(effect: Effect, nominal: Rig, named_units: Units = SI) -> str:
    """An effect in words: Coulomb friction (force 0.021 ± 0.002 N) at x = 3.40 ± 0.01."""
    stated = effect.stated(nominal)
    units = {p.name: named_units.named(p.unit) for p in effect.parameters(nominal) if p.name in stated}
    numbers = [
        " ".join((name.replace("_", " "), _with_deviation(stated[name], effect.std.get(name, 0.0)), unit))
        for name, unit in units.items()
        if name not in COORDINATES
    ]
    kind, text = effect.kind, effect.words
    inside = kind.remark(effect, nominal) if kind.remark is not None else ", ".join(n.strip() for n in numbers)
    if kind.path in ("actuator", "sensor"):
        target = effect.target if effect.target == ALL else kind.conjunction.join(names_in(effect.target))
        inside = f"{target}: {inside}" if inside else str(target)
    if inside:
        text += f" ({inside})"
    if kind.fixed_place is not None:
        text += f" {kind.fixed_place(effect, nominal)[1]}"
    elif effect.at is not None:
        text += f" {place_in_words(effect.at, effect.std)}"
        alike = proportional_points(effect.at, nominal.modes)
        if alike:
            more = f" and {len(alike) - 3} others" if len(alike) > 3 else ""
            text += f" (or in proportion at {' or '.join(alike[:3])}{more})"
    return text


def proportional_points(where: Any, modes: Modes) -> tuple[str, ...]:
    """Other named points that move in proportion to a point in every mode, though not as it does.

    A law there with its constants scaled gives the same readings, so that no record distinguishes the points.
    """
    if not isinstance(where, str):
        return ()
    names, shape = [str(name) for name in modes.domain.grid(0)], modes.phi_at(where)
    others = modes.phi(names)
    ratios = others @ shape / max(float(shape @ shape), 1e-300)
    off = np.linalg.norm(others - ratios[:, None] * shape, axis=1)
    alike = (off < PROPORTIONAL * np.linalg.norm(others, axis=1)) & (np.abs(np.abs(ratios) - 1.0) > PROPORTIONAL)
    return tuple(name for name, is_alike in zip(names, alike, strict=True) if is_alike)


def place_in_words(where: Any, deviations: Mapping[str, float]) -> str:
    """A place in words: at x = 3.40 ± 0.01; at (0.63 ± 0.01, 0.72 ± 0.01); at F1.4y; between F1.4y and F2.4y."""
    if isinstance(where, Between):
        return f"between {where.first} and {where.second}"
    if isinstance(where, tuple):
        x, y = (_with_deviation(value, deviations.get(n, 0.0)) for n, value in zip("xy", where, strict=True))
        return f"at ({x}, {y})"
    return f"at {where}" if isinstance(where, str) else f"at x = {_with_deviation(where, deviations.get('at', 0.0))}"


def rest_in_words(gap: Mapping[str, Mapping[str, float | None]], record: str) -> str:
    """What the gap of a record, as in the JSON, is beyond the noise floor; empty where that is not known."""
    after, floor = gap["after"].get(record), gap["floor"].get(record)
    of_inputs = gap.get("input_noise", {}).get(record)
    if not (after and floor and of_inputs) or after <= AT_FLOOR * floor:
        return ""
    is_all = of_inputs**2 > ALL_OF_REST * (after**2 - floor**2)
    return "noise of the logged inputs, which no model predicts" if is_all else ""


def _gap_in_words(gap: Mapping[str, Mapping[str, float]], record: str) -> str:
    """The gap of a record, such as: rms error / rms signal 17.3 % → 0.378 %, noise floor 0.375 %."""
    before, after = gap["before"][record], gap["after"][record]
    sizes = [before] if before == after else [before, after]  # equal where nothing was corrected
    rest = rest_in_words(gap, record)
    text = f"rms error / rms signal {' → '.join(map(_to_three_digits, sizes))}"
    text += f", noise floor {_to_three_digits(gap['floor'][record])}"
    return text + (f"; the rest is {rest}" if rest else "")


def _to_three_digits(share: float | None) -> str:
    """A share in per cent to three digits, or to the per cent if it is larger."""
    if share is None:
        return "beyond all bounds"
    percent = 100.0 * share
    return f"{percent:.0f} %" if percent >= 100.0 else f"{percent:.3g} %"


def _percent(share: float) -> str:
    """A share in per cent, with one decimal if it is small or nearly one."""
    percent = 100.0 * share
    if percent < 0.05:
        return "less than 0.1 %"
    return f"{percent:.1f} %" if percent < 9.95 or 99.05 <= percent < 99.95 else f"{percent:.0f} %"


def _with_deviation(value: float, deviation: float) -> str:
    """A value with its standard deviation, such as 3.40 ± 0.01; without one that is negligible or unknown."""
    if not deviation > 0 or not np.isfinite(deviation) or deviation < 5e-4 * abs(value):
        return f"{value:.4g}"
    digits = max(0, -int(np.floor(np.log10(deviation))))
    if digits > 4 or abs(value) >= 1e5:
        return f"{value:.4g} ± {deviation:.1g}"
    return f"{value:.{digits}f} ± {deviation:.{digits}f}"
