"""Effects of the environment: periodic and random disturbance forces."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from workbench.gap.effects.effect import (
    Effect,
    Kind,
    Parameter,
    Reconstruction,
    at_a_place,
    place_of,
    place_values,
    positive,
)
from workbench.gap.effects.nonlinear import with_element
from workbench.gap.effects.transducers import ACTUATOR_BIAS
from workbench.identification.signal.distortion import period_of
from workbench.records.record import Record
from workbench.rig.elements import PeriodicForce, RandomForce
from workbench.rig.rig import Rig
from workbench.structure.domain import Between

SAME_LINE = 0.15  # of the resolution 1/T: a sinusoid as close as this to a harmonic is that harmonic
SLOW = 0.05  # of the first elastic frequency: a disturbance below it may be a constant force
ONE_LEVEL = 1.1  # ratio of the largest rms of an input to the least: below, records are of one level


def tone(force: np.ndarray, sample_time: float) -> tuple[float, float, float]:
    """Frequency (Hz), amplitude and phase (at the first sample, rad) of the strongest sinusoid in a series."""
    n = force.size
    centred = force - force.mean()
    spectrum = np.abs(np.fft.rfft(centred * np.hanning(n), 8 * n))
    spectrum[: 8 * 2] = 0.0
    frequency = float(np.fft.rfftfreq(8 * n, sample_time)[np.argmax(spectrum)])
    time = sample_time * np.arange(n)
    basis = np.column_stack([np.sin(2 * np.pi * frequency * time), np.cos(2 * np.pi * frequency * time)])
    sine, cosine = np.linalg.lstsq(basis, centred, rcond=None)[0]
    return frequency, float(np.hypot(sine, cosine)), float(np.arctan2(cosine, sine))


def _is_distortion(frequency: float, records: Sequence[Record]) -> bool:
    """Whether a sinusoid is a harmonic of a periodic excitation of one level, which any nonlinear law may cause.

    With several levels, a fit distinguishes a disturbance, which does not depend on level.
    """
    rms = np.array([np.sqrt((record.inputs**2).mean()) for record in records])
    period, *others = {period_of(record.inputs) for record in records}
    if rms.max() > ONE_LEVEL * rms.min() or others or period is None:
        return False
    sample_time = records[0].sample_time
    order = frequency * period * sample_time
    duration = sample_time * min(record.n_samples for record in records)
    return abs(order - round(order)) / (period * sample_time) < SAME_LINE / duration


def _periodic_starts(reconstruction: Reconstruction, _: object) -> Iterator[dict[str, Any]]:
    records, sample_time = reconstruction.data.counted, reconstruction.data.records[0].sample_time
    # only samples of one rate have a mean
    alike = [bool(np.isclose(record.sample_time, sample_time, rtol=1e-6, atol=0.0)) for record in records]
    shortest = min(record.n_samples for record, is_alike in zip(records, alike, strict=True) if is_alike)
    starts = np.cumsum([0, *(record.n_samples for record in records)])[:-1][alike]
    for place in reconstruction.at_peaks:
        if isinstance(place.at, Between):
            continue
        mean = np.mean([place.force[start : start + shortest] for start in starts], axis=0)
        frequency, amplitude, phase = tone(mean, sample_time)
        lead = records[0].start_time - reconstruction.data.records[0].start_time
        if lead:  # the phase refers to the start of the record
            phase = float(np.angle(np.exp(1j * (phase - 2.0 * np.pi * frequency * lead))))
        if not _is_distortion(frequency, reconstruction.data.records):
            yield {**place_values(place.at), "frequency": frequency, "amplitude": amplitude, "phase": phase}


def _constant(tone: Effect, rig: Rig) -> Iterator[Effect]:
    """The constant force of an actuator that a very slow disturbance is within a record."""
    elastic = rig.modes.frequencies_hz[rig.modes.omega > 0]
    if elastic.size and tone.values["frequency"] < SLOW * elastic[0]:
        force = float(tone.values["amplitude"] * np.sin(tone.values["phase"]))
        yield from (Effect(ACTUATOR_BIAS, a.name, {"force": force}) for a in rig.actuators if not a.direct)


PERIODIC_DISTURBANCE = Kind(
    name="periodic_disturbance",
    path="environment",
    parameters=at_a_place(
        lambda scales: Parameter("frequency", "Hz", 1e-6 / scales.time, 1e6 / scales.time, logarithmic=True),
        lambda scales: positive("amplitude", "N", scales.force, 1e-15, 1e9),
        lambda _: Parameter("phase", "rad", -20.0, 20.0),
    ),
    apply=lambda rig, _, v: with_element(rig, PeriodicForce(place_of(v), v["frequency"], v["amplitude"], v["phase"])),
    starts=_periodic_starts,
    numbers=lambda tone, _: {**tone.numbers, "phase": (tone.values["phase"] + np.pi) % (2.0 * np.pi) - np.pi},
    simpler=_constant,
    phrase="a periodic disturbance",
)


RANDOM_DISTURBANCE = Kind(
    name="random_disturbance",
    path="environment",
    parameters=at_a_place(lambda scales: positive("rms", "N", scales.force, 1e-15, 1e9)),
    apply=lambda rig, _, v: with_element(rig, RandomForce(place_of(v), v["rms"])),
    starts=lambda *_: [],  # found from the statistics of the residual
    found_in="residual",
    unpredictable="A random disturbance leaves an unpredictable residual; only its statistics were estimated.",
    phrase="a random disturbance",
)

KINDS = (PERIODIC_DISTURBANCE, RANDOM_DISTURBANCE)
