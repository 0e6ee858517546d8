"""The size of a gap: how far it shrinks on held-out records, and its budget, the share of each cause."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from workbench.arrays import Floats
from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.effects.nominal import TENSION, deviations_of, in_group, label_of, parted
from workbench.gap.effects.structural import buckling_load
from workbench.gap.prediction.noise import loudest_logging_noise
from workbench.gap.prediction.residuals import FitData, lead_of, scale_of
from workbench.gap.search.settings import JOINT
from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.rig.simulate import simulate_record
from workbench.structure.domain import Domain

AT_BOUND = 0.99  # of the largest noise that a search accepts: estimates above it are at the bound
REMARKED = 1.3  # ratio of estimated and stated noise from which a remark is made
# groups of errors that are reported in per cent: the name in the plural, and the largest small error, per cent rms, a
# quarter to a half more than the worst models of trials have; false local minima have larger errors
PERCENT = {
    "stiffness": ("stiffness", 5.0),
    "mass": ("mass", 5.0),
    "frequency": ("frequencies", 2.5),
    "coupling": ("coupling of modes", 5.0),
    "damping": ("damping", 90.0),
    "gain": ("gains", 5.0),
    "place": ("places", 1.0),
    "shape": ("shapes", 10.0),
}
MOSTLY = 0.5  # of the gap: its greater part; if that is unexplained, the fitted nominal errors have over-fitted it
DIVERGED = 1e30  # mean square of a divergent residual, in units of the signal's
COMMON = 2.0  # times the scatter of delays: a larger mean is reported as a common delay
LEAST_DELAY = 1e-3  # of a sample: shorter delays are not reported
DRAWS = 400  # bootstrap draws, for the interval of the shrinkage
REACH = 4.0  # standard deviations from record to record: bound of the deviation of a held-out record
TOLERANCE = 1e-3  # of that bound: accuracy of the deviation


@dataclass(frozen=True, eq=False)
class Shrinkage:
    """The gap of validation records before and after a correction, with the share of it that is closed.

    Attributes:
        before, after, floor: by record name; the gap of the case format.
        share: of the closable gap closed, by record name: 1 - sqrt(after² - floor²) / sqrt(before² - floor²).
        overall: the same over all records together, with equal weights.
        ci95: 95 % interval of `overall`, by block bootstrap.
    """

    before: dict[str, float]
    after: dict[str, float]
    floor: dict[str, float]
    share: dict[str, float]
    overall: float
    ci95: tuple[float, float]


def measure(nominal: Rig, corrected: Rig, records: Sequence[Record], *, transient: float = 0.0) -> Shrinkage | None:
    """The shrinkage of the gap on validation records, from the nominal to the corrected rig; None without records.

    Its interval is from a bootstrap over the blocks of `block_length`.
    """
    if not records:
        return None
    before, after, floor, blocks, lengths = {}, {}, {}, [], []
    for record in records:
        lead = lead_of(record, transient)
        measured = record.outputs[:, lead:]
        scale = scale_of(measured)
        errors = [((measured - simulate_record(rig, record)[:, lead:]) / scale) ** 2 for rig in (nominal, corrected)]
        noise = np.array([s.noise_std for s in nominal.sensors])[:, None] / scale
        before[record.name], after[record.name] = (float(np.sqrt(e.mean())) for e in errors)
        floor[record.name] = float(np.sqrt((noise**2).mean()))
        length = block_length(nominal, measured.shape[1], record.sample_time)
        for start in range(0, measured.shape[1], length):
            piece = slice(start, start + length)
            blocks.append([errors[0][:, piece].mean(), errors[1][:, piece].mean(), (noise**2).mean()])
            lengths.append(errors[0][:, piece].shape[1] / measured.shape[1])
    table, weights = np.array(blocks), np.array(lengths)  # the last block of a record may be short
    rng = np.random.default_rng(0)

    def closed(drawn: np.ndarray) -> float:
        return _closed(*np.average(table[drawn], axis=0, weights=weights[drawn]))

    draws = [closed(rng.integers(0, len(table), len(table))) for _ in range(DRAWS)]
    return Shrinkage(
        before=before,
        after=after,
        floor=floor,
        share={n: _closed(before[n] ** 2, after[n] ** 2, floor[n] ** 2) for n in before},
        overall=closed(np.arange(len(table))),
        ci95=(float(np.quantile(draws, 0.025)), float(np.quantile(draws, 0.975))),
    )


def _closed(before: float, after: float, floor: float) -> float:
    """Share of the closable gap that is closed, from mean squares; 0 if there was none."""
    if before <= floor * 1.01:
        return 0.0
    return float(1.0 - np.sqrt(max(after - floor, 0.0) / (before - floor)))


def block_length(rig: Rig, n_samples: int, sample_time: float) -> int:
    """Samples of a block: three decay times of the slowest elastic mode, 1/20 to 1/8 of the samples that are compared.

    Residuals of such blocks are nearly independent.
    """
    rates = (rig.modes.zeta * rig.modes.omega)[rig.modes.omega > 0]
    decay = 3.0 / max(rates.min(), 1e-12) / sample_time if rates.size else n_samples
    return int(np.clip(decay, max(n_samples // 20, 1), max(n_samples // 8, 1)))


@dataclass(frozen=True, eq=False)
class Budget:
    """Shares of the mean square of the nominal residual, which sum to one.

    Attributes:
        effects: share that each named effect removes, by label (`labels_of`), largest first; a parameter that varies
            from record to record is among them, as "stiffness_record_to_record".
        nominal: share that small errors of the nominal model remove beyond the effects, and that noise of the logged
            inputs causes.
        unexplained: share that remains and is not noise.
        noise: share of the sensors' noise.
        by_record: the same shares (n_shares,) of each record by name: effects, nominal, unexplained, noise.
        errors: root mean squares of the small errors: "frequencies_percent", "inputs_percent", "delays_ms" and so on;
            "common_delay_ms" is the delay of all sensors.
        input_noise: share of each record by name that noise of the logged inputs causes, a part of the nominal one; no
            entry where there is none.
        noise_stated, noise_found: (n_outputs,) stated and estimated standard deviation of each sensor's noise, in its
            unit.
    """

    effects: Mapping[str, float]
    nominal: float
    unexplained: float
    noise: float
    by_record: Mapping[str, np.ndarray] = field(repr=False)
    errors: Mapping[str, float] = field(default_factory=dict)
    noise_stated: tuple[float, ...] = ()
    noise_found: tuple[float, ...] = ()
    input_noise: Mapping[str, float] = field(default_factory=dict)

    @property
    def noise_ratio(self) -> float:
        """Estimated over stated noise, the median over sensors."""
        return float(np.median(np.array(self.noise_found) / np.array(self.noise_stated)))

    @property
    def is_noise_at_bound(self) -> tuple[bool, ...]:
        """Whether each sensor's estimated noise is at the bound of the search, or above it: then it may be lower."""
        ratios = np.array(self.noise_found) / np.array(self.noise_stated)
        bounds = JOINT.credible_noise, JOINT.credible_guessed_noise
        at_bound = [np.abs(ratios / bound - 1.0) < 1.0 - AT_BOUND for bound in bounds]
        return tuple(bool(at) for at in np.any(at_bound, axis=0) | (ratios > max(bounds)))

    @property
    def noise_remark(self) -> str | None:
        """A remark that the estimated and the stated noise disagree; None if they agree."""
        ratio = self.noise_ratio
        if 1.0 / REMARKED < ratio < REMARKED:
            return None
        if ratio > AT_BOUND * JOINT.credible_noise:
            return (
                f"The residual is {ratio:.2g} times the model's noise_std or more: more noise than stated, or errors of"
                " the model that neither effects nor small errors describe."
            )
        if self.has_unexplained_residual:
            return f"What looks like noise is {ratio:.2g} times the model's noise_std; part of it may be model error."
        return f"The noise of the sensors is {ratio:.2g} times the model's noise_std."

    @property
    def has_unexplained_residual(self) -> bool:
        """Whether the unexplained share is larger than that of noise."""
        return self.unexplained > self.noise > 0.0

    @property
    def is_mostly_unexplained(self) -> bool:
        return self.unexplained > MOSTLY

    @property
    def errors_are_small(self) -> bool:
        """Whether the errors of the nominal model are as small as those of a careful laboratory."""
        return are_small(self.errors)

    def to_json(self) -> dict[str, Any]:
        """The shares as the case format writes them, effects by kind."""
        by_kind: dict[str, float] = {}
        for label, share in self.effects.items():
            kind = label.split("[")[0]
            by_kind[kind] = by_kind.get(kind, 0.0) + share
        return {
            "effects": {kind: _rounded(share) for kind, share in by_kind.items()},
            "nominal": _rounded(self.nominal),
            "unexplained": _rounded(self.unexplained),
            "noise": _rounded(self.noise),
        }


def budget_of(
    rig: Rig,
    effects: Sequence[Effect],
    errors: Effect | None,
    records: Sequence[Record],
    *,
    noise_found: np.ndarray,
    logged: float = 0.0,
    transient: float = 0.0,
) -> Budget:
    """The budget: the mean square of the nominal residual, divided among its causes.

    Each sensor is scaled by the standard deviation of its readings, as in the gap of a record. What all causes remove
    together is divided in proportion to how much the residual grows without each of them. Causes that partly cancel
    one another would remove nothing one by one, or less.

    Args:
        errors: of the nominal model; see `with_held_out` for those that vary from record to record.
        noise_found: (n_outputs,) estimated standard deviation of each sensor's noise.
        logged: noise of the logged inputs, as a share of their rms.
    """
    labels, causes = labels_of(effects, rig.modes.domain), list(effects)
    common, varying = (None, None) if errors is None else parted(errors)
    if varying is not None:
        labels.append(label_of(varying.target.parameter))
        causes.append(varying)
    causes += [] if common is None else [common]
    nominal, left = (residual_powers(rig, chosen, records, transient) for chosen in ((), causes))
    without = [residual_powers(rig, [c for c in causes if c is not cause], records, transient) for cause in causes]
    weights = np.array([np.maximum(w - left, 0.0) for w in without]).reshape(len(causes), len(records))
    total = weights.sum(axis=0)
    removed = np.maximum(nominal - left, 0.0) * weights / np.where(total > 0, total, 1.0)
    by_size = sorted(range(len(labels)), key=lambda i: -removed[i].sum())
    rows = [*removed[by_size], removed[-1] if common is not None else np.zeros_like(left)]
    noise = np.minimum(np.array([noise_power(record, noise_found, transient) for record in records]), left)
    rest = left - noise
    by_inputs = np.zeros_like(left)
    if logged:
        by_inputs = np.minimum(logged**2 * power_of_inputs(rig, records, transient), rest)
    rows[-1], rest = rows[-1] + by_inputs, rest - by_inputs
    for row, i in enumerate(by_size):  # an unpredictable effect causes all of the remaining residual
        if causes[i].kind.unpredictable:
            rows[row], rest = rows[row] + rest, np.zeros_like(rest)
    shares = np.array([*rows, rest, noise])
    whole = shares.sum(axis=1).clip(0.0) / max(nominal.sum(), 1e-300)
    whole = whole / max(whole.sum(), 1e-300)
    by_record = {r.name: shares[:, i] / max(nominal[i], 1e-300) for i, r in enumerate(records)}
    input_shares = zip(records, by_inputs / np.maximum(nominal, 1e-300), strict=True)
    of_inputs = {record.name: float(share) for record, share in input_shares if share > 0}
    return Budget(
        effects={labels[i]: float(share) for i, share in zip(by_size, whole, strict=False)},
        nominal=float(whole[-3]),
        unexplained=float(whole[-2]),
        noise=float(whole[-1]),
        by_record=by_record,
        errors={**sizes_of(common), **({"inputs_percent": 100.0 * logged} if of_inputs else {})},
        noise_stated=tuple(float(s.noise_std) for s in rig.sensors),
        noise_found=tuple(noise_found.tolist()),
        input_noise=of_inputs,
    )


def labels_of(effects: Sequence[Effect], domain: Domain) -> list[str]:
    """Labels of effects in a budget; effects of one kind and target have their places in the label."""
    labels = [effect.label for effect in effects]
    return [
        f"{label}[{domain.text(effect.at)}]" if labels.count(label) > 1 and effect.at is not None else label
        for effect, label in zip(effects, labels, strict=True)
    ]


def residual_powers(rig: Rig, effects: Sequence[Effect], records: Sequence[Record], transient: float) -> Floats:
    """Mean square residual (n_records,) by a rig with effects, as `signal_power`; `DIVERGED` for an impossible rig."""
    try:
        corrected = apply_all(rig, effects)
    except (ValueError, np.linalg.LinAlgError):
        return np.full(len(records), DIVERGED)
    # without one of two effects that balance each other, the response may diverge
    with np.errstate(over="ignore", invalid="ignore"):
        powers = [signal_power(r, r.outputs - simulate_record(corrected, r), transient) for r in records]
    return np.array([power if power < DIVERGED else DIVERGED for power in powers])


def signal_power(record: Record, readings: np.ndarray, transient: float) -> float:
    """Mean square of signals (n_outputs, n_samples), each sensor scaled by the standard deviation of its readings."""
    lead = lead_of(record, transient)
    return float(((readings[:, lead:] / scale_of(record.outputs[:, lead:])) ** 2).mean())


def noise_power(record: Record, noise: np.ndarray, transient: float) -> float:
    """Mean square of noise (n_outputs,), each sensor scaled by the standard deviation of a record's readings."""
    measured = record.outputs[:, lead_of(record, transient) :]
    return float(((noise[:, None] / scale_of(measured)) ** 2).mean())


def power_of_inputs(rig: Rig, records: Sequence[Record], transient: float) -> np.ndarray:
    """Residual power (n_records,) due to input noise as large as the inputs, as `loudest_logging_noise`."""
    powers = loudest_logging_noise(rig, FitData(tuple(records), np.ones(len(rig.sensors)), transient=transient))
    scales = np.array([scale_of(record.outputs[:, lead_of(record, transient) :])[:, 0] for record in records])
    return np.asarray((powers / scales**2).mean(axis=1))


def are_small(sizes: Mapping[str, float]) -> bool:
    """Whether nominal errors of these sizes (`sizes_of`) are as small as those of a careful laboratory."""
    return all(sizes.get(f"{name}_percent", 0.0) < largest for name, largest in PERCENT.values())


def sizes_of(errors: Effect | None) -> dict[str, float]:
    """Root mean squares of the errors of a nominal model, by group, per cent; delays and their common part, ms.

    Delays of less than a thousandth of a sample are left out. A common delay may be of the sensors or of the actuators:
    in open loop the readings are the same.
    """
    if errors is None:
        return {}
    values = {name: list(in_group(errors.values, group).values()) for group, (name, _) in PERCENT.items()}
    sizes = {f"{name}_percent": 100.0 * float(np.sqrt(np.mean(np.square(v)))) for name, v in values.items() if v}
    in_samples = np.array([*in_group(errors.values, "delay").values()])
    if np.abs(in_samples).max(initial=0.0) >= LEAST_DELAY:
        delays = 1e3 * getattr(errors.target, "sample_time", 1.0) * in_samples
        common = float(delays.mean())
        if delays.size > 1 and abs(common) > COMMON * delays.std():
            sizes["common_delay_ms"] = common
            delays = delays - common
        sizes["delays_ms"] = float(np.sqrt(np.mean(delays**2)))
    return sizes


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")


@dataclass(frozen=True, eq=False)
class RecordToRecord:
    """A parameter of the nominal model that varies from record to record, as it was fitted.

    Attributes:
        parameter: "stiffness" or "axial load".
        values: deviation from the common value, by name of record: relative, or a force.
        force: name of the unit of force.
    """

    parameter: str
    values: dict[str, float]
    force: str = "N"

    @classmethod
    def of(cls, rig: Rig, effects: Sequence[Effect]) -> "RecordToRecord | None":
        """The parameter that varies among fitted effects of a nominal rig; None if none varies."""
        errors = next((found for found in (parted(e)[1] for e in effects) if found is not None), None)
        if errors is None:
            return None
        parameter = errors.target.parameter
        unit = buckling_load(rig) if parameter == TENSION else 1.0
        return cls(parameter, {name: unit * value for name, value in deviations_of(errors.values).items()})

    @property
    def label(self) -> str:
        return label_of(self.parameter)

    @property
    def spread(self) -> float:
        """Standard deviation from record to record."""
        return float(np.std(list(self.values.values()), ddof=1))

    @property
    def words(self) -> str:
        """Its spread and extremes: standard deviation 0.8 %: the structure is 1.1 % stiffer in record a than in b."""
        least, most = (pick(self.values, key=lambda name: self.values[name]) for pick in (min, max))
        difference = self._in_unit(self.values[most] - self.values[least])
        what, how = (TENSION, "higher") if self.parameter == TENSION else ("structure", "stiffer")
        extremes = f"the {what} is {difference} {how} in record {most} than in record {least}"
        return f"standard deviation {self._in_unit(self.spread)}: {extremes}"

    def _in_unit(self, size: float) -> str:
        return f"{size:.2g} {self.force}" if self.parameter == TENSION else f"{100.0 * size:.2g} %"

    def to_json(self) -> dict[str, Any]:
        """The parameter, its spread and its deviations as plain numbers: relative, or in the unit of force."""
        by_record = {name: _rounded(value) for name, value in self.values.items()}
        return {"parameter": self.parameter, "std": _rounded(self.spread), "by_record": by_record}


def with_held_out(
    rig: Rig, effects: Sequence[Effect], records: Sequence[Record], *, transient: float = 0.0
) -> tuple[Effect, ...]:
    """The effects, with the deviations of a parameter that varies from record to record fitted to held-out records.

    Each deviation minimises the residual of its record, within `REACH`. It serves the budget; it is no prediction. The
    effects are returned unchanged if no parameter varies.
    """
    errors = next((e for e in effects if parted(e)[1] is not None), None)
    if errors is None:
        return tuple(effects)
    others = [e for e in effects if e is not errors]
    bound, values = REACH * errors.target.record, dict(errors.values)

    def power(deviation: float, record: Record, name: str) -> float:
        own = replace(errors, values={**errors.values, name: deviation})
        return float(residual_powers(rig, (*others, own), [record], transient)[0])

    for record in records:
        name = f"record_{record.name}"
        if name not in values:
            how: Any = {"method": "bounded", "bounds": (-bound, bound), "options": {"xatol": TOLERANCE * bound}}
            values[name] = float(minimize_scalar(power, args=(record, name), **how).x)
    return (*others, replace(errors, values=values))
