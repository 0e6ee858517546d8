"""Prediction of the readings of a test, with bands, from rigs drawn from the uncertainty of a diagnosis."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from workbench.arguments import number, whole
from workbench.arrays import Floats
from workbench.cases.case import in_units
from workbench.design.estimation.digital import DigitalController
from workbench.design.loop.rig_loop import LoopRun, LoopTest, named, run_loops
from workbench.gap.report.verdict import Verdict
from workbench.records.record import Channel, Record
from workbench.records.units import SI, Units
from workbench.renamed import former_arguments
from workbench.rig.actuators import Actuator
from workbench.rig.elements import RandomForce
from workbench.rig.motion import Motion
from workbench.rig.readings import read
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.robust.posterior import WHAT_DRAWS, UncertainRig
from workbench.robust.verification import LEVEL, QUANTILES, check_loop_kinds, drawn_with_errors
from workbench.structure.modes import Modes, freeze
from workbench.structure.printed import Printed, counted
from workbench.threads import one_blas_thread

DRAWS, LEAST_DRAWS = 200, 40
NOISES = 4  # realisations of noise per draw, for the bands over time
MOST_BANDS = 8
MOST_NUMBERS = 25_000_000  # readings of all draws in memory
DIVERGED = 1e30  # readings, in any unit, above which a draw has diverged


@dataclass(frozen=True, eq=False, repr=False)
class Prediction(Printed):
    """Predicted readings of a test, each with a band that contains it with the probability LEVEL.

    Attributes:
        time: (n_samples,) s.
        channels: (n_outputs,) of the sensors.
        median, lower, upper: (n_outputs, n_samples) of the readings with noise.
        frequencies_hz: (n_frequencies,) Hz.
        spectrum_median, spectrum_lower, spectrum_upper: (n_outputs, n_frequencies) of the amplitude |Y| of a reading's
            discrete Fourier transform, in the unit of the reading.
        bands_hz: (n_bands, 2) frequency bands, each around one mode or several.
        expected: (n_draws, n_outputs, 1 + n_bands) share of each draw's own readings inside the bands: over time,
            then in each frequency band. They sample the coverage of a true model.
        name: of the test or controller.
        notes: warnings and remarks.
        allowed: rms of the unexplained residual over that of the readings; the bands include it.
        units: of time, of frequencies and of the channels.
    """

    time: Floats
    channels: tuple[Channel, ...]
    median: Floats
    lower: Floats
    upper: Floats
    frequencies_hz: Floats
    spectrum_median: Floats
    spectrum_lower: Floats
    spectrum_upper: Floats
    bands_hz: Floats
    expected: Floats
    name: str = "prediction"
    notes: tuple[str, ...] = ()
    allowed: float = 0.0
    units: Units = SI

    def __post_init__(self) -> None:
        freeze(self, "time", "median", "lower", "upper", "frequencies_hz", "bands_hz", "expected")
        freeze(self, "spectrum_median", "spectrum_lower", "spectrum_upper")

    @property
    def sample_time(self) -> float:
        return float(self.time[1] - self.time[0])

    @property
    def relative_width(self) -> Floats:
        """RMS half width of the bands over the RMS of the median (n_outputs,), over time."""
        half = 0.5 * np.sqrt(np.mean((self.upper - self.lower) ** 2, axis=1))
        size = np.sqrt(np.mean(self.median**2, axis=1))
        return np.asarray(half / np.where(size > 0, size, np.nan))

    def coverage(self, outputs: Floats) -> Floats:
        """Share of readings (n_outputs, n_samples) inside the bands (n_outputs, 1 + n_bands): see `expected`."""
        inside = ((outputs >= self.lower) & (outputs <= self.upper)).mean(axis=1)
        size = amplitudes(outputs)
        lines_inside = (size >= self.spectrum_lower) & (size <= self.spectrum_upper)
        of_band = [lines_inside[:, band].mean(axis=1) for band in _members(self.frequencies_hz, self.bands_hz)]
        return np.column_stack([inside, *of_band])

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        line = (
            f"{self.name}: {counted(self.time.size, 'sample')} of {counted(len(self.channels), 'sensor')},"
            f" {100 * LEVEL:g} % bands from {self.expected.shape[0]} draws"
        )
        size = np.sqrt(np.mean(self.median**2, axis=1))
        rows = [
            (c.name, c.unit, f"{rms:.4g}", f"{100 * width:.3g}")
            for c, rms, width in zip(self.channels, size, self.relative_width)
        ]
        return line, ("sensor", "unit", "root mean square", "half width of the band [%]"), rows, self.notes


@former_arguments(report="progress")
@one_blas_thread
def predict(
    rig: Verdict | UncertainRig,
    inputs: Record | Floats,
    *,
    sample_time: float | None = None,
    noise_std: Sequence[float] | Floats | None = None,
    draws: int = DRAWS,
    seed: int = 0,
    units: Units | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Prediction:
    """Predicted sensor outputs of a test, from rest, with 95 % bands over time and frequency.

    Each draw of the rig is simulated under the inputs. A random relative error Δ, of the size of the unexplained
    residual, changes amplitude and phase of each sensor in each frequency band, y_real = (1 + Δ) y. Noise is added. The
    bands are quantiles of the readings of all draws.

    Args:
        rig: a verdict, or its uncertain rig.
        inputs: (n_actuators, n_samples) commands, or a record with these inputs; its outputs are not used.
        sample_time: of an array of inputs, s.
        noise_std: (n_outputs,) of the readings; by default that of the verdict, else that of the sensors.
        draws: of the rig.
        seed: of the draws and of the noise.
        units: of the results; by default those of the verdict.
        progress: called with (text, share done).

    Raises:
        TypeError: no verdict, inputs that are neither numbers nor a record, or an argument that is no number.
        ValueError: inputs that do not fit the rig, too few draws, or a motion that diverges in many of them.
    """
    seed = whole(seed, "seed")
    uncertain, noise = _uncertain(rig, noise_std)
    sent, period, hold, start = _inputs(uncertain.nominal, inputs, sample_time)
    n_outputs, n_samples = noise.size, sent.shape[1]
    rng = np.random.default_rng(seed)
    truths = []
    rigs = uncertain.draws(_draws(draws, n_outputs, n_samples), rng)
    for i, drawn in enumerate(rigs):
        if progress is not None:
            progress("predicting", i / len(rigs))
        quiet, forces = _with_disturbances(drawn, sent, rng)
        with np.errstate(over="ignore", invalid="ignore"):
            try:
                truth = simulate(quiet, forces, sample_time=period, input_hold=hold).outputs
            except ValueError:  # infinite readings are refused by `Record`
                truth = np.full((n_outputs, n_samples), np.inf)
        truths.append(truth)
    time = np.asarray(start + period * np.arange(n_samples), float)
    name = inputs.name if isinstance(inputs, Record) else "prediction"
    named_units = _units(rig, units)
    banded = _banded(uncertain, _with_noise(uncertain.rig, noise).sensors, truths, time, rng, name, named_units)
    return replace(banded, notes=(*banded.notes, *_above_nyquist(uncertain.rig.modes, period, named_units)))


def _above_nyquist(modes: Modes, period: float, units: Units) -> tuple[str, ...]:
    """A note on the modes above the Nyquist frequency."""
    hertz = units.named("Hz")
    fast = [f"{f:.4g}" for f in modes.frequencies_hz if f > 0.5 / period]
    note = (
        f"Modes at {', '.join(fast)} {hertz} lie above the Nyquist frequency of {0.5 / period:.4g} {hertz}: the inputs"
        " do not contain their excitation between samples, unless they were held as input_hold says; sample faster."
    )
    return (note,) if fast else ()


@one_blas_thread
def predict_loop(
    rig: Verdict | UncertainRig,
    controller: DigitalController,
    test: LoopTest,
    *,
    noise_std: Sequence[float] | Floats | None = None,
    draws: int = DRAWS,
    seed: int = 0,
    units: Units | None = None,
) -> Prediction:
    """Predicted readings of a controller's sensors in a closed-loop test, with 95 % bands over time and frequency.

    Each draw of the rig is simulated in the loop, with the noise of its sensors. The unexplained residual is an error
    of the sensors' gains in the loop, and of the readings as in `predict`.

    Args:
        rig: a verdict, or its uncertain rig.
        controller: of the test's sample time.
        test: the excitation.
        noise_std: (n_outputs,) of all the rig's sensors; by default that of the verdict, else that of the sensors.
        draws: of the rig.
        seed: of the draws and of the noise.
        units: of the results; by default those of the verdict.

    Raises:
        TypeError: no verdict, no sampled controller, no test, or an argument that is no number.
        ValueError: a controller or a test that does not fit the rig, too few draws, or a motion that diverges in many
            of them.
    """
    check_loop_kinds(controller, test)
    seed = whole(seed, "seed")
    uncertain, noise = _uncertain(rig, noise_std)
    n_outputs, n_samples = len(controller.sensors), test.n_samples
    n_draws = _draws(draws, n_outputs, n_samples)
    rigs = [_with_noise(drawn, noise) for drawn in drawn_with_errors(uncertain, n_draws, seed)]
    runs = run_loops(rigs, controller, replace(test, seed=seed))
    truths = [_loop_truth(drawn, run, controller, test.sample_time) for drawn, run in zip(rigs, runs, strict=True)]
    sensors = _with_noise(uncertain.rig, noise).sensors
    read_by = [named(sensors, name) for name in controller.sensors]
    generator = np.random.default_rng([seed, 1])
    return _banded(uncertain, read_by, truths, test.time, generator, controller.name, _units(rig, units))


def _units(rig: Verdict | UncertainRig, units: Units | None) -> Units:
    """The units of the results: as given, else of the verdict, else SI."""
    return units or (rig.units if isinstance(rig, Verdict) else SI)


def _uncertain(rig: Verdict | UncertainRig, noise_std: Sequence[float] | Floats | None) -> tuple[UncertainRig, Floats]:
    """The uncertain rig, and the noise of its sensors (n_outputs,): as given, else of the verdict, else as stated."""
    uncertain = rig if isinstance(rig, UncertainRig) else UncertainRig.of(rig)
    if noise_std is None and isinstance(rig, Verdict) and rig.budget.noise_found:
        noise_std = rig.budget.noise_found
    sensors = uncertain.nominal.sensors
    noise = np.array([s.noise_std for s in sensors] if noise_std is None else noise_std, float)
    if noise.shape != (len(sensors),) or not (np.isfinite(noise) & (noise >= 0)).all():
        raise ValueError(f"noise_std must be 0 or more for each of the {len(sensors)} sensors; got {noise}")
    return uncertain, noise


def _with_noise(rig: Rig, noise: Floats) -> Rig:
    sensors = tuple(replace(s, noise_std=float(n)) for s, n in zip(rig.sensors, noise, strict=True))
    return replace(rig, sensors=sensors)


def check_draws(wanted: int) -> None:
    """Refuse too few draws for the quantiles of a band."""
    if whole(wanted, WHAT_DRAWS, least=1) < LEAST_DRAWS:
        raise ValueError(f"bands of {100 * LEVEL:g} % need {LEAST_DRAWS} draws or more; got {wanted}")


def _draws(wanted: int, n_outputs: int, n_samples: int) -> int:
    """The number of draws: as wanted, or as many as fit in memory."""
    check_draws(wanted)
    most = MOST_NUMBERS // (n_outputs * n_samples)
    if most < LEAST_DRAWS:
        raise ValueError(
            f"{n_samples} samples of {n_outputs} sensors are too many for {LEAST_DRAWS} draws; predict at most"
            f" {MOST_NUMBERS // (n_outputs * LEAST_DRAWS)} samples at a time"
        )
    return min(wanted, most)


def _loop_truth(rig: Rig, run: LoopRun, controller: DigitalController, sample_time: float) -> Floats:
    """Readings (n_outputs, n_samples) of the controller's sensors in a run, without noise, clipping and rounding."""
    rows = [[s.name for s in rig.sensors].index(name) for name in controller.sensors]
    if not run.bounded:
        return np.full((len(rows), run.commands.shape[1]), np.inf)
    n = rig.modes.n_modes
    forces = run.participation @ run.response.forces
    stiffness = np.asarray(rig.modes.omega[:, None] ** 2, float)
    motion = Motion(run.response.modal[:n], run.response.modal[n:], forces, stiffness, rig.modes.damping, sample_time)
    plain = replace(rig, sensors=tuple(replace(s, limit=np.inf, step=0.0) for s in rig.sensors))
    return np.asarray(read(plain, motion)[rows], float)


def _banded(
    uncertain: UncertainRig,
    sensors: Sequence[Sensor],
    drawn: Sequence[Floats],
    time: Floats,
    rng: np.random.Generator,
    name: str,
    units: Units,
) -> Prediction:
    """The prediction with its bands, from the noise-free readings (n_outputs, n_samples) of each draw.

    The noise of the sensors is added. Diverging draws are left out.
    """
    period = float(time[1] - time[0])
    frequencies = np.asarray(np.fft.rfftfreq(time.size, period), float)
    bands = _bands(uncertain.rig.modes, frequencies)
    truths = [
        truth + _unexplained(truth, uncertain.unexplained, frequencies, bands, rng)
        for truth in drawn
        if np.abs(truth).max() < DIVERGED
    ]
    notes, diverging = [], len(drawn) - len(truths)
    if diverging > len(drawn) // 10:
        raise ValueError(
            f"{diverging} of {len(drawn)} draws of the uncertain rig diverge in this test; predict a test of less"
            " excitation, or measure more first"
        )
    if diverging:
        notes.append(f"{diverging} of {len(drawn)} draws diverge and are left out.")
    if not uncertain.explained:
        notes.append(
            "The diagnosis leaves the gap unexplained: the bands allow for an error of"
            f" {100 * uncertain.unexplained:.3g} % of the readings, of any phase and in any frequency band."
        )
    readings = np.array(truths)
    median, lower, upper = _over_time(readings, sensors, rng)
    for i, truth in enumerate(readings):
        readings[i] = _read(truth, sensors, rng)
    sizes = np.array([amplitudes(reading) for reading in readings])
    middle, least, most = np.quantile(sizes, QUANTILES, axis=0, method="weibull")
    channels = in_units([Channel(s.name, s.quantity, at=s.at, noise_std=s.noise_std) for s in sensors], units)
    in_time = time, channels, median, lower, upper
    in_frequency = frequencies, middle, least, most, bands, np.zeros((0, len(sensors), 1 + len(bands)))
    prediction = Prediction(*in_time, *in_frequency, name, tuple(notes), uncertain.unexplained, units)
    return replace(prediction, expected=np.array([prediction.coverage(reading) for reading in readings]))


def amplitudes(outputs: Floats) -> Floats:
    """|Y| (n_outputs, n_frequencies) of the discrete Fourier transform, in the unit of the readings."""
    return np.asarray(np.abs(np.fft.rfft(outputs, axis=1)) * (2.0 / outputs.shape[1]))


def _inputs(rig: Rig, inputs: Record | Floats, sample_time: float | None) -> tuple[Floats, float, str, float]:
    """Commands (n_actuators, n_samples), their sample time (s), their hold, and the time of the first (s)."""
    names = [actuator.name for actuator in rig.actuators]
    if isinstance(inputs, Record):
        given = {channel.name: row for channel, row in zip(inputs.input_channels, inputs.inputs)}
        missing = [name for name in names if name not in given]
        if missing:
            raise ValueError(
                f"record {inputs.name!r} has no input {missing[0]!r}: it has {', '.join(given) or 'none'}; the rig's"
                f" are {', '.join(names)}"
            )
        sent: Floats = np.array([given[name] for name in names])
        period, hold, start = inputs.sample_time, inputs.input_hold, inputs.start_time
    else:
        if inputs is None or isinstance(inputs, str | Path):
            raise TypeError(
                f"inputs are a record or an array of commands; got {inputs!r}: read a file by wb.read_record(path,"
                " inputs=...)"
            )
        if sample_time is None or not (np.isfinite(number(sample_time, "sample_time", "s")) and sample_time > 0):
            raise ValueError(f"inputs as an array need a positive sample_time; got {sample_time}")
        sent = np.atleast_2d(np.asarray(inputs, float))
        period, hold, start = sample_time, "zero", 0.0
    if sent.shape[0] != len(names) or sent.shape[1] < 2 or not np.isfinite(sent).all():
        raise ValueError(
            f"inputs must be finite, one row for each of {', '.join(names)} and 2 samples or more; got {sent.shape}"
        )
    return sent, period, hold, start


def _bands(modes: Modes, frequencies: Floats) -> Floats:
    """Frequency bands (n_bands, 2), Hz, around groups of modes; edges are geometric means of neighbouring modes."""
    top = float(frequencies[-1])
    own = np.sort(modes.frequencies_hz[(modes.frequencies_hz > frequencies[1]) & (modes.frequencies_hz < top)])
    groups = [group for group in np.array_split(own, min(MOST_BANDS, max(own.size, 1))) if group.size]
    between = [np.sqrt(one[-1] * two[0]) for one, two in zip(groups, groups[1:])]
    edges = np.array([0.0, *between, top])
    bands = np.column_stack([edges[:-1], edges[1:]])
    return bands[[band.any() for band in _members(frequencies, bands)]]


def _members(frequencies: Floats, bands: Floats) -> list[Floats]:
    """Masks (n_frequencies,) of the lines in each band; a band includes its lower edge, the last also its upper one."""
    last = bands[-1, 1]
    return [(frequencies >= low) & ((frequencies < high) | (high == last)) for low, high in bands]


def _with_disturbances(rig: Rig, sent: Floats, rng: np.random.Generator) -> tuple[Rig, Floats]:
    """The rig without noise, clipping and rounding and with its random forces as inputs, and all inputs' samples."""
    sensors = [replace(sensor, limit=np.inf, step=0.0) for sensor in rig.sensors]
    random = [element for element in rig.elements if isinstance(element, RandomForce)]
    others = [element for element in rig.elements if not isinstance(element, RandomForce)]
    sources = [Actuator(f"random force {i + 1}", element.at, direct=True) for i, element in enumerate(random)]
    forces = [element.rms * rng.standard_normal(sent.shape[1]) for element in random]
    with_sources = replace(rig, sensors=tuple(sensors), elements=tuple(others), actuators=(*rig.actuators, *sources))
    return with_sources, np.vstack([sent, *forces])


def _unexplained(truth: Floats, share: float, frequencies: Floats, bands: Floats, rng: np.random.Generator) -> Floats:
    """Δ y of a random relative error Δ with E|Δ|² = share², independent for each sensor and frequency band."""
    if share == 0:
        return np.zeros_like(truth)
    error = np.zeros((truth.shape[0], frequencies.size), complex)
    for band in _members(frequencies, bands):
        error[:, band] = (rng.standard_normal((truth.shape[0], 2)) @ np.array([[1.0], [1.0j]])) * share / np.sqrt(2.0)
    return np.asarray(np.fft.irfft(error * np.fft.rfft(truth, axis=1), truth.shape[1], axis=1))


def _read(truth: Floats, sensors: Sequence[Sensor], rng: np.random.Generator) -> Floats:
    """Readings of noise-free signals `truth` (..., n_outputs, n_samples): with noise, then clipping, then rounding."""
    reading: Floats = truth + np.array([[s.noise_std] for s in sensors]) * rng.standard_normal(truth.shape)
    for j, sensor in enumerate(sensors):
        reading[..., j, :] = np.clip(reading[..., j, :], -sensor.limit, sensor.limit)
        if sensor.step > 0:
            reading[..., j, :] = sensor.step * np.round(reading[..., j, :] / sensor.step)
    return reading


def _over_time(truths: Floats, sensors: Sequence[Sensor], rng: np.random.Generator) -> Floats:
    """Quantiles (3, n_outputs, n_samples) of the readings of all draws, sensor by sensor."""
    rows = []
    for j, sensor in enumerate(sensors):
        readings = [_read(truths[:, [j]], [sensor], rng)[:, 0] for _ in range(NOISES)]
        rows.append(np.quantile(np.concatenate(readings), QUANTILES, axis=0, method="weibull"))
    return np.stack(rows, axis=1)
