"""Faults of the test set-up, looked for before any effect: of wiring, of units and of bookkeeping.

A fault is believed where its correction takes nearly all of the gap away on the channels that it concerns. Physics gone
astray does not do that: no missing effect turns a sign, multiplies by 1000, or exchanges two channels. Beside a missing
effect a turned sign is believed of a sensor that reads every mode turned, while others read them as predicted.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import combinations

import numpy as np

from workbench.arrays import Flags, Floats
from workbench.gap.localisation.where import mode_bands
from workbench.gap.prediction.residuals import lead_of
from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.rig.simulate import is_stepped, predict
from workbench.structure.damping import ModalDamping

Corrected = tuple[Rig, tuple[Record, ...]]
Correction = Callable[[Rig, Sequence[Record]], Corrected]

WIDE_GAP = (
    0.3  # root mean square per standard deviation of a channel from which it may be connected wrongly: a turned sign
)
# leaves 2, an exchange about 1.4, a factor of 2π at least 0.84
LEFT = 0.15  # share of a channel's measured power that may remain beyond the noise: a prediction of nothing leaves all
CLOSED = 0.9  # share of the closable power that a correction must take away, on the channels that it concerns
ALIKE = 0.7  # correlation with the prediction of a sensor that reads as predicted beside an effect; less it, turned
MODE_TURNED = (
    -0.5
)  # correlation in the band of one mode; a sensor beyond a node reads some modes turned, at 0.9 or more
OF_MODE = 1e-3  # of a sensor's power: a mode with less is not asked
NEAR = 0.15  # relative error of a gain that still is that factor: the least ratio of two of them is 1.56
MOST_CHANNELS = 12  # pairs of inputs are simulated one by one: beyond, only neighbours are
MOST_ROUNDS = 4  # faults that hide one another are found one after the other
GAIN_TAKES = 0.5  # share of what a factor leaves beyond the noise that a gain near it takes away: it is no unit then
CALIBRATED = 1e-3  # relative: a gain nearer to a factor is that factor (9.81 for 9.80665 is 3.4e-4)
GAIN_CHI2 = 25.0  # and five standard deviations of the gain, in noise that is white
PER_CENT_FROM = 0.05  # damping ratio above which a structure is asked whether per cent was meant
G, TURN = 9.80665, 2.0 * np.pi
MAY_BE_GAIN = (G, 1.0 / G, TURN, 1.0 / TURN)  # the other factors are further from one than errors of calibration

# measured / predicted: what an output does that reads so, and what an input does that is logged so as to give it
FACTORS = {
    -1.0: ("have the wrong sign", "have the wrong sign"),
    1.0 / G: ("are 9.81 times too small", "are 9.81 times too large"),
    G: ("are 9.81 times too large", "are 9.81 times too small, such as kgf for N"),
    1e3: ("are 1000 times too large, such as mm for m", "are 1000 times too small, such as kN for N"),
    1e-3: ("are 1000 times too small, such as km for m", "are 1000 times too large, such as mN for N"),
    1e6: ("are a million times too large, such as μm for m", "are a million times too small"),
    1e2: ("are 100 times too large, such as cm for m", "are 100 times too small"),
    1e-2: ("are 100 times too small", "are 100 times too large, such as per cent"),
    TURN: ("are 2π times too large", "are 2π times too small"),
    1.0 / TURN: ("are 2π times too small, such as Hz for rad/s", "are 2π times too large"),
}
IN_G = "look like g where m/s² is meant"
RATES = {2.0: "twice", 0.5: "half", 1e3: "1000 times", 1e-3: "a thousandth of"}
QUANTITIES = ("displacement", "velocity", "acceleration")
OF_CHANNELS = ("exchanged inputs", "exchanged outputs", "sign", "unit")  # kinds that a record may have or not
WORST = 1e12  # times the measured power: a prediction that leaves more is of no use


@dataclass(frozen=True, eq=False)
class SetupFault:
    """A fault of the test set-up: of wiring, units or bookkeeping.

    Attributes:
        kind: "exchanged inputs", "exchanged outputs", "sign", "unit", "quantity", "sample rate", "damping",
            "frequency", "copied channel" or "repeated record".
        sentence: what is wrong, and the correction.
        closes: share of the closable power of the gap that the correction takes away on the channels that it concerns;
            nan where no prediction was needed to see the fault.
        correction: (rig, records) -> (rig, records) without the fault.
        records: names of those that show it and are corrected; empty where the rig, or a channel of every record, is.
        certain: False for a factor that may be one of units, where a gain near it explains far more: an error of
            calibration is likelier. It is said and not corrected.
    """

    kind: str
    sentence: str
    closes: float
    correction: Correction
    certain: bool = True
    records: tuple[str, ...] = ()


def setup_faults(
    rig: Rig, records: Sequence[Record], validation: Sequence[Record] = (), *, settle: float = 0.0
) -> tuple[SetupFault, ...]:
    """The faults of the test set-up that the records show against the nominal rig, in the order to correct them.

    Each record is judged by itself: by each fault of all fit records, then by faults that it alone has.

    Args:
        rig: nominal.
        records: with the rig's inputs and outputs, in its order.
        validation: likewise, kept out of every fit.
        settle: seconds at the start of each record that are not compared.

    Raises:
        ValueError: two records of one name.
    """
    check_names((*records, *validation))
    found = [*_repeated(records), *_copied(rig, records)]
    seen_rig, seen = without_faults(found, rig, records)
    found += _by_rounds(seen_rig, seen, settle, WAYS)
    fit, held = tuple(records), tuple(validation)
    for i, fault in enumerate(found):
        if fault.kind in OF_CHANNELS and fault.certain:
            found[i] = fault = _judged_on((*fit, *held), fault, rig, settle)
        (_, fit), (rig, held) = [without_faults([fault], rig, these) for these in (fit, held)]
    alone = [("record", record) for record in fit if len(fit) > 1]
    for what, record in (*alone, *(("validation record", record) for record in held)):
        of_it = _by_rounds(rig, (record,), settle, WAYS_OF_ONE)
        found += [_of_one(what, record, fault) for fault in of_it if fault.certain]
    return tuple(found)


def without_faults(faults: Iterable[SetupFault], rig: Rig, records: Sequence[Record]) -> tuple[Rig, tuple[Record, ...]]:
    """The rig without the faults that are certain, and the records without those that they show."""
    kept = tuple(records)
    for fault in faults:
        if fault.certain:
            each = [
                (r,) if fault.records and r.name not in fault.records else fault.correction(rig, (r,))[1] for r in kept
            ]
            kept = tuple(record for one in each for record in one)
            rig, _ = fault.correction(rig, ())
    return rig, kept


def _by_rounds(
    rig: Rig, records: Sequence[Record], settle: float, ways: "Sequence[Callable[[_Gap], list[SetupFault]]]"
) -> list[SetupFault]:
    """Faults that hide one another, one kind after the other."""
    found: list[SetupFault] = []
    for _ in range(MOST_ROUNDS):
        faults = _best(rig, records, settle, ways)
        found += faults
        if not any(fault.certain for fault in faults):
            break
        rig, records = without_faults(faults, rig, records)
    return found


def _judged_on(records: Sequence[Record], fault: SetupFault, rig: Rig, settle: float) -> SetupFault:
    """A fault of all fit records, without those records that agree worse with the model by its correction.

    What is silent in a record, or decayed there, says nothing of it.
    """

    def left(of: Rig, these: Sequence[Record]) -> float:
        return float(np.minimum(_Gap.of(of, these, settle).before, WORST).sum())

    others = [r.name for r in records if left(*fault.correction(rig, (r,))) > left(rig, (r,)) + WIDE_GAP**2]
    sentence = f"{fault.sentence[:-1]}; not in {', '.join(others)}." if others else fault.sentence
    return replace(fault, sentence=sentence, records=tuple(r.name for r in records if r.name not in others))


def _of_one(what: str, record: Record, fault: SetupFault) -> SetupFault:
    """A fault of one record alone: the rig stays as it is."""
    words = fault.sentence
    if fault.kind != "sample rate":  # that names its record
        words = f"In {what} {record.name}, {words[0].lower()}{words[1:]}"
    return replace(fault, sentence=words, records=(record.name,), correction=partial(_records_alone, fault.correction))


def check_names(records: Sequence[Record]) -> None:
    """Refuse records of one name: what is found in each is known by it.

    Raises:
        ValueError: naming it.
    """
    names = [record.name for record in records]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(
                f"{names.count(name)} records are called {name!r}, and results are by record: give each a name of its"
                " own, such as replace(record, name=...)"
            )


def check_disjoint(records: Sequence[Record], validation: Sequence[Record]) -> None:
    """Refuse validation records that repeat a record to be fitted.

    Raises:
        ValueError: naming both.
    """
    for kept in validation:
        for record in records:
            if _same(kept, record):
                raise ValueError(
                    f"validation record {kept.name!r} repeats the fit record {record.name!r}, so it validates"
                    " nothing; keep another record for validation, or none"
                )


# --- seen without a model


def _same(one: Record, other: Record) -> bool:
    """Whether one record repeats the other, or its beginning."""
    n = min(one.n_samples, other.n_samples)
    if n < 2 or one.outputs.shape[0] != other.outputs.shape[0] or one.n_inputs != other.n_inputs:
        return False
    moves = bool(np.ptp(one.outputs[:, :n], axis=1).any())
    return moves and all(
        np.array_equal(getattr(one, part)[:, :n], getattr(other, part)[:, :n]) for part in ("outputs", "inputs")
    )


def _repeated(records: Sequence[Record]) -> list[SetupFault]:
    faults, again = [], set()
    for i, j in combinations(range(len(records)), 2):
        if j not in again and i not in again and _same(records[i], records[j]):
            again.add(j)
            first, second = records[i].name, records[j].name
            faults.append(
                SetupFault(
                    "repeated record",
                    f"The records {first} and {second} hold the same samples: leave {second} out.",
                    np.nan,
                    partial(_without_record, second),
                )
            )
    return faults


def _copied(rig: Rig, records: Sequence[Record]) -> list[SetupFault]:
    """Outputs with the same samples: noise differs from sensor to sensor, so one is a copy."""
    faults: list[SetupFault] = []
    gone: set[int] = set()
    for i, j in combinations(range(len(rig.sensors)), 2):
        one, other = rig.sensors[i], rig.sensors[j]
        alike = (one.at, one.quantity) == (other.at, other.quantity) and not one.noise_std + other.noise_std
        same = all(np.array_equal(r.outputs[i], r.outputs[j]) for r in records)
        if not same or alike or {i, j} & gone or not any(np.ptp(r.outputs[i]) for r in records):
            continue
        errors = [np.zeros(2)]
        for record in records:
            predicted = _predict(rig, record)
            errors.append(np.array([((record.outputs[k] - predicted[k]) ** 2).mean() for k in (i, j)]))
        of_one, of_other = np.sum(errors, axis=0)
        copy = j if of_one <= of_other else i
        gone.add(copy)
        kept = i + j - copy
        faults.append(
            SetupFault(
                "copied channel",
                f"The outputs {one.name} and {other.name} hold the same samples, and the model agrees better with"
                f" {rig.sensors[kept].name}: measure {rig.sensors[copy].name} again, or leave it out.",
                np.nan,
                partial(_without_output, rig.sensors[copy].name),
            )
        )
    return faults


# --- seen against the model


@dataclass(frozen=True, eq=False)
class _Gap:
    """Measured beside predicted, by output; power is in units of the noise where that is larger than a thousandth."""

    rig: Rig
    records: Sequence[Record]
    predicted: Sequence[Floats]
    measured: list[np.ndarray]
    noise: np.ndarray
    scale: np.ndarray
    settle: float

    @staticmethod
    def of(
        rig: Rig, records: Sequence[Record], settle: float = 0.0, predicted: Sequence[Floats] | None = None
    ) -> "_Gap":
        measured = [record.outputs[:, lead_of(record, settle) :] for record in records]
        if predicted is None:
            predicted = _counted(measured, [_predict(rig, record) for record in records])
        power = sum((y**2).sum(axis=1) for y in measured) / sum(y.shape[1] for y in measured)
        scale = np.where(power > 0, power, 1.0)
        noise = np.array([s.noise_std for s in rig.sensors]) ** 2 / scale
        return _Gap(rig, records, predicted, measured, noise, scale, settle)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the records."""
        return tuple(record.name for record in self.records)

    @cached_property
    def before(self) -> Floats:
        """(n_outputs,) power that the rig leaves as it is."""
        return self.power(self.predicted)

    @property
    def wide(self) -> Flags:
        """(n_outputs,) where that is too much for an effect; a channel that never moves shows no connection."""
        moves = np.any([np.ptp(y, axis=1) > 0 for y in self.measured], axis=0)
        return np.asarray(moves & (self.before > np.maximum(WIDE_GAP**2, 4.0 * self.noise)))

    def predict(self, rig: Rig, records: Sequence[Record]) -> list[Floats]:
        """What another rig reads on other records, (n_outputs, n_samples) each, at the samples that are compared."""
        return _counted(self.measured, [_predict(rig, record) for record in records])

    def power(self, predicted: Sequence[Floats]) -> Floats:
        """(n_outputs,) mean square of what is left, as a share of the mean square measured."""
        count = sum(y.shape[1] for y in self.measured)
        with np.errstate(over="ignore", invalid="ignore"):
            left = sum(((y - p) ** 2).sum(axis=1) for y, p in zip(self.measured, predicted, strict=True))
        return np.asarray(np.nan_to_num(left / count / self.scale, nan=np.inf))

    def closed(self, after: np.ndarray) -> np.ndarray:
        """(n_outputs,) share of the power beyond the noise that is gone; 0 where much of the signal is still missed."""
        left = np.maximum(after - self.noise, 0.0)
        return np.where(left > LEFT, 0.0, 1.0 - left / np.maximum(self.before - self.noise, 1e-300))

    def closes(self, rig: Rig, records: Sequence[Record]) -> float:
        """The share that another rig and other records close, in the median of the channels with a wide gap."""
        after = self.power(self.predict(rig, records))
        return float(np.median(self.closed(after)[self.wide]))


def _counted(measured: Sequence[Floats], predicted: Sequence[Floats]) -> list[Floats]:
    """The end of each prediction that is as long as what is compared of its record."""
    return [p[:, p.shape[1] - y.shape[1] :] for y, p in zip(measured, predicted, strict=True)]


def _best(
    rig: Rig, records: Sequence[Record], settle: float, ways: Sequence[Callable[[_Gap], list[SetupFault]]]
) -> list[SetupFault]:
    """The faults of the kind that closes most, doubtful ones where none is certain; none where none closes most."""
    gap = _Gap.of(rig, records, settle)
    # a record at a low level may be sampled wrongly and yet leave no wide gap over all records
    found = [way(gap) for way in (ways if gap.wide.any() else (_rates,))]
    doubtful = [fault for faults in found for fault in faults if not fault.certain]
    found = [faults for faults in ([f for f in faults if f.certain] for faults in found) if faults]
    if not found:
        return doubtful
    return found[0] if len(found) == 1 else max(found, key=lambda faults: _overall(faults, gap), default=[])


def _overall(faults: Sequence[SetupFault], gap: _Gap) -> float:
    """Minus the share of the measured power that remains with the corrections."""
    rig, kept = without_faults(faults, gap.rig, gap.records)
    return -float(np.minimum(_Gap.of(rig, kept, gap.settle).before, 1.0).mean())


def _scaled_outputs(gap: _Gap) -> list[SetupFault]:
    """Outputs that read a known factor times what is predicted."""
    rig = gap.rig
    over = sum((p**2).sum(axis=1) for p in gap.predicted)
    along = sum((y * p).sum(axis=1) for y, p in zip(gap.measured, gap.predicted, strict=True))
    gains = np.divide(along, over, out=np.ones_like(over), where=over > 0)
    freely = gap.power([gains[:, None] * p for p in gap.predicted])
    n_samples = sum(y.shape[1] for y in gap.measured)
    factors: dict[tuple[float, bool], list[int]] = {}
    turned = _turned(gap)
    for j in np.flatnonzero(gap.wide):
        factor = _factor(float(gains[j]))
        if turned[j]:
            factors.setdefault((-1.0, True), []).append(int(j))
        elif factor is not None:
            left = gap.power([factor * p for p in gap.predicted])
            if gap.closed(left)[j] >= CLOSED:
                certain = not _is_gain(
                    float(gains[j]),
                    factor,
                    n_samples * left[j],
                    n_samples * freely[j],
                    n_samples * gap.noise[j],
                    n_samples,
                )
                factors.setdefault((factor, certain), []).append(int(j))
    faults = []
    for (factor, certain), outputs in factors.items():
        names = [rig.sensors[j].name for j in outputs]
        after = np.maximum(gap.power([factor * p for p in gap.predicted]) - gap.noise, 0.0)
        closes = float((1.0 - after / (gap.before - gap.noise))[outputs].min())
        every = len(outputs) == len(rig.sensors)
        what, of_inputs = FACTORS[factor]
        if factor == 1.0 / G and {rig.sensors[j].quantity for j in outputs} == {"acceleration"}:
            what = IN_G
        who = "All outputs" if every and len(names) > 1 else _named("output", names)
        rest = f", or all inputs {of_inputs}" if every else ""
        cure = "multiply by -1" if factor == -1.0 else f"multiply by {1.0 / factor:.6g}"
        kind = "sign" if factor == -1.0 else "unit"
        sentence = f"{_one(f'{who} {what}', names)}{rest}: {cure}{' (the outputs)' if rest else ''}."
        if not certain:
            sentence = _doubtful(f"{who} {what}{rest}", gains[outputs] / factor - 1.0)
        correction = partial(_outputs_times, dict.fromkeys(names, 1.0 / factor))
        faults.append(SetupFault(kind, sentence, closes, correction, certain, gap.names))
    return faults


def _turned(gap: _Gap) -> Flags:
    """(n_outputs,) whether an output reads every mode with the wrong sign in every record, and as many others do not.

    A resonance that is off in phase is so for every sensor, and a sensor at another place keeps the sign of some modes.
    """
    edges = mode_bands(gap.rig.modes.frequencies_hz)
    n_bands = 1 + np.count_nonzero(gap.rig.modes.omega)  # above the last mode's there is none to ask
    sound, turned = np.ones((2, len(gap.rig.sensors)), bool)
    several = ~turned
    for record, y, p in zip(gap.records, gap.measured, gap.predicted, strict=True):
        if not np.isfinite(p).all():
            return np.zeros_like(turned)
        window = np.hanning(y.shape[1])
        of_y, of_p = (np.fft.rfft((a - a.mean(axis=1, keepdims=True)) * window) for a in (y, p))
        band = np.digitize(np.fft.rfftfreq(y.shape[1], record.sample_time), edges) - 1
        # (3, n_outputs, n_bands) of measured, predicted and both
        products = (of_y * of_y.conj()).real, (of_p * of_p.conj()).real, (of_y * of_p.conj()).real
        powers = np.array([[np.bincount(band, row, edges.size)[:n_bands] for row in product] for product in products])
        measured, predicted, both = powers
        alike = both / np.sqrt(np.maximum(measured * predicted, 1e-300))
        over_all = both.sum(axis=1) / np.sqrt(np.maximum(measured.sum(axis=1) * predicted.sum(axis=1), 1e-300))
        asked = measured > OF_MODE * measured.sum(axis=1, keepdims=True)
        sound &= over_all > ALIKE
        turned &= (over_all < -ALIKE) & (~asked | (alike < MODE_TURNED)).all(axis=1)
        several |= asked.sum(axis=1) > 1
    turned &= several
    return np.asarray(turned & (sound.sum() >= turned.sum()))


def _is_gain(gain: float, factor: float, left: float, freely: float, noise: float, n_samples: int) -> bool:
    """Whether a gain is near a factor of units by chance: it differs beyond its error, and explains far more.

    Args:
        left, freely, noise: sums of squares that the factor leaves, that the gain leaves, and of the noise.
    """
    if factor not in MAY_BE_GAIN or abs(gain / factor - 1.0) < CALIBRATED:
        return False
    taken = left - freely
    return bool(taken > GAIN_TAKES * (left - noise) and taken * n_samples > GAIN_CHI2 * freely)


def _doubtful(what: str, off: Floats) -> str:
    """What may be a fault of units, and by how much it is none; off: relative differences of the gains."""
    may = what.replace(" look ", " may look ", 1).replace(" are ", " may be ", 1)
    far = ", ".join(dict.fromkeys(f"{100 * share:+.2g} %" for share in off))
    return f"{may}; but the gain differs from that by {far}, more than its error: taken for an error of calibration."


def _factor(gain: float) -> float | None:
    """The factor of `FACTORS` that a gain is near to; None for any other."""
    near = [factor for factor in FACTORS if gain * factor > 0 and abs(gain / factor - 1.0) < NEAR]
    return min(near, key=lambda factor: abs(gain / factor - 1.0), default=None)


def _exchanged_outputs(gap: _Gap) -> list[SetupFault]:
    rig = gap.rig
    for i, j in combinations(np.flatnonzero(gap.wide), 2):
        order = np.arange(len(rig.sensors))
        order[[i, j]] = j, i
        after = gap.power([p[order] for p in gap.predicted])
        closes = float(gap.closed(after)[[i, j]].min())
        if closes >= CLOSED:
            one, other = rig.sensors[i].name, rig.sensors[j].name
            sentence = f"The outputs {one} and {other} are exchanged: swap them."
            correction = partial(_exchanged, "outputs", one, other)
            return [SetupFault("exchanged outputs", sentence, closes, correction, records=gap.names)]
    return []


def _exchanged_inputs(gap: _Gap) -> list[SetupFault]:
    rig, records = gap.rig, gap.records
    found: list[SetupFault] = []
    n = len(rig.actuators)
    for i, j in combinations(range(n), 2):
        if n > MOST_CHANNELS and j != i + 1:
            continue
        one, other = rig.actuators[i].name, rig.actuators[j].name
        correction = partial(_exchanged, "inputs", one, other)
        closes = gap.closes(*correction(rig, records))
        if closes >= CLOSED:
            sentence = f"The inputs {one} and {other} are exchanged: swap them."
            found.append(SetupFault("exchanged inputs", sentence, closes, correction, records=gap.names))
    return sorted(found, key=lambda fault: -fault.closes)[:1]


def _scaled_inputs(gap: _Gap) -> list[SetupFault]:
    """Inputs that a linear rig would need a known factor larger or smaller, by least squares on their responses."""
    rig, records = gap.rig, gap.records
    n = len(rig.actuators)
    if n < 2 or n > MOST_CHANNELS or is_stepped(rig):
        return []
    weights = 1.0 / np.sqrt(gap.scale)[:, None]
    responses = []
    for p in range(n):
        alone = [r.inputs * (np.arange(n) == p)[:, None] for r in records]
        parts = gap.predict(rig, [replace(r, inputs=u) for u, r in zip(alone, records, strict=True)])
        responses.append(np.concatenate([(weights * part).ravel() for part in parts]))
    matrix = np.array(responses).T
    sizes = np.linalg.norm(matrix, axis=0)
    acting = np.flatnonzero(sizes > 1e-9 * sizes.max())
    if acting.size < 2 or not np.isfinite(matrix).all():
        return []
    target = np.concatenate([(weights * y).ravel() for y in gap.measured])
    gains = np.ones(n)
    gains[acting] = np.linalg.lstsq(matrix[:, acting] / sizes[acting], target, rcond=1e-6)[0] / sizes[acting]
    known = {p: _factor(gains[p]) for p in acting}
    if any(known[p] is None and abs(gains[p] - 1.0) > NEAR for p in acting):
        return []
    wrong = {p: factor for p, factor in known.items() if factor is not None}
    if not wrong or (len(wrong) == acting.size and len(set(wrong.values())) == 1):
        return []
    correction = partial(_inputs_times, {rig.actuators[p].name: factor for p, factor in wrong.items()})
    closes = gap.closes(*correction(rig, records))
    if closes < CLOSED:
        return []
    freely, noise = _squares(target - matrix @ gains), float(gap.noise.sum()) * target.size / gap.noise.size
    faults = []
    for factor in dict.fromkeys(wrong.values()):
        inputs = [p for p in wrong if wrong[p] == factor]
        names = [rig.actuators[p].name for p in inputs]
        stiffly = gains.copy()
        stiffly[inputs] = factor
        left = _squares(target - matrix @ stiffly)
        certain = not all(_is_gain(gains[p], factor, left, freely, noise, target.size) for p in inputs)
        what = f"{_named('input', names)} {FACTORS[factor][1]}"
        sentence = f"{_one(what, names)}: multiply by {factor:.6g}."
        if not certain:
            sentence = _doubtful(what, gains[inputs] / factor - 1.0)
        kind = "sign" if factor == -1.0 else "unit"
        own = partial(_inputs_times, dict.fromkeys(names, factor))
        faults.append(SetupFault(kind, sentence, closes, own, certain, gap.names))
    return faults


def _squares(values: Floats) -> float:
    return float(values @ values)


def _quantities(gap: _Gap) -> list[SetupFault]:
    """Outputs that are another time derivative of the motion than their label says."""
    rig, records = gap.rig, gap.records
    meant: dict[tuple[str, str], list[int]] = {}
    for quantity in QUANTITIES:
        here = [j for j in np.flatnonzero(gap.wide) if rig.sensors[j].quantity in set(QUANTITIES) - {quantity}]
        if not here:
            continue
        every = {rig.sensors[j].name for j in here}
        closed = gap.closed(gap.power(gap.predict(_relabelled(rig, every, quantity), records)))
        for j in here:
            if closed[j] >= CLOSED:
                meant.setdefault((rig.sensors[j].quantity, quantity), []).append(int(j))
    faults = []
    for (said, quantity), outputs in meant.items():
        names = [rig.sensors[j].name for j in outputs]
        closed = gap.closed(gap.power(gap.predict(_relabelled(rig, names, quantity), records)))
        what = _one(f"{_named('output', names)} are {quantity}, not {said}", names)
        sentence = f'{what}: state the quantity "{quantity}".'
        correction = partial(_quantity_set, frozenset(names), quantity)
        faults.append(SetupFault("quantity", sentence, float(closed[outputs].min()), correction))
    return faults


def _rates(gap: _Gap) -> list[SetupFault]:
    """Records sampled at another rate than they are said to be."""
    rig, records = gap.rig, gap.records
    wrong: dict[float, list[int]] = {}
    for i, record in enumerate(records):
        own = _Gap.of(rig, [record], gap.settle, [gap.predicted[i]])
        if not own.wide.any():
            continue
        others = {factor: replace(record, sample_time=record.sample_time / factor) for factor in RATES}
        shares = {
            factor: own.closes(rig, [other])
            for factor, other in others.items()
            if 2 * lead_of(other, gap.settle) < other.n_samples  # else next to nothing would be left to compare
        }
        best = max(shares, key=lambda factor: shares[factor], default=None)
        if best is not None and shares[best] >= CLOSED:
            wrong.setdefault(best, []).append(i)
    faults = []
    for factor, at in wrong.items():
        names = [records[i].name for i in at]
        times = ", ".join(dict.fromkeys(f"{records[i].sample_time / factor:.6g}" for i in at))
        what = _one(f"{_named('record', names)} are sampled at {RATES[factor]} the stated rate", names)
        sentence = f"{what}: state sample_time = {times} s."
        correction = partial(_rate_times, factor)
        whole = gap.closes(*correction(rig, records)) if len(at) == len(records) else np.nan
        faults.append(SetupFault("sample rate", sentence, whole, correction, records=tuple(names)))
    return faults


def _structure(gap: _Gap) -> list[SetupFault]:
    """Damping in per cent, frequencies in rad/s for Hz and the other way about."""
    rig, records = gap.rig, gap.records
    tries: list[tuple[str, str, Correction]] = []
    zeta = float(rig.modes.zeta.max(initial=0.0))
    if zeta > PER_CENT_FROM and (rig.structure is None or isinstance(rig.structure.damping, ModalDamping)):
        sentence = (
            f"The damping looks like per cent where a ratio is meant: divide it by 100 (the largest would be"
            f" {zeta / 100:.4g}, not {zeta:.4g})."
        )
        tries.append(("damping", sentence, partial(_modes_times, 1.0, 0.01)))
    if rig.structure is None:
        for factor, words in ((TURN, "Hz where rad/s is"), (1.0 / TURN, "rad/s where Hz is")):
            sentence = f"The natural frequencies look like {words} meant: multiply them by {factor:.6g}."
            tries.append(("frequency", sentence, partial(_modes_times, factor, 1.0)))
    found = [
        SetupFault(kind, sentence, gap.closes(*correction(rig, records)), correction)
        for kind, sentence, correction in tries
    ]
    found = [fault for fault in found if fault.closes >= CLOSED]
    return sorted(found, key=lambda fault: -fault.closes)[:1]


def _predict(rig: Rig, record: Record) -> np.ndarray:
    with np.errstate(over="ignore", invalid="ignore"):
        return predict(rig, record)


def _named(what: str, names: Sequence[str]) -> str:
    """Such as: The outputs y1, y2 and y3."""
    if len(names) == 1:
        return f"The {what} {names[0]}"
    return f"The {what}s {', '.join(names[:-1])} and {names[-1]}"


def _one(sentence: str, names: Sequence[str]) -> str:
    """The sentence with its first verb in the singular where one thing is spoken of."""
    if len(names) > 1:
        return sentence
    for many, single in ((" are ", " is "), (" have ", " has "), (" look ", " looks ")):
        if many in sentence:
            return sentence.replace(many, single, 1)
    return sentence


WAYS_OF_ONE = (_scaled_outputs, _exchanged_outputs, _exchanged_inputs, _scaled_inputs, _rates)  # a record by itself
WAYS = (*WAYS_OF_ONE[:-1], _quantities, _rates, _structure)


# --- corrections: of (rig, records), once all before these is given


def _records_alone(correction: Correction, rig: Rig, records: Sequence[Record]) -> Corrected:
    """The rig as it is."""
    return rig, correction(rig, records)[1]


def _without_record(name: str, rig: Rig, records: Sequence[Record]) -> Corrected:
    return rig, tuple(record for record in records if record.name != name)


def _without_output(name: str, rig: Rig, records: Sequence[Record]) -> Corrected:
    sensors = tuple(sensor for sensor in rig.sensors if sensor.name != name)
    return replace(rig, sensors=sensors), tuple(r.select_outputs([s.name for s in sensors]) for r in records)


def _outputs_times(factors: dict[str, float], rig: Rig, records: Sequence[Record]) -> Corrected:
    by = np.array([factors.get(sensor.name, 1.0) for sensor in rig.sensors])
    sensors = tuple(replace(s, noise_std=abs(f) * s.noise_std) for s, f in zip(rig.sensors, by, strict=True))
    return replace(rig, sensors=sensors), tuple(replace(r, outputs=by[:, None] * r.outputs) for r in records)


def _inputs_times(factors: dict[str, float], rig: Rig, records: Sequence[Record]) -> Corrected:
    by = np.array([factors.get(actuator.name, 1.0) for actuator in rig.actuators])
    return rig, tuple(replace(record, inputs=by[:, None] * record.inputs) for record in records)


def _exchanged(side: str, one: str, other: str, rig: Rig, records: Sequence[Record]) -> Corrected:
    """Two "inputs" or two "outputs"."""
    names = [port.name for port in (rig.actuators if side == "inputs" else rig.sensors)]
    order = list(range(len(names)))
    i, j = names.index(one), names.index(other)
    order[i], order[j] = j, i
    return rig, tuple(replace(record, **{side: getattr(record, side)[order]}) for record in records)


def _relabelled(rig: Rig, names: Iterable[str], quantity: str) -> Rig:
    named = set(names)
    return replace(rig, sensors=tuple(replace(s, quantity=quantity) if s.name in named else s for s in rig.sensors))


def _quantity_set(names: frozenset[str], quantity: str, rig: Rig, records: Sequence[Record]) -> Corrected:
    return _relabelled(rig, names, quantity), tuple(records)


def _rate_times(factor: float, rig: Rig, records: Sequence[Record]) -> Corrected:
    return rig, tuple(replace(r, sample_time=r.sample_time / factor) for r in records)


def _modes_times(omega: float, zeta: float, rig: Rig, records: Sequence[Record]) -> Corrected:
    modes = replace(rig.modes, omega=omega * rig.modes.omega, damping=omega * zeta * rig.modes.damping)
    structure = rig.structure
    if structure is not None and isinstance(structure.damping, ModalDamping):
        structure = replace(structure, damping=ModalDamping(zeta * np.asarray(structure.damping.zeta, float)))
    return replace(rig, modes=modes, structure=structure), tuple(records)
