"""Faults of the test set-up, looked for before any effect: of wiring, of units and of bookkeeping.

A fault of channels is believed where its correction makes measured and predicted signals alike in most bands of modes,
over all records and channels that it concerns, and more than any other correction does: a missing effect bends some
bands, either way, and a fault moves all of them alike. Other faults are believed where their correction takes nearly
all of the gap away: no missing effect changes a sample rate, or a damping ratio a hundredfold.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import combinations
from typing import Any

import numpy as np

from workbench.arrays import Flags, Floats
from workbench.gap.prediction.residuals import lead_of
from workbench.gap.report.by_band import Spectra, asked, log_ratios, unlike
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
NOISY = 0.5  # share of noise in a channel's measured power from which it shows no fault
CLOSED = 0.9  # share of the closable power that a correction must take away, on the channels that it concerns
FELT = 0.2  # change of unlikeness in a band from which a mend is felt there
TAKES = 0.4  # of unlikeness, in the mean of the bands where a mend is felt: of a factor 1.8 or more, of a sign 2
UNRELATED = 0.9  # of unlikeness that must not remain in that mean: signals with nothing in common leave 1 at least
SHARE_GONE = 0.5  # of it that must go there: what a missing effect bends stays
MOSTLY = 0.8  # share of those bands that must come closer
AHEAD = 0.25  # of unlikeness, by which it must be better than any other where they differ: of 2π and 9.81 it is 0.44
TELLING = 0.1  # share of the bands where a mend is felt in which it must differ from any other
NEAR = 0.15  # relative error of a gain that still is that factor: the least ratio of two of them is 1.56
SAME = 0.1  # of a factor's logarithm that gains may differ by from record to record: of 2π by a factor 1.2
MOST_CHANNELS = 12  # pairs of inputs are simulated one by one: beyond, only neighbours are
MOST_ROUNDS = 4  # faults that hide one another are found one after the other
GAIN_TAKES = 0.5  # share of what a factor leaves beyond the noise that a gain near it takes away: it is no unit then
CALIBRATED = 1e-3  # relative: a gain nearer to a factor is that factor (9.81 for 9.80665 is 3.4e-4)
TEN = 0.01  # relative: where all gains are as near to 10, an amplifier is as likely as g, which is 2 % off
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
        factor: of units, by which measured and predicted signals differ; 1 for any other fault.
        certain: False for a factor that may be one of units, where a gain near it explains far more, as an error of
            calibration does, or another one in each record, as of an amplifier that saturates. It is said and not
            corrected.
    """

    kind: str
    sentence: str
    closes: float
    correction: Correction
    certain: bool = True
    records: tuple[str, ...] = ()
    factor: float = 1.0


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
        others = [r for r in (*fit, *held) if r.name != record.name]
        found += [
            _of_one(what, record, fault)
            for fault in of_it
            if fault.certain and fault.closes >= CLOSED and _is_alone(fault, rig, record, others, settle)
        ]
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


def _disagreeing(records: Sequence[Record], fault: SetupFault, rig: Rig, settle: float) -> list[str]:
    """Names of the records that agree worse with the model by a correction.

    What is silent in a record, or decayed there, says nothing of it.
    """

    def left(of: Rig, these: Sequence[Record]) -> float:
        gap = _Gap.of(of, these, settle)
        return float(gap.unlike[asked(gap.seen)].sum())

    return [r.name for r in records if left(*fault.correction(rig, (r,))) > left(rig, (r,)) + FELT]


def _judged_on(records: Sequence[Record], fault: SetupFault, rig: Rig, settle: float) -> SetupFault:
    """A fault of all fit records, without those records that agree worse with the model by its correction."""
    others = _disagreeing(records, fault, rig, settle)
    sentence = f"{fault.sentence[:-1]}; not in {', '.join(others)}." if others else fault.sentence
    return replace(fault, sentence=sentence, records=tuple(r.name for r in records if r.name not in others))


def _is_alone(fault: SetupFault, rig: Rig, record: Record, others: Sequence[Record], settle: float) -> bool:
    """Whether some other record shows that it has not the fault: one of all records was asked for among them all.

    Without a factor of units, that record has the gain that this one has once corrected.
    """
    if fault.kind not in OF_CHANNELS or not others:
        return True
    without = _disagreeing(others, fault, rig, settle)
    (own,) = _gains_once_corrected(_Gap.of(rig, (record,), settle), fault)
    gains = [(own, *_Gap.of(rig, (other,), settle).log_ratios) for other in others if other.name in without]
    return any(_apart(both) <= _same_gain(fault) for both in gains)


def _gains_once_corrected(gap: "_Gap", fault: SetupFault) -> Floats:
    """(n_records, n_outputs, n_modes) logarithms of the gains that a correction leaves; nan where it is not felt."""
    after = _Gap.of(*fault.correction(gap.rig, gap.records), gap.settle).log_ratios
    return np.where(np.abs(after - gap.log_ratios) > FELT, after, np.nan)


def _apart(gains: Iterable[Floats]) -> float:
    """By how much the logarithms of the gains of two records differ, in the median of the bands that both show."""
    apart = [both[np.isfinite(both)] for both in (one - other for one, other in combinations(gains, 2))]
    return max((float(abs(np.median(both))) for both in apart if both.size), default=0.0)


def _same_gain(fault: SetupFault) -> float:
    """By how much they may differ: no limit where the fault is none of units."""
    return SAME * abs(np.log(fault.factor)) if fault.factor != 1.0 else np.inf


def _by_record(gap: "_Gap", fault: SetupFault) -> SetupFault:
    """A fault; in doubt where the records that it brings nearer to the model differ in gain.

    A factor of units is the same in all; what an amplifier that saturates leaves is another one at each level.
    """
    nearer = []
    for was, gains in zip(gap.log_ratios, _gains_once_corrected(gap, fault), strict=True):
        felt = np.isfinite(gains)
        if felt.any() and np.median(np.abs(gains[felt])) < np.median(np.abs(was[felt])):
            nearer.append(gains)
    if not fault.certain or _apart(nearer) <= _same_gain(fault):
        return fault
    but = f"from record to record the gain differs by a factor {np.exp(_apart(nearer)):.2g}"
    what = _perhaps(fault.sentence.split(": multiply")[0])
    return replace(fault, certain=False, sentence=f"{what}; but {but}, as where an amplifier saturates.")


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

    @cached_property
    def seen(self) -> Spectra:
        """Of what is measured."""
        return self.read(self.measured)

    @cached_property
    def spectra(self) -> Spectra:
        """Of what is predicted."""
        return self.read(self.predicted)

    @cached_property
    def unlike(self) -> Floats:
        """(n_records, n_outputs, n_modes) how unlike measured and predicted signals are."""
        return unlike(self.seen, self.spectra)

    @cached_property
    def log_ratios(self) -> Floats:
        """(n_records, n_outputs, n_modes) logarithms of measured by predicted amplitude; nan where none is asked."""
        return log_ratios(self.seen, self.spectra)

    @property
    def n_samples(self) -> int:
        """That are compared, of one output over all records."""
        return sum(y.shape[1] for y in self.measured)

    def read(self, signals: Sequence[Floats]) -> Spectra:
        """Of the outputs, at the samples that are compared."""
        return Spectra.read(signals, self.records, self.rig.modes.frequencies_hz)

    def with_rows(self, at: Sequence[int], left: Floats) -> Floats:
        """How unlike the signals are where some outputs are as said."""
        whole = self.unlike.copy()
        whole[:, list(at)] = left
        return whole

    @cached_property
    def gains(self) -> Floats:
        """(n_outputs,) what multiplies each prediction best."""
        over = sum((p**2).sum(axis=1) for p in self.predicted)
        along = sum((y * p).sum(axis=1) for y, p in zip(self.measured, self.predicted, strict=True))
        return np.asarray(np.divide(along, over, out=np.ones_like(over), where=over > 0))

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
        """(n_outputs,) share of the power beyond the noise that is gone; 0 where much of the signal is still missed,
        or noise is most of it."""
        left = np.maximum(after - self.noise, 0.0)
        return np.where(
            (left > LEFT) | (self.noise > NOISY), 0.0, 1.0 - left / np.maximum(self.before - self.noise, 1e-300)
        )

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


@dataclass(frozen=True, eq=False)
class _Mend:
    """A fault of a channel, of two that are exchanged or of all outputs alike, as if it were corrected.

    Attributes:
        kind: "outputs" or "inputs" for a factor, "quantity", "exchanged outputs" or "exchanged inputs".
        value: the factor, the quantities said and meant, or the names of the two channels.
        at: the channels, by index.
        left: (n_records, n_outputs, n_modes) how unlike measured and predicted signals then are.
    """

    kind: str
    value: Any
    at: tuple[int, ...]
    left: Floats


def _mends(gap: _Gap) -> Iterator[_Mend]:
    """Every fault of one channel or of all outputs alike, of channels with a wide gap."""
    rig, spectra = gap.rig, gap.spectra
    n, wide = len(rig.sensors), [int(j) for j in np.flatnonzero(gap.wide)]
    for factor in FACTORS:
        left = unlike(gap.seen, spectra, factor)
        yield _Mend("outputs", factor, tuple(range(n)), left)
        for j in wide if n > 1 else ():
            yield _Mend("outputs", factor, (j,), gap.with_rows((j,), left[:, [j]]))
    for i, j in combinations(wide, 2):
        left = unlike(gap.seen.rows((i, j)), spectra.rows((j, i)))
        names = rig.sensors[i].name, rig.sensors[j].name
        yield _Mend("exchanged outputs", names, (i, j), gap.with_rows((i, j), left))
    for quantity in QUANTITIES:
        here = [j for j in wide if rig.sensors[j].quantity in set(QUANTITIES) - {quantity}]
        if here:
            meant = _relabelled(rig, [rig.sensors[j].name for j in here], quantity)
            left = unlike(gap.seen, gap.read(gap.predict(meant, gap.records)))
            for j in here:
                yield _Mend("quantity", (rig.sensors[j].quantity, quantity), (j,), gap.with_rows((j,), left[:, [j]]))
    m = len(rig.actuators)
    if 1 < m <= MOST_CHANNELS and not is_stepped(rig):
        for p in range(m):
            own = gap.read(gap.predict(rig, _driven_by(p, gap.records)))
            for factor in (*FACTORS, 0.0) if any(np.any(of) for of in own.of) else ():
                of = [every + (factor - 1.0) * part for every, part in zip(spectra.of, own.of, strict=True)]
                yield _Mend("inputs", factor, (p,), unlike(gap.seen, spectra.like(of)))
    for p, q in combinations(range(m), 2):
        if m <= MOST_CHANNELS or q == p + 1:
            names = rig.actuators[p].name, rig.actuators[q].name
            crossed = gap.read(gap.predict(*_exchanged("inputs", *names, rig, gap.records)))
            yield _Mend("exchanged inputs", names, (p, q), unlike(gap.seen, crossed))


def _driven_by(p: int, records: Sequence[Record]) -> list[Record]:
    """The records with one input alone."""
    return [replace(r, inputs=r.inputs * (np.arange(r.n_inputs) == p)[:, None]) for r in records]


def _believed(gap: _Gap) -> list[_Mend]:
    """The mends that take most of what is unlike away where they are felt, and more than any rival, the best first.

    A rival is felt in half of the same bands or more: a fault elsewhere may be there too. An input that does nothing
    is one, where an effect has made another of it than the model says.
    """
    compared = asked(gap.seen)
    now = gap.unlike[compared]
    better = [mend for mend in _mends(gap) if mend.left[compared].sum() < now.sum()]
    better.sort(key=lambda mend: float(mend.left[compared].sum()))
    left = np.array([mend.left[compared] for mend in better]).reshape(-1, now.size)
    felt = np.abs(left - now) > FELT
    believed = []
    for i, mend in enumerate(better):
        at = felt[i]
        if not at.any():
            continue
        gone = (now - left[i])[at]
        enough = max(TAKES, SHARE_GONE * now[at].mean(), now[at].mean() - UNRELATED)
        if gone.mean() < enough or (gone > 0).mean() < MOSTLY:
            continue
        rivals = felt[:, at].mean(axis=1) >= 0.5
        rivals[i] = False
        differs = np.abs(left[rivals] - left[i]) > FELT
        ahead = np.where(differs, left[rivals] - left[i], 0.0).sum(axis=1)
        if (ahead > AHEAD * np.maximum(differs.sum(axis=1), TELLING * at.sum())).all():
            believed.append(mend)
    return believed


def _of_channels(gap: _Gap, kinds: Collection[str]) -> list[SetupFault]:
    """The likeliest fault: of all outputs, else of channels that have the same one; else those in doubt."""
    n = len(gap.rig.sensors)
    faults: dict[tuple[str, Any, bool], list[_Mend]] = {}
    for mend in _believed(gap):
        certain = _is_certain(gap, mend)
        if mend.kind in kinds and certain is not None:
            faults.setdefault((mend.kind, mend.value, certain), []).append(mend)
            if certain and mend.kind == "outputs" and len(mend.at) == n:
                return [_by_record(gap, _fault_of(gap, mend.kind, mend.value, mend.at, True))]
    made = [
        _by_record(gap, _fault_of(gap, kind, value, sorted({c for mend in mends for c in mend.at}), certain))
        for (kind, value, certain), mends in faults.items()
    ]
    return [fault for fault in made if fault.certain][:1] or made


def _is_certain(gap: _Gap, mend: _Mend) -> bool | None:
    """Whether a fault is certain, False where a factor may be an error of calibration; None where nobody can tell."""
    if mend.value == 0.0:
        return None
    if mend.kind in ("outputs", "inputs") and _of_one_mode(gap, mend.value, np.abs(mend.left - gap.unlike) > FELT):
        return None
    if mend.value not in MAY_BE_GAIN:
        return True
    if mend.kind == "inputs":  # these are weighed beside one another
        return None
    n, factor = gap.n_samples, float(mend.value)
    if len(mend.at) > 1:
        return bool((np.abs(gap.gains / (10.0 if factor > 1.0 else 0.1) - 1.0) > TEN).any())
    (j,) = mend.at
    if mend.value in (G, 1.0 / G) and gap.rig.sensors[j].quantity != "acceleration":
        return None
    left, freely = (gap.power([by * p for p in gap.predicted]) for by in (factor, gap.gains[:, None]))
    if gap.closed(left)[j] < CLOSED:
        return None
    return not _is_gain(float(gap.gains[j]), factor, n * left[j], n * freely[j], n * gap.noise[j], n)


def _of_one_mode(gap: _Gap, factor: float, felt: Flags | bool) -> bool:
    """Whether one mode alone, of several, speaks of a factor, where it can do so by itself.

    A resonance that moved past the excitation and a sensor beyond a node turn it, another stiffness gives it any gain.
    """
    n = int((asked(gap.seen) & felt).any(axis=(0, 1)).sum())
    return factor in (-1.0, *MAY_BE_GAIN) and n < min(2, gap.rig.modes.n_modes)


def _fault_of(gap: _Gap, kind: str, value: Any, at: Sequence[int], certain: bool) -> SetupFault:
    """What is wrong with some channels, and the correction."""
    rig = gap.rig
    names = [(rig.actuators if "inputs" in kind else rig.sensors)[c].name for c in at]
    called, fault_records = kind, gap.names
    if kind == "outputs":
        sentence = _sentence_of_outputs(gap, value, at, certain)
        correction = partial(_outputs_times, dict.fromkeys(names, 1.0 / value))
    elif kind == "inputs":
        what = f"{_named('input', names)} {FACTORS[value][1]}"
        sentence = f"{_one(what, names)}: multiply by {value:.6g}."
        correction = partial(_inputs_times, dict.fromkeys(names, value))
    elif kind == "quantity":
        said, meant = value
        what = _one(f"{_named('output', names)} are {meant}, not {said}", names)
        sentence = f'{what}: state the quantity "{meant}".'
        correction, fault_records = partial(_quantity_set, frozenset(names), meant), ()
    else:
        sentence = f"The {kind.split()[1]} {' and '.join(value)} are exchanged: swap them."
        correction = partial(_exchanged, kind.split()[1], *value)
    if kind in ("outputs", "inputs"):
        called = "sign" if value == -1.0 else "unit"
    factor = value if called == "unit" else 1.0
    fault = SetupFault(called, sentence, np.nan, correction, certain, fault_records, factor)
    return replace(
        fault, closes=_share_closed(fault, gap, [int(j) for j in np.flatnonzero(gap.wide)] if "inputs" in kind else at)
    )


def _share_closed(fault: SetupFault, gap: _Gap, outputs: Sequence[int]) -> float:
    """The share of the power beyond the noise that a correction takes away, in the median of some outputs."""
    at = list(outputs)
    after = _Gap.of(*fault.correction(gap.rig, gap.records), gap.settle)
    left, was = (np.maximum(each.before - each.noise, 0.0)[at] for each in (after, gap))
    return float(np.median(1.0 - left / np.maximum(was, 1e-300)))


def _sentence_of_outputs(gap: _Gap, factor: float, at: Sequence[int], certain: bool) -> str:
    """What outputs read, and what to multiply them by; of all outputs, what the inputs may be instead."""
    sensors = gap.rig.sensors
    names = [sensors[j].name for j in at]
    every = len(at) == len(sensors)
    what, of_inputs = FACTORS[factor]
    if factor == 1.0 / G and {sensors[j].quantity for j in at} == {"acceleration"}:
        what = IN_G
    who = "All outputs" if every and len(names) > 1 else _named("output", names)
    rest = f", or all inputs {of_inputs}" if every else ""
    if not certain:
        return _doubtful(f"{who} {what}{rest}", gap.gains[list(at)] / factor - 1.0)
    cure = "multiply by -1" if factor == -1.0 else f"multiply by {1.0 / factor:.6g}"
    return f"{_one(f'{who} {what}', names)}{rest}: {cure}{' (the outputs)' if rest else ''}."


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
    far = ", ".join(dict.fromkeys(f"{100 * share:+.2g} %" for share in off))
    return (
        f"{_perhaps(what)}; but the gain differs from that by {far}, more than its error: taken for an error of"
        " calibration."
    )


def _perhaps(what: str) -> str:
    """The same, with "may" before its first verb."""
    for sure, may in ((" look ", " may look "), (" looks ", " may look "), (" are ", " may be "), (" is ", " may be ")):
        if sure in what:
            return what.replace(sure, may, 1)
    return what


def _factor(gain: float) -> float | None:
    """The factor of `FACTORS` that a gain is near to; None for any other."""
    near = [factor for factor in FACTORS if gain * factor > 0 and abs(gain / factor - 1.0) < NEAR]
    return min(near, key=lambda factor: abs(gain / factor - 1.0), default=None)


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
    if any(_of_one_mode(gap, factor, True) for factor in wrong.values()):
        return []
    if not wrong or len(wrong) == acting.size:  # what all inputs have, all outputs may have
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
        faults.append(SetupFault(kind, sentence, closes, own, certain, gap.names, abs(factor)))
    return [_by_record(gap, fault) for fault in faults]


def _squares(values: Floats) -> float:
    return float(values @ values)


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


OF_ONE = ("outputs", "inputs", "exchanged outputs", "exchanged inputs")
WAYS_OF_ONE = (partial(_of_channels, kinds=OF_ONE), _scaled_inputs, _rates)  # a record by itself
WAYS = (partial(_of_channels, kinds=(*OF_ONE, "quantity")), _scaled_inputs, _rates, _structure)


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
