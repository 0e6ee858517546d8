"""Before a fit: do the records fit the model, which effects could they show, and which could they not distinguish?"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from workbench.arrays import Floats
from workbench.gap.effects.catalogue import CATALOGUE
from workbench.gap.effects.effect import COORDINATES, Effect, Kind
from workbench.gap.effects.structural import modes_of
from workbench.gap.localisation.evidence import Evidence
from workbench.gap.prediction.residuals import FitData, lead_of
from workbench.records.record import Record
from workbench.renamed import Renamed
from workbench.rig.rig import Rig
from workbench.rig.simulate import predict
from workbench.structure.domain import Between, NamedPoints, Where, same_place
from workbench.structure.member import Structure
from workbench.structure.modes import Modes
from workbench.structure.plate import Membrane, Plate
from workbench.structure.supports import PointMass

ALIKE = 0.995
SEEN = 25.0  # of chi-squared: five standard deviations
TURNED = -0.95
FAR_OFF, ABOVE_NOISE = 50.0, 5.0  # times the model: in other units; times the noise: worth comparing
NO_EFFECT = 500.0  # times less than the model, of all outputs: no effect makes so much of it
ALIKE_IN_SHAPE = 0.5  # correlation of a reading with the model's, whatever its unit
STUCK = 0.5
LEAST_SAMPLES = 16  # of a record, as in a case folder
THINNING = 3
COARSELY = 2  # substeps of a sample: whether an effect shows needs no more
STRAY, MISJUDGED = 1e-3, 0.02  # of a frequency, of a damping: what solving a structure anew may differ by
MISSCALED, QUADRATURE = 0.02, 200  # of a modal mass; points along a member that it is integrated by
DECADES = (1e2, 1e-2, 1e4, 1e-4)


class RecordsError(ValueError):
    """Records that cannot be of the rig they came with."""


@dataclass(frozen=True, eq=False)
class Detectability:
    """Which effects the records can show, and which they can tell apart, before anything is fitted.

    Attributes:
        strengths: label of an effect -> how far it would move the residual, in standard deviations, at the first
            strength that these records show, or at the one they show most.
        undetectable: labels of effects that these records show at no strength.
        indistinguishable: pairs of labels whose responses are the same up to a factor, with their correlation.
    """

    strengths: dict[str, float]
    undetectable: tuple[str, ...]
    indistinguishable: tuple[tuple[str, str, float], ...]

    invisible, alike = Renamed("undetectable"), Renamed("indistinguishable")


def check_records(
    rig: Rig, records: Sequence[Record], validation: Sequence[Record] = (), *, settle: float = 0.0
) -> None:
    """Refuse records whose channels cannot be what the rig says they are: those to be fitted, and those held out.

    Args:
        settle: seconds at the start of each record that are not compared.

    Raises:
        RecordsError: a sensor that reads with the wrong sign or in other units, a saturated or flat channel, a record
            shorter than a period of the first mode, no inputs, inputs that are all at rest.
    """
    if not rig.actuators:
        raise RecordsError("the rig has no actuators, so nothing drives its model; a free decay is for wb.identify")
    check_alive(rig, records, validation, settle=settle)
    if not _compared(rig, records, "record", settle):
        raise RecordsError("every input of every record is at rest; there is nothing to compare")
    _compared(rig, validation, "validation record", settle)


def check_alive(rig: Rig, records: Sequence[Record], validation: Sequence[Record] = (), *, settle: float = 0.0) -> None:
    """Refuse records of few samples and channels that are saturated or flat, which no model is needed to see.

    Args, Raises: as `check_records`.
    """
    _check_not_stuck(rig, records)
    for these, what in ((records, "record"), (validation, "validation record")):
        for record in these:
            counted = record.n_samples - lead_of(record, settle)
            if counted < LEAST_SAMPLES:
                raise RecordsError(
                    f"{what} {record.name!r} has {counted} samples to compare{' once settled' * (settle > 0)}; at least"
                    f" {LEAST_SAMPLES} are needed: take a longer record"
                )
        for record in filter(_is_driven, these):
            for sensor, measured in zip(rig.sensors, record.outputs[:, lead_of(record, settle) :], strict=True):
                if np.ptp(measured) == 0:
                    raise RecordsError(
                        f"{what} {record.name!r}: output {sensor.name!r} is flat; check the sensor and its cable, or"
                        " leave it out"
                    )


def _is_driven(record: Record) -> bool:
    return bool(np.any(record.inputs))


def _compared(rig: Rig, records: Sequence[Record], what: str, settle: float) -> bool:
    """Whether there were records to compare with the model; refused where they cannot be of it."""
    elastic = rig.modes.omega[rig.modes.omega > 0]
    signs, sizes = [], []
    for record in records:
        lead = lead_of(record, settle)
        if elastic.size and record.n_samples * record.sample_time < 2 * np.pi / elastic[0]:
            raise RecordsError(
                f"{what} {record.name!r} lasts {record.n_samples * record.sample_time:g} s, less than a period of the"
                f" first mode ({2 * np.pi / elastic[0]:g} s); take a longer record"
            )
        if not _is_driven(record):
            continue
        predicted = predict(rig, record)[:, lead:]
        outputs = record.outputs[:, lead:]
        pairs = zip(outputs, predicted, strict=True)
        row = [float(np.corrcoef(y, p)[0, 1]) if np.ptp(p) > 0 else 0.0 for y, p in pairs]
        signs.append(row)
        sizes.append(_sizes(rig, outputs, predicted, np.abs(row) > ALIKE_IN_SHAPE))
    if not signs:
        return False
    _check_units(rig, records[0], np.array(sizes), np.abs(signs) > ALIKE_IN_SHAPE, what)
    turned = np.flatnonzero((np.array(signs) < TURNED).all(axis=0))
    if turned.size and turned.size < len(rig.sensors):
        name = rig.sensors[turned[0]].name
        raise RecordsError(
            f"output {name!r} reads with the wrong sign: its correlation with the model is"
            f" {np.array(signs)[:, turned[0]].mean():.2f} in every {what}; reverse its sign"
        )
    return True


def _sizes(rig: Rig, measured: np.ndarray, predicted: np.ndarray, alike: np.ndarray) -> np.ndarray:
    """Each sensor's reading over the model's (n_sensors,); NaN where one of the two is lost in the noise.

    Args:
        alike: (n_sensors,) whether the two go together: then the reading is more than noise.
    """
    least = ABOVE_NOISE * np.array([sensor.noise_std for sensor in rig.sensors])
    expected, read = predicted.std(axis=1), measured.std(axis=1)
    comparable = (expected > least) & ((read > least) | alike)
    return np.where(comparable, read / np.where(comparable, expected, 1.0), np.nan)


def _check_units(rig: Rig, record: Record, sizes: np.ndarray, alike: np.ndarray, what: str) -> None:
    """A channel that goes as the model does, and reads fifty times too much or too little in every record.

    What nobody modelled may be far stronger than the inputs, but does not go as their reply does. All outputs together
    need not go as the model does where they read far less than it: an effect that bends them leaves more.

    Args:
        record: any, for its units.
        sizes: (n_records, n_sensors) readings over the model's.
        alike: (n_records, n_sensors) whether they go as those do.
        what: such records are called.
    """

    def off(ratios: np.ndarray, by: float = FAR_OFF) -> int:
        known = ratios[np.isfinite(ratios)]
        return int((known > by).all()) - int((known < 1.0 / by).all()) if known.size else 0

    far = [j for j, column in enumerate(np.where(alike, sizes, np.nan).T) if off(column)]
    known = np.isfinite(sizes).any(axis=0).sum()
    if known > 1 and (off(sizes, NO_EFFECT) < 0 or (far and off(sizes))):
        raise RecordsError(
            f"the outputs read about {_about(sizes)} times the prediction of the model in every {what}: are outputs,"
            f" inputs and model in consistent units, {_units(record)}?"
        )
    if not far:
        return
    name, unit = rig.sensors[far[0]].name, record.output_channels[far[0]].unit or "its unit"
    raise RecordsError(
        f"output {name!r} reads about {_about(np.where(alike, sizes, np.nan)[:, far[0]])} times what the model predicts"
        f" in every {what}: is it in {unit}?"
    )


def _about(ratios: np.ndarray) -> str:
    return f"{float(f'{np.nanmedian(ratios):.2g}'):g}"


def _units(record: Record) -> str:
    units = (channel.unit for channel in (*record.input_channels, *record.output_channels))
    return ", ".join(dict.fromkeys(unit for unit in units if unit))


def check_modes(rig: Rig) -> None:
    """Refuse modes that are not those of the structure behind them.

    Effects of the structure are solved anew on it: what was changed on the modes alone would be lost in them.

    Raises:
        ValueError: a natural frequency, a damping or a modal mass that the structure does not have.
    """
    if rig.structure is None:
        return
    modes, own = rig.modes, modes_of(rig.structure, rig.modes.n_modes)
    remedy = "; take the structure's own modes, or structure=None for modes of your own"
    off = np.abs(modes.omega - own.omega) > STRAY * np.maximum(own.omega, own.omega[-1] / own.n_modes**2)
    if off.any():
        r = int(np.argmax(off))
        raise ValueError(
            f"mode {r + 1} of the rig has {modes.frequencies_hz[r]:.6g} Hz, that of its structure"
            f" {own.frequencies_hz[r]:.6g} Hz{remedy}"
        )
    damping, expected = np.diag(modes.damping), np.diag(own.damping)
    off = np.abs(damping - expected) > MISJUDGED * np.maximum(expected, expected.max() / own.n_modes**2)
    if off.any():
        r = int(np.argmax(off))
        raise ValueError(
            f"mode {r + 1} of the rig is damped by {damping[r]:.4g} rad/s, that of its structure by"
            f" {expected[r]:.4g} rad/s{remedy}"
        )
    masses = _modal_masses(modes, rig.structure)
    off = np.abs(masses - 1.0) > MISSCALED
    if off.any():
        r = int(np.argmax(off))
        raise ValueError(
            f"mode {r + 1} of the rig is not mass-normalised: its modal mass ∫ m φ² is {masses[r]:.4g}, not 1; divide"
            f" its shape by {np.sqrt(masses[r]):.4g}{remedy}"
        )


def _modal_masses(modes: Modes, structure: Structure | Plate | Membrane) -> Floats:
    """∫ m φ_r² over the structure with the masses attached to it, (n_modes,)."""
    if isinstance(modes.domain, NamedPoints):
        raise ValueError("modes at named points are not those of a structure with a length; give structure=None")
    places, weights = modes.domain.quadrature(QUADRATURE)
    density = (
        structure.mass_per_length(places)
        if isinstance(structure, Structure)
        else structure.mass_per_area(places[:, 0], places[:, 1])
    )
    masses: Floats = (weights * density) @ modes.phi(places) ** 2
    for part in () if isinstance(structure, Membrane) else structure.attachments:
        if isinstance(part, PointMass):
            masses = masses + part.mass * modes.phi_at(part.at) ** 2
            if part.rotary_inertia:
                masses = masses + part.rotary_inertia * modes.phi_at(part.at, 1) ** 2
    return masses


def _check_not_stuck(rig: Rig, records: Sequence[Record]) -> None:
    """A sensor that clips in some records is an effect to be named; one that clips most of the time shows nothing.

    Records held out may clip more: what was named predicts that.
    """
    for j, sensor in enumerate(rig.sensors):
        top = max((float(np.abs(record.outputs[j]).max()) for record in records), default=0.0)
        stuck = [np.abs(record.outputs[j]) >= top * (1 - 1e-9) for record in records]
        share = np.concatenate(stuck).mean() if stuck else 0.0
        if top > 0 and share > STUCK:
            raise RecordsError(
                f"record {records[int(np.argmax([s.mean() for s in stuck]))].name!r}: output {sensor.name!r} stands at"
                f" ±{top:g} for {100 * share:.0f} % of all its samples: it is saturated; lower the level or the gain"
            )


def detectability(evidence: Evidence, *, catalogue: tuple[Kind, ...] = CATALOGUE) -> Detectability:
    """Simulate each effect at a strength that the records show, and compare the responses."""
    rig, data = evidence.rig, evidence.data.stepped(COARSELY)
    base = data.residual(rig)
    labels, signatures, strengths = [], [], {}
    things = [(k, target) for k in catalogue if k.found_in != "residual" for target in k.targets(rig)]
    for effect, change in evidence.workers.map(lambda thing: _first_seen(*thing, evidence, data, base), things):
        if effect is None:
            continue
        size = float(np.linalg.norm(change))
        strengths[effect.label] = size * float(np.sqrt(THINNING))
        if size**2 * THINNING > SEEN:
            labels.append(effect.label)
            signatures.append((change / size).astype(np.float32))
    correlation = np.abs(np.array(signatures) @ np.array(signatures).T) if signatures else np.zeros((0, 0))
    alike = [
        (labels[i], labels[j], float(correlation[i, j]))
        for i in range(len(labels))
        for j in range(i + 1, len(labels))
        if correlation[i, j] > ALIKE and labels[i].split("[")[0] != labels[j].split("[")[0]
    ]
    return Detectability(
        strengths=strengths,
        undetectable=tuple(label for label, size in strengths.items() if size**2 <= SEEN),
        indistinguishable=tuple(sorted(alike, key=lambda pair: -pair[2])),
    )


def _first_seen(
    kind: Kind, target: Any, evidence: Evidence, data: FitData, base: Floats
) -> tuple[Effect | None, Floats]:
    """The first strength of a kind that these records show, or the one that they show most; and what it changes."""
    best, change, most = None, np.zeros(0), -1.0
    for effect in _strengths(kind, target, evidence):
        with np.errstate(over="ignore", invalid="ignore"):
            try:
                moved = (data.residual(effect.apply(evidence.rig)) - base)[::THINNING]
                size = float(moved @ moved) * THINNING
            except (ValueError, np.linalg.LinAlgError):
                continue
        if np.isfinite(size) and size > most:
            best, change, most = effect, moved, size
        if most > SEEN:
            break
    return best, change


def _strengths(kind: Kind, target: Any, evidence: Evidence) -> Iterator[Effect]:
    """Where a search would start, and from the first and the last start each number by decades up and down.

    A search starts from the unmodelled force, and where there is none it starts from nothing, and anywhere: also by a
    support, where nothing shows. So the last resort is where the structure moves most.
    """
    starts = [Effect(kind, target, dict(values)) for values in kind.starts(evidence, target)]
    if starts:
        yield starts[0]
        yield from _by_decades(starts[0], evidence.rig)
        yield from starts[1:]
        yield from _by_decades(starts[-1], evidence.rig)
        if starts[0].at is not None:
            liveliest = starts[0].moved_to(_liveliest(evidence))
            yield liveliest
            yield from _by_decades(liveliest, evidence.rig)


def _liveliest(evidence: Evidence) -> Where:
    """The place that moves most, of those where a force is looked for."""
    power = sum(motion.displacement @ motion.displacement.T for motion in evidence.motions)
    places = [where for where in evidence.places if not isinstance(where, Between)]
    shapes = evidence.rig.modes.phi(places)
    liveliest: Where = same_place(places[int(np.argmax(np.sum((shapes @ power) * shapes, axis=1)))])
    return liveliest


def _by_decades(effect: Effect, rig: Rig) -> Iterator[Effect]:
    for factor in DECADES:
        for parameter in effect.parameters(rig):
            if parameter.name not in COORDINATES:
                moved = float(np.clip(effect.values[parameter.name] * factor, parameter.low, parameter.high))
                yield replace(effect, values={**effect.values, parameter.name: moved})
