"""Checks before a fit: whether records and model agree in principle."""

from collections.abc import Sequence

import numpy as np

from workbench.arrays import Floats
from workbench.gap.effects.structural import modes_of
from workbench.gap.prediction.residuals import lead_of
from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.rig.simulate import simulate_record
from workbench.structure.domain import NamedPoints
from workbench.structure.member import Structure
from workbench.structure.modes import Modes
from workbench.structure.plate import Membrane, Plate
from workbench.structure.supports import PointMass

INVERTED_CORRELATION = -0.95  # correlation of a reading with the prediction
WRONG_UNIT_RATIO = 50.0  # ratio of a reading and the prediction, or its inverse
MAX_REDUCTION = 500.0  # times smaller than the prediction, at all outputs: no effect reduces the response so much
MAX_WORKING_RATIO = 5.0  # ratio of a reading and the prediction, or its inverse, that a working sensor has
# relative level from which a record is louder than another: a dry friction that holds a point at one level leaves less
# than 1 / MAX_WORKING_RATIO of its motion at a level no higher than that, so that a sensor at it is not taken for dead
LOUDER_RATIO = 1.2
MIN_NOISE_RATIO = 5.0  # times the noise: smaller signals are not compared
MIN_CORRELATION = 0.5  # correlation of a reading with the prediction, whatever its unit
MAX_SATURATED_SHARE = 0.5  # share of the samples at the largest magnitude
MIN_SAMPLES = 16  # of a record, as in a case folder
# relative tolerances of a natural frequency, a damping and a modal mass: solving a structure again changes them by less
FREQUENCY_TOLERANCE, DAMPING_TOLERANCE, MASS_TOLERANCE = 1e-3, 0.02, 0.02
QUADRATURE_POINTS = 200  # points along a member for the integral of its modal mass


# standard deviations (n_sensors,) of the readings and of the predictions, by record as a message names it
Levels = dict[str, tuple[Floats, Floats]]


class RecordsError(ValueError):
    """Raised for records that cannot have been measured on their rig."""


def check_records(
    rig: Rig, records: Sequence[Record], validation: Sequence[Record] = (), *, transient: float = 0.0
) -> None:
    """Refuse records, to be fitted or held out, whose channels are not, or cannot be, those of the rig.

    The first `transient` seconds of each record are not compared.

    Raises:
        RecordsError: for channels that are not the rig's in its order, a sensor with the wrong sign or in other units,
            a saturated or flat channel, a sensor that is dead in one record, a record shorter than a period of the
            first mode, or no input that drives the rig.
    """
    if not rig.actuators:
        raise RecordsError("the rig has no actuators, so nothing drives its model; a free decay is for wb.identify")
    check_alive(rig, records, validation, transient=transient)
    levels = _check_signs_and_units(rig, records, "record", transient)
    if not levels:
        raise RecordsError("every input of every record is at rest; there is nothing to compare")
    _check_dead(rig, levels | _check_signs_and_units(rig, validation, "validation record", transient))


def check_alive(
    rig: Rig, records: Sequence[Record], validation: Sequence[Record] = (), *, transient: float = 0.0
) -> None:
    """Refuse records of other channels or few samples, and channels that are saturated or flat: no model is needed.

    Raises: as `check_records`.
    """
    channels = ("input", [a.name for a in rig.actuators]), ("output", [s.name for s in rig.sensors])
    for record in (*records, *validation):
        for (what, expected), names in zip(channels, (record.input_names, record.output_names), strict=True):
            if list(names) != expected:
                raise RecordsError(
                    f"record {record.name!r}: its {what}s are {', '.join(names) or 'none'}; the rig has"
                    f" {', '.join(expected)}, in that order"
                )
    _check_not_saturated(rig, records)
    for these, what in ((records, "record"), (validation, "validation record")):
        for record in these:
            counted = record.n_samples - lead_of(record, transient)
            if counted < MIN_SAMPLES:
                raise RecordsError(
                    f"{what} {record.name!r} has {counted} samples to compare{' after transients' * (transient > 0)};"
                    f" at least {MIN_SAMPLES} are needed: take a longer record"
                    f"{' or a shorter transient' * (transient > 0)}"
                )
        for record in filter(_is_driven, these):
            for sensor, measured in zip(rig.sensors, record.outputs[:, lead_of(record, transient) :], strict=True):
                if np.ptp(measured) == 0:
                    raise RecordsError(
                        f"{what} {record.name!r}: output {sensor.name!r} is flat; check the sensor and its cable, or"
                        " leave it out"
                    )


def _is_driven(record: Record) -> bool:
    return bool(np.any(record.inputs))


def _check_dead(rig: Rig, levels: Levels) -> None:
    """Refuse an output that reads next to nothing in one record, and as predicted in another that is no louder.

    Other outputs must move there: otherwise the drive may have been off.
    """
    read, expected = (np.array(each) for each in zip(*levels.values(), strict=True))
    shown = expected > MIN_NOISE_RATIO * np.array([sensor.noise_std for sensor in rig.sensors])
    ratios = np.divide(read, expected, out=np.ones_like(read), where=shown)
    alive = shown & (np.abs(np.log(np.maximum(ratios, 1e-300))) < np.log(MAX_WORKING_RATIO))
    dead = shown & (ratios < 1.0 / MAX_REDUCTION) & alive.any(axis=1, keepdims=True)
    for i, j in np.argwhere(dead):
        no_louder = np.flatnonzero(alive[:, j] & (expected[:, j] < LOUDER_RATIO * expected[i, j]))
        if no_louder.size:
            what, other = (list(levels)[k] for k in (i, no_louder[0]))
            raise RecordsError(
                f"{what}: output {rig.sensors[j].name!r} reads {read[i, j]:.2g} rms where the model predicts"
                f" {expected[i, j]:.3g}; in {other} it reads {read[no_louder[0], j]:.3g} where"
                f" {expected[no_louder[0], j]:.3g} is predicted: the sensor is dead in one record; leave that record"
                " out, or that output"
            )


def _check_signs_and_units(rig: Rig, records: Sequence[Record], what: str, transient: float) -> Levels:
    """Refuse records, named `what`, that are too short or disagree in sign or unit with the model.

    Returns the levels of driven ones.
    """
    elastic = rig.modes.omega[rig.modes.omega > 0]
    levels: Levels = {}
    correlations, ratios = [], []
    for record in records:
        lead = lead_of(record, transient)
        if elastic.size and record.n_samples * record.sample_time < 2 * np.pi / elastic[0]:
            raise RecordsError(
                f"{what} {record.name!r} lasts {record.n_samples * record.sample_time:g} s, less than a period of the"
                f" first mode ({2 * np.pi / elastic[0]:g} s); take a longer record"
            )
        if not _is_driven(record):
            continue
        predicted = simulate_record(rig, record)[:, lead:]
        outputs = record.outputs[:, lead:]
        pairs = zip(outputs, predicted, strict=True)
        row = [float(np.corrcoef(y, p)[0, 1]) if np.ptp(p) > 0 else 0.0 for y, p in pairs]
        correlations.append(row)
        levels[f"{what} {record.name!r}"] = level = outputs.std(axis=1), predicted.std(axis=1)
        ratios.append(_amplitude_ratios(rig, *level, np.abs(row) > MIN_CORRELATION))
    if not levels:
        return levels
    correlation = np.array(correlations)
    _check_units(rig, records[0], np.array(ratios), np.abs(correlation) > MIN_CORRELATION, what)
    inverted = np.flatnonzero((correlation < INVERTED_CORRELATION).all(axis=0))
    if inverted.size and inverted.size < len(rig.sensors):
        raise RecordsError(
            f"output {rig.sensors[inverted[0]].name!r} reads with the wrong sign: its correlation with the model is"
            f" {correlation[:, inverted[0]].mean():.2f} in every {what}; reverse its sign"
        )
    return levels


def _amplitude_ratios(rig: Rig, read: np.ndarray, expected: np.ndarray, is_correlated: np.ndarray) -> np.ndarray:
    """Standard deviation (n_sensors,) of each reading over that of its prediction; NaN where one is below the noise.

    Correlation with the prediction shows that a reading is not just noise.
    """
    least = MIN_NOISE_RATIO * np.array([sensor.noise_std for sensor in rig.sensors])
    comparable = (expected > least) & ((read > least) | is_correlated)
    return np.where(comparable, read / np.where(comparable, expected, 1.0), np.nan)


def _check_units(rig: Rig, record: Record, ratios: np.ndarray, is_correlated: np.ndarray, what: str) -> None:
    """Refuse outputs that are correlated with the model but read fifty times too much or too little in every record.

    An unmodelled excitation may be far stronger than the inputs, but is not correlated with the response to them. If
    all outputs read 500 times too little, no correlation is required: no effect reduces the response so much.
    ratios, is_correlated: (n_records, n_sensors); record: any, for its units.
    """

    def side(some: np.ndarray, factor: float = WRONG_UNIT_RATIO) -> int:
        """1 if all known ratios are above the factor, -1 if all are below its inverse, else 0."""
        known = some[np.isfinite(some)]
        return int((known > factor).all()) - int((known < 1.0 / factor).all()) if known.size else 0

    correlated = np.where(is_correlated, ratios, np.nan)
    wrong = [j for j, column in enumerate(correlated.T) if side(column)]
    n_known = np.isfinite(ratios).any(axis=0).sum()
    if n_known > 1 and (side(ratios, MAX_REDUCTION) < 0 or (wrong and side(ratios))):
        units = dict.fromkeys(channel.unit for channel in (*record.input_channels, *record.output_channels))
        raise RecordsError(
            f"the outputs read about {_median_in_words(ratios)} times the prediction of the model in every {what}: are"
            f" outputs, inputs and model in consistent units, {', '.join(filter(None, units))}?"
        )
    if not wrong:
        return
    name, unit = rig.sensors[wrong[0]].name, record.output_channels[wrong[0]].unit or "its unit"
    raise RecordsError(
        f"output {name!r} reads about {_median_in_words(correlated[:, wrong[0]])} times what the model predicts"
        f" in every {what}: is it in {unit}?"
    )


def _median_in_words(ratios: np.ndarray) -> str:
    """The median of the known ratios, to two digits."""
    return f"{float(f'{np.nanmedian(ratios):.2g}'):g}"


def check_modes(rig: Rig) -> None:
    """Refuse a rig whose modes are not those of its structure.

    Effects on the structure solve it again, so changes of the modes alone would be lost.

    Raises:
        ValueError: for a natural frequency, a damping or a modal mass that the structure does not have.
    """
    if rig.structure is None:
        return
    modes, own = rig.modes, modes_of(rig.structure, rig.modes.n_modes)
    remedy = "; take the structure's own modes, or structure=None for modes of your own"
    off = np.abs(modes.omega - own.omega) > FREQUENCY_TOLERANCE * np.maximum(own.omega, own.omega[-1] / own.n_modes**2)
    for r in np.flatnonzero(off):
        raise ValueError(
            f"mode {r + 1} of the rig has {modes.frequencies_hz[r]:.6g} Hz, that of its structure"
            f" {own.frequencies_hz[r]:.6g} Hz{remedy}"
        )
    damping, expected = np.diag(modes.damping), np.diag(own.damping)
    off = np.abs(damping - expected) > DAMPING_TOLERANCE * np.maximum(expected, expected.max() / own.n_modes**2)
    for r in np.flatnonzero(off):
        raise ValueError(
            f"mode {r + 1} of the rig is damped by {damping[r]:.4g} rad/s, that of its structure by"
            f" {expected[r]:.4g} rad/s{remedy}"
        )
    masses = _modal_masses(modes, rig.structure)
    for r in np.flatnonzero(np.abs(masses - 1.0) > MASS_TOLERANCE):
        raise ValueError(
            f"mode {r + 1} of the rig is not mass-normalised: its modal mass ∫ m φ² is {masses[r]:.4g}, not 1; divide"
            f" its shape by {np.sqrt(masses[r]):.4g}{remedy}"
        )


def _modal_masses(modes: Modes, structure: Structure | Plate | Membrane) -> Floats:
    """Modal masses (n_modes,) ∫ m φ_r² over the structure and its attached masses."""
    if isinstance(modes.domain, NamedPoints):
        raise ValueError("modes at named points are not those of a structure with a length; give structure=None")
    places, weights = modes.domain.quadrature(QUADRATURE_POINTS)
    if isinstance(structure, Structure):
        density = structure.mass_per_length(places)
    else:
        density = structure.mass_per_area(*places.T)
    masses: Floats = (weights * density) @ modes.phi(places) ** 2
    for part in () if isinstance(structure, Membrane) else structure.attachments:
        if isinstance(part, PointMass):
            masses = masses + part.mass * modes.phi_at(part.at) ** 2
            if part.rotary_inertia:
                masses = masses + part.rotary_inertia * modes.phi_at(part.at, 1) ** 2
    return masses


def _check_not_saturated(rig: Rig, records: Sequence[Record]) -> None:
    """Refuse a sensor that clips in most samples; one that clips less often is an effect to be identified.

    Held-out records are not checked: they may clip more, as the identified effect predicts.
    """
    for j, sensor in enumerate(rig.sensors):
        top = max((float(np.abs(record.outputs[j]).max()) for record in records), default=0.0)
        at_top = [np.abs(record.outputs[j]) >= top * (1 - 1e-9) for record in records]
        share = np.concatenate(at_top).mean() if at_top else 0.0
        if top > 0 and share > MAX_SATURATED_SHARE:
            raise RecordsError(
                f"record {records[int(np.argmax([s.mean() for s in at_top]))].name!r}: output {sensor.name!r} is at"
                f" ±{top:g} for {100 * share:.0f} % of all its samples: it is saturated; lower the level or the gain"
            )
