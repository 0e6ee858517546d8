"""The size of a gap: how far it shrinks on records kept out of the fit, and its budget, the share of each cause."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.effects.nominal import TENSION, deviations_of, group_of, label_of, parted
from workbench.gap.effects.structural import buckling_load
from workbench.gap.prediction.noise import loudest_logging_noise
from workbench.gap.prediction.residuals import FitData, lead_of
from workbench.gap.search.settings import JOINT
from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.rig.simulate import predict
from workbench.structure.domain import Domain

AT_MOST = 0.99  # of the most that a search takes noise found for
REMARKED = 1.3  # factor between stated and found noise from which on it is remarked
# per cent, root mean square: a quarter to a half more than the worst models of trials have; in false valleys it is more
MOST = (
    ("stiffness", 5.0),
    ("mass", 5.0),
    ("frequency", 2.5),
    ("coupling", 5.0),
    ("damping", 90.0),
    ("gain", 5.0),
    ("place", 1.0),
    ("shape", 10.0),
)
MOSTLY = 0.5  # of the gap: where more is unexplained, errors that were fitted beside it have bent to that
RUNAWAY = 1e30  # mean square of a motion that knows no bounds, in units of the signal's
COMMON = 2.0  # times the scatter of delays: the mean from which on they are reported as one delay of all
DRAWS = 400  # of blocks, for the interval of what is closed
# errors that are reported in per cent, by group, as they are called
PLURAL = {
    "stiffness": "stiffness",
    "mass": "mass",
    "frequency": "frequencies",
    "coupling": "coupling of modes",
    "damping": "damping",
    "gain": "gains",
    "place": "places",
    "shape": "shapes",
}


@dataclass(frozen=True, eq=False)
class Shrinkage:
    """The gap of validation records before and after a correction.

    Attributes:
        before, after, floor: by record name; the gap of the case format.
        share: of the closable gap closed, by record name: 1 - sqrt(after² - floor²) / sqrt(before² - floor²).
        overall: the same over all records together, each of which counts alike.
        ci95: its 95 % interval by block bootstrap.
    """

    before: dict[str, float]
    after: dict[str, float]
    floor: dict[str, float]
    share: dict[str, float]
    overall: float
    ci95: tuple[float, float]


def measure(nominal: Rig, corrected: Rig, records: Sequence[Record], *, settle: float = 0.0) -> Shrinkage | None:
    """Gaps of both rigs on validation records, with the interval from resampled blocks; None without records.

    Blocks are three decay times of the slowest elastic mode long, or a twentieth of a record where that is shorter
    than a tenth of it, so that what is resampled is nearly independent.
    """
    if not records:
        return None
    before, after, floor, blocks, lengths = {}, {}, {}, [], []
    for record in records:
        lead = lead_of(record, settle)
        measured = record.outputs[:, lead:]
        scale = scale_of(measured)
        predicted = [predict(rig, record)[:, lead:] for rig in (nominal, corrected)]
        errors = [((measured - prediction) / scale) ** 2 for prediction in predicted]
        noise = np.array([s.noise_std for s in nominal.sensors])[:, None] / scale
        before[record.name], after[record.name] = (float(np.sqrt(e.mean())) for e in errors)
        floor[record.name] = float(np.sqrt((noise**2).mean()))
        length = block_length(nominal, record)
        for start in range(0, measured.shape[1], length):
            piece = slice(start, start + length)
            blocks.append([errors[0][:, piece].mean(), errors[1][:, piece].mean(), (noise**2).mean()])
            lengths.append(errors[0][:, piece].shape[1] / measured.shape[1])
    table, weights = np.array(blocks), np.array(lengths)  # the last block of a record may be short
    rng = np.random.default_rng(0)

    def closed(chosen: np.ndarray) -> float:
        return _closed(*np.average(table[chosen], axis=0, weights=weights[chosen]))

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
    if before <= floor * 1.01:
        return 0.0
    return float(1.0 - np.sqrt(max(after - floor, 0.0) / (before - floor)))


def block_length(rig: Rig, record: Record) -> int:
    """Samples of a block of a record's residual, as long as it remembers, so that blocks are nearly independent."""
    rates = (rig.modes.zeta * rig.modes.omega)[rig.modes.omega > 0]
    memory = 3.0 / max(rates.min(), 1e-12) / record.sample_time if rates.size else record.n_samples
    return int(np.clip(memory, record.n_samples // 20, max(record.n_samples // 8, 1)))


def scale_of(measured: np.ndarray) -> np.ndarray:
    """What each sensor's readings (n_outputs, n_samples) count by: their standard deviation; 1 at rest."""
    scale = measured.std(axis=1, keepdims=True)
    return np.where(scale > 0, scale, 1.0)


@dataclass(frozen=True, eq=False)
class Budget:
    """Shares of the mean square of the nominal residual, which sum to one.

    Attributes:
        effects: share that each named effect takes away, by label (`labels_of`), in the order in which they count; a
            figure that differs from record to record stands among them, as "stiffness_record_to_record".
        nominal: share that small errors of the nominal model take away beyond them, and that noise of the logged inputs
            leaves.
        unexplained: share that is left and is not noise.
        noise: share of the sensors' noise.
        by_record: the same four shares (n_shares,) of each record by name, effects first.
        errors: root mean squares of the small errors: "frequencies_percent", "inputs_percent", "delays_ms" and so on;
            "common_delay_ms", what all sensors are late by.
        noise_stated, noise_found: (n_outputs,) standard deviation of each sensor's noise, in its unit.
    """

    effects: Mapping[str, float]
    nominal: float
    unexplained: float
    noise: float
    by_record: Mapping[str, np.ndarray] = field(repr=False)
    errors: Mapping[str, float] = field(default_factory=dict)
    noise_stated: tuple[float, ...] = ()
    noise_found: tuple[float, ...] = ()

    @property
    def noise_ratio(self) -> float:
        """Noise found over noise stated, the median of all sensors."""
        return float(np.median(np.array(self.noise_found) / np.array(self.noise_stated)))

    @property
    def is_noise_at_bound(self) -> tuple[bool, ...]:
        """Of each sensor, whether its noise was found as loud as any is taken for, or louder: it may be less."""
        ratios = np.array(self.noise_found) / np.array(self.noise_stated)
        bounds = JOINT.credible, JOINT.credible_guess
        at_one = [np.abs(ratios / bound - 1.0) < 1.0 - AT_MOST for bound in bounds]
        return tuple(bool(at) for at in np.any(at_one, axis=0) | (ratios > max(bounds)))

    @property
    def noise_remark(self) -> str | None:
        """A remark where the noise found and the noise stated disagree."""
        ratio = self.noise_ratio
        if 1.0 / REMARKED < ratio < REMARKED:
            return None
        if ratio > AT_MOST * JOINT.credible:
            return (
                f"What is left is {ratio:.2g} times the stated noise_std or more: louder noise, or errors of the model"
                " that no effect and no small error describes."
            )
        if self.leaves_more_than_noise:
            return f"What looks like noise is {ratio:.2g} times the stated noise_std; part of it may be of the model."
        return f"The noise of the sensors is {ratio:.2g} times the stated noise_std."

    @property
    def leaves_more_than_noise(self) -> bool:
        """Whether more is unexplained than noise."""
        return self.unexplained > self.noise > 0.0

    @property
    def is_open(self) -> bool:
        """Whether most of the gap is unexplained."""
        return self.unexplained > MOSTLY

    @property
    def errors_are_small(self) -> bool:
        """Whether a careful laboratory could have a nominal model with these errors."""
        return are_small(self.errors)

    def to_json(self) -> dict[str, Any]:
        """Plain numbers, as the case format asks for them: effects by kind."""
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
    settle: float = 0.0,
) -> Budget:
    """Take the mean square of the nominal residual apart.

    Each sensor counts by the standard deviation of its readings, as in the gap of a record. What effects and errors of
    the nominal model take away together is shared in proportion to what is left without each of them alone; causes
    that partly cancel one another would else take away nothing, or less.

    Args:
        rig: nominal.
        effects: that were named.
        errors: of the nominal model, where they were fitted; see `with_held_out` for what differs by record.
        records: held out of the fit, or those fitted where none were.
        noise_found: (n_outputs,).
        logged: noise of the logged inputs, as a share of their rms.
        settle: seconds at the start of each record that do not count.
    """

    def squares(chosen: Sequence[Effect]) -> np.ndarray:
        """Mean square (n_records,) of what is left with these effects."""
        return np.array([left_with(rig, chosen, record, settle) for record in records])

    labels, causes = labels_of(effects, rig.modes.domain), list(effects)
    alike, between = (None, None) if errors is None else parted(errors)
    if between is not None:
        labels.append(label_of(between.target.figure))
        causes.append(between)
    causes += [] if alike is None else [alike]
    nominal, left = squares(()), squares(causes)
    without = [squares([c for c in causes if c is not cause]) for cause in causes]
    weights = np.array([np.maximum(w - left, 0.0) for w in without]).reshape(len(causes), len(records))
    total = weights.sum(axis=0)
    taken = np.maximum(nominal - left, 0.0) * weights / np.where(total > 0, total, 1.0)
    by_size = sorted(range(len(labels)), key=lambda i: -taken[i].sum())
    rows = [*taken[by_size], taken[-1] if alike is not None else np.zeros_like(left)]
    noise = np.minimum(np.array([noise_power(record, noise_found, settle) for record in records]), left)
    rest = left - noise
    by_inputs = np.zeros_like(left)
    if logged:
        by_inputs = np.minimum(logged**2 * power_of_inputs(rig, records, settle), rest)
    rows[-1], rest = rows[-1] + by_inputs, rest - by_inputs
    for row, i in enumerate(by_size):  # what no model can predict is theirs
        if causes[i].kind.unpredictable:
            rows[row], rest = rows[row] + rest, np.zeros_like(rest)
    shares = np.array([*rows, rest, noise])
    whole = shares.sum(axis=1).clip(0.0) / max(nominal.sum(), 1e-300)
    whole = whole / max(whole.sum(), 1e-300)
    by_record = {r.name: shares[:, i] / max(nominal[i], 1e-300) for i, r in enumerate(records)}
    return Budget(
        effects={labels[i]: float(share) for i, share in zip(by_size, whole, strict=False)},
        nominal=float(whole[-3]),
        unexplained=float(whole[-2]),
        noise=float(whole[-1]),
        by_record=by_record,
        errors={**sizes_of(alike), **({"inputs_percent": 100.0 * logged} if by_inputs.sum() > 0 else {})},
        noise_stated=tuple(float(s.noise_std) for s in rig.sensors),
        noise_found=tuple(noise_found.tolist()),
    )


def labels_of(effects: Sequence[Effect], domain: Domain) -> list[str]:
    """What each effect is called in a budget; those of one kind, which differ in their places alone, by these too."""
    labels = [effect.label for effect in effects]
    return [
        f"{label}[{domain.text(effect.at)}]" if labels.count(label) > 1 and effect.at is not None else label
        for effect, label in zip(effects, labels, strict=True)
    ]


def left_with(rig: Rig, effects: Sequence[Effect], record: Record, settle: float) -> float:
    """Mean square of what a rig with effects leaves of a record; without bounds of one that cannot be."""
    try:
        corrected = apply_all(rig, effects)
    except (ValueError, np.linalg.LinAlgError):
        return RUNAWAY
    return mean_square(corrected, record, settle)


def mean_square(rig: Rig, record: Record, settle: float) -> float:
    """Mean square of what a rig leaves of a record, each sensor by the standard deviation of its readings."""
    with np.errstate(over="ignore", invalid="ignore"):  # one effect of two that balance each other may run away
        left = power_in(record, record.outputs - predict(rig, record), settle)
    return left if left < RUNAWAY else RUNAWAY


def power_in(record: Record, readings: np.ndarray, settle: float) -> float:
    """Mean square of readings (n_outputs, n_samples), each sensor by the standard deviation of a record's."""
    lead = lead_of(record, settle)
    return float(((readings[:, lead:] / scale_of(record.outputs[:, lead:])) ** 2).mean())


def noise_power(record: Record, noise: np.ndarray, settle: float) -> float:
    """Mean square of noise (n_outputs,), each sensor by the standard deviation of a record's readings."""
    measured = record.outputs[:, lead_of(record, settle) :]
    return float(((noise[:, None] / scale_of(measured)) ** 2).mean())


def power_of_inputs(rig: Rig, records: Sequence[Record], settle: float) -> np.ndarray:
    """Mean square (n_records,) that noise of the logged inputs leaves by chance, were it as strong as they are."""
    powers = loudest_logging_noise(rig, FitData(tuple(records), np.ones(len(rig.sensors)), settle=settle))
    scales = np.array([scale_of(record.outputs[:, lead_of(record, settle) :])[:, 0] for record in records])
    return np.asarray((powers / scales**2).mean(axis=1))


def are_small(sizes: Mapping[str, float]) -> bool:
    """Whether a careful laboratory could have a nominal model with errors of these sizes; see `sizes_of`."""
    return all(sizes.get(f"{PLURAL[group]}_percent", 0.0) < most for group, most in MOST)


def sizes_of(errors: Effect | None) -> dict[str, float]:
    """Root mean squares of the errors of a nominal model, by group, and what delays have in common, ms.

    Sensors that are all late, and actuators that are, read alike in open loop.
    """
    if errors is None:
        return {}
    values = {group: [v for n, v in errors.values.items() if group_of(n) == group] for group in (*PLURAL, "delay")}
    sizes = {
        f"{words}_percent": 100.0 * float(np.sqrt(np.mean(np.square(values[group]))))
        for group, words in PLURAL.items()
        if values[group]
    }
    if values["delay"]:
        sample_time = getattr(errors.target, "sample_time", 1.0)
        delays = 1e3 * sample_time * np.array(values["delay"])
        common = float(delays.mean())
        if delays.size > 1 and abs(common) > COMMON * delays.std():
            sizes["common_delay_ms"] = common
            delays = delays - common
        sizes["delays_ms"] = float(np.sqrt(np.mean(delays**2)))
    return sizes


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")


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
            return left_with(rig, (*others, own), record, settle)

        found = minimize_scalar(left, bounds=(-reach, reach), method="bounded", options={"xatol": SURELY * reach})
        values[name] = float(found.x)
    return (*others, replace(errors, values=values))
