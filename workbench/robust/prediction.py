"""What the next test will show, with bands: readings of rigs drawn from what a diagnosis leaves uncertain."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from workbench.arguments import number, whole
from workbench.arrays import Floats
from workbench.design.estimation.digital import DigitalController
from workbench.design.loop.rig_loop import LoopRun, LoopTest, named, run_loops
from workbench.gap.report.verdict import Verdict
from workbench.records.record import Channel, Record
from workbench.renamed import former_arguments
from workbench.rig.actuators import Actuator
from workbench.rig.elements import RandomForce
from workbench.rig.rig import Rig
from workbench.rig.simulate import Motion, read, simulate
from workbench.robust.posterior import WHAT_DRAWS, UncertainRig
from workbench.robust.verification import check_loop_kinds, drawn_with_errors
from workbench.structure.modes import Modes, frozen
from workbench.structure.printed import Printed, counted
from workbench.threads import one_blas_thread

LEVEL = 0.95
DRAWS, LEAST_DRAWS = 200, 40
NOISES = 4  # readings of each draw, each with noise of its own, from which the bands over time are read
MOST_BANDS = 8
MOST_NUMBERS = 25_000_000  # readings of all draws that are held at a time
RUN_AWAY = 1e30  # of any unit: a draw that does not come back


@dataclass(frozen=True, eq=False, repr=False)
class Prediction(Printed):
    """Readings of a test to come, each with the band that holds it with the probability LEVEL.

    Attributes:
        time: (n_samples,) s.
        channels: (n_outputs,) of the sensors.
        median, lower, upper: (n_outputs, n_samples) of the readings, noise among it.
        frequencies_hz: (n_frequencies,) Hz.
        spectrum_median, spectrum_lower, spectrum_upper: (n_outputs, n_frequencies) of the amplitude |Y| of a reading's
            discrete Fourier transform, in the unit of the reading.
        bands_hz: (n_bands, 2) frequency bands, one around each mode or several.
        expected: (n_draws, n_outputs, 1 + n_bands) share of each draw's own readings inside the bands: over time,
            then in each frequency band. A test of a true model gives such shares.
        name: of what is predicted.
        notes: what else a reader should know.
        allowed: rms of what the rig leaves unexplained, over that of the readings, which the bands allow for.
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

    def __post_init__(self) -> None:
        arrays = ("time", "median", "lower", "upper", "frequencies_hz", "bands_hz", "expected")
        for name in (*arrays, "spectrum_median", "spectrum_lower", "spectrum_upper"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

    @property
    def sample_time(self) -> float:
        return float(self.time[1] - self.time[0])

    @property
    def relative_width(self) -> Floats:
        """Half width of the bands over the root mean square of the median (n_outputs,), both in the mean over time."""
        half = 0.5 * np.sqrt(np.mean((self.upper - self.lower) ** 2, axis=1))
        size = np.sqrt(np.mean(self.median**2, axis=1))
        return np.asarray(half / np.where(size > 0, size, np.nan))

    def coverage(self, outputs: Floats) -> Floats:
        """Share of readings (n_outputs, n_samples) inside the bands (n_outputs, 1 + n_bands): see `expected`."""
        inside = ((outputs >= self.lower) & (outputs <= self.upper)).mean(axis=1)
        size = amplitudes(outputs)
        held = (size >= self.spectrum_lower) & (size <= self.spectrum_upper)
        of_band = [held[:, band].mean(axis=1) for band in _members(self.frequencies_hz, self.bands_hz)]
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
    progress: Callable[[str, float], None] | None = None,
) -> Prediction:
    """Predicted sensor outputs of a test, from rest, with 95 % bands over time and frequency.

    Each draw of the rig is simulated under the inputs; a relative error Δ of the size that is left unexplained changes
    amplitude and phase of each sensor in each frequency band, y_real = (1 + Δ) y; noise comes last. A band runs between
    the quantiles of all draws' readings.

    Args:
        rig: a verdict, or the uncertain rig that it leaves.
        inputs: (n_actuators, n_samples) commands, or a record that has these as inputs; its outputs are not looked at.
        sample_time: of an array of inputs, s.
        noise_std: (n_outputs,) of the readings; as the verdict found it, or as the sensors state it.
        draws: of the rig.
        seed: of the draws and of the noise.
        progress: called with what is done and the share done.

    Raises:
        TypeError: no verdict, inputs that are neither numbers nor a record, or no number where one is asked for.
        ValueError: inputs that do not fit the rig, too few draws, or hardly any draw with a bounded motion.
    """
    seed = whole(seed, "seed")
    found, spread = _found(rig, noise_std)
    sent, period, hold, start = _inputs(found.nominal, inputs, sample_time)
    n_outputs, n_samples = spread.size, sent.shape[1]
    rng = np.random.default_rng(seed)
    truths = []
    rigs = found.draws(_draws(draws, n_outputs, n_samples), rng)
    for i, drawn in enumerate(rigs):
        if progress is not None:
            progress("predicting", i / len(rigs))
        quiet, forces = _with_disturbances(drawn, sent, rng)
        with np.errstate(over="ignore", invalid="ignore"):
            try:
                truth = simulate(quiet, forces, sample_time=period, input_hold=hold).outputs
            except ValueError:  # a record holds no infinite readings
                truth = np.full((n_outputs, n_samples), np.inf)
        truths.append(truth)
    time = np.asarray(start + period * np.arange(n_samples), float)
    name = inputs.name if isinstance(inputs, Record) else "prediction"
    banded = _banded(found, found.rig, truths, time, spread, rng, name)
    return replace(banded, notes=(*banded.notes, *_too_fast(found.rig.modes, period)))


def _too_fast(modes: Modes, period: float) -> tuple[str, ...]:
    """Which modes move between the samples, in words."""
    fast = [f"{f:.4g}" for f in modes.frequencies_hz if f > 0.5 / period]
    if not fast:
        return ()
    return (
        f"Modes at {', '.join(fast)} Hz lie above the Nyquist frequency of {0.5 / period:.4g} Hz: what drives them"
        " between samples is not in the inputs, unless these were held as input_hold says; sample faster.",
    )


@one_blas_thread
def predict_loop(
    rig: Verdict | UncertainRig,
    controller: DigitalController,
    test: LoopTest,
    *,
    noise_std: Sequence[float] | Floats | None = None,
    draws: int = DRAWS,
    seed: int = 0,
) -> Prediction:
    """What the sensors of a controller will read in a controlled test to come, with 95 % bands over time and frequency.

    Each draw of the rig is simulated in the loop, its sensors' noise fed back; what is left unexplained is an error of
    the gains that the loop feels, and one of the readings as in `predict`.

    Args:
        rig: a verdict, or the uncertain rig that it leaves.
        controller: of the test's sample time.
        test: what the loop is put through.
        noise_std: (n_outputs,) of all the rig's sensors; as the verdict found it, or as they state it.
        draws: of the rig.
        seed: of the draws and of the noise.

    Raises:
        TypeError: no verdict, no sampled controller, no test, or no number where one is asked for.
        ValueError: a controller or a test that does not fit the rig, too few draws, or hardly any with a bounded
            motion.
    """
    check_loop_kinds(controller, test)
    seed = whole(seed, "seed")
    found, noise = _found(rig, noise_std)
    n_outputs, n_samples = len(controller.sensors), test.n_samples
    rigs = [_with_noise(drawn, noise) for drawn in drawn_with_errors(found, _draws(draws, n_outputs, n_samples), seed)]
    runs = run_loops(rigs, controller, replace(test, seed=seed))
    truths = [_loop_truth(drawn, run, controller, test.sample_time) for drawn, run in zip(rigs, runs, strict=True)]
    sensors = _with_noise(found.rig, noise).sensors
    read_by = replace(found.rig, sensors=tuple(named(sensors, name) for name in controller.sensors))
    spread = np.array([s.noise_std for s in read_by.sensors])
    rng = np.random.default_rng([seed, 1])
    return _banded(found, read_by, truths, test.time, spread, rng, controller.name)


def _found(rig: Verdict | UncertainRig, noise_std: Sequence[float] | Floats | None) -> tuple[UncertainRig, Floats]:
    """The uncertain rig, and the noise of its sensors: as given, as the verdict found it, or as they state it."""
    found = rig if isinstance(rig, UncertainRig) else UncertainRig.of(rig)
    if noise_std is None and isinstance(rig, Verdict) and rig.budget.noise_found:
        noise_std = rig.budget.noise_found
    return found, _noise(found.nominal, noise_std)


def _with_noise(rig: Rig, noise: Floats) -> Rig:
    sensors = tuple(replace(s, noise_std=float(n)) for s, n in zip(rig.sensors, noise, strict=True))
    return replace(rig, sensors=sensors)


def check_draws(wanted: int) -> None:
    """Refuse too few draws for the ends of a band.

    Raises:
        TypeError: no number.
        ValueError: saying how many it takes.
    """
    if whole(wanted, WHAT_DRAWS, least=1) < LEAST_DRAWS:
        raise ValueError(f"bands of {100 * LEVEL:g} % need {LEAST_DRAWS} draws or more; got {wanted}")


def _draws(wanted: int, n_outputs: int, n_samples: int) -> int:
    """How many draws: as wanted, or as many as can be held at a time."""
    check_draws(wanted)
    most = MOST_NUMBERS // (n_outputs * n_samples)
    if most < LEAST_DRAWS:
        raise ValueError(
            f"{n_samples} samples of {n_outputs} sensors are too many for {LEAST_DRAWS} draws; predict at most"
            f" {MOST_NUMBERS // (n_outputs * LEAST_DRAWS)} samples at a time"
        )
    return min(wanted, most)


def _loop_truth(rig: Rig, run: LoopRun, controller: DigitalController, sample_time: float) -> Floats:
    """What the controller's sensors (n_outputs, n_samples) read of a run, noise, clipping and rounding apart."""
    rows = [[s.name for s in rig.sensors].index(name) for name in controller.sensors]
    if not run.bounded:
        return np.full((len(rows), run.commands.shape[1]), np.inf)
    n = rig.modes.n_modes
    forces = run.into @ run.response.forces
    stiffness = np.asarray(rig.modes.omega[:, None] ** 2, float)
    motion = Motion(run.response.modal[:n], run.response.modal[n:], forces, stiffness, rig.modes.damping, held=True)
    plain = replace(rig, sensors=tuple(replace(s, limit=np.inf, step=0.0) for s in rig.sensors))
    return np.asarray(read(plain, motion, sample_time=sample_time)[rows], float)


def _banded(
    found: UncertainRig,
    rig: Rig,
    possible: Sequence[Floats],
    time: Floats,
    spread: Floats,
    rng: np.random.Generator,
    name: str,
) -> Prediction:
    """The bands of what the sensors of a rig read in each draw, (n_outputs, n_samples); draws that run away left out.

    Args:
        found: whose unexplained share is allowed for.
        rig: whose sensors read.
        possible: noise apart, a draw each.
        time: (n_samples,) s.
        spread: (n_outputs,) of the noise.
        rng: of the noise.
        name: of what is predicted.
    """
    period = float(time[1] - time[0])
    frequencies = np.asarray(np.fft.rfftfreq(time.size, period), float)
    bands = _bands(rig.modes, frequencies)
    truths = [
        truth + _unexplained(truth, found.unexplained, frequencies, bands, rng)
        for truth in possible
        if np.abs(truth).max() < RUN_AWAY
    ]
    notes, away = [], len(possible) - len(truths)
    if away > len(possible) // 10:
        raise ValueError(
            f"{away} of {len(possible)} samples of the uncertain rig diverge in this test; predict a weaker one, or"
            " measure more first"
        )
    if away:
        notes.append(f"{away} of {len(possible)} samples diverge and are left out.")
    if not found.explained:
        notes.append(
            "The diagnosis leaves the gap unexplained:"
            f" {100 * found.unexplained:.3g} % of the readings are allowed for, of any phase and in any band."
        )
    readings = np.array(truths)
    low, middle, high = _over_time(readings, rig, spread, rng)
    for i, truth in enumerate(readings):
        readings[i] = _read(truth, rig, spread, rng)
    sizes = np.array([amplitudes(reading) for reading in readings])
    spectrum = np.quantile(sizes, QUANTILES, axis=0, method="weibull")
    prediction = Prediction(
        time,
        tuple(Channel(s.name, s.quantity, at=s.at, noise_std=n) for s, n in zip(rig.sensors, spread)),
        middle,
        low,
        high,
        frequencies,
        spectrum[1],
        spectrum[0],
        spectrum[2],
        bands,
        np.zeros((0, len(rig.sensors), 1 + len(bands))),
        name,
        tuple(notes),
        found.unexplained,
    )
    return replace(prediction, expected=np.array([prediction.coverage(reading) for reading in readings]))


QUANTILES = (0.5 - 0.5 * LEVEL, 0.5, 0.5 + 0.5 * LEVEL)


def amplitudes(outputs: Floats) -> Floats:
    """|Y| (n_outputs, n_frequencies) of the discrete Fourier transform, in the unit of the readings."""
    return np.asarray(np.abs(np.fft.rfft(outputs, axis=1)) * (2.0 / outputs.shape[1]))


def _inputs(rig: Rig, inputs: Record | Floats, sample_time: float | None) -> tuple[Floats, float, str, float]:
    """Commands (n_actuators, n_samples), their sample time, how they are held, and the time of the first, s."""
    names = [actuator.name for actuator in rig.actuators]
    if isinstance(inputs, Record):
        there = {channel.name: row for channel, row in zip(inputs.input_channels, inputs.inputs)}
        missing = [name for name in names if name not in there]
        if missing:
            raise ValueError(
                f"record {inputs.name!r} has no input {missing[0]!r}: it has {', '.join(there) or 'none'}; the rig's"
                f" are {', '.join(names)}"
            )
        sent, period, hold, start = (
            np.array([there[name] for name in names]), inputs.sample_time, inputs.input_hold, inputs.start_time,
        )  # fmt: skip
    else:
        if inputs is None or isinstance(inputs, str | Path):
            raise TypeError(
                f"inputs are a record or an array of commands; got {inputs!r}: read a file by wb.read_record(path,"
                " inputs=...)"
            )
        if sample_time is None or not (np.isfinite(number(sample_time, "sample_time", "s")) and sample_time > 0):
            raise ValueError(f"inputs as an array need a positive sample_time; got {sample_time}")
        sent, period, hold, start = np.atleast_2d(np.asarray(inputs, float)), sample_time, "zero", 0.0
    if sent.shape[0] != len(names) or sent.shape[1] < 2 or not np.isfinite(sent).all():
        raise ValueError(
            f"inputs must be finite, one row for each of {', '.join(names)} and 2 samples or more; got {sent.shape}"
        )
    return sent, period, hold, start


def _noise(rig: Rig, given: Sequence[float] | Floats | None) -> Floats:
    noise = np.array([s.noise_std for s in rig.sensors] if given is None else given, float)
    if noise.shape != (len(rig.sensors),) or not (np.isfinite(noise) & (noise >= 0)).all():
        raise ValueError(f"noise_std must be 0 or more for each of the {len(rig.sensors)} sensors; got {noise}")
    return noise


def _bands(modes: Modes, frequencies: Floats) -> Floats:
    """Frequency bands (n_bands, 2), Hz, from half-way to half-way between modes, on a logarithmic scale."""
    top = float(frequencies[-1])
    own = np.sort(modes.frequencies_hz[(modes.frequencies_hz > frequencies[1]) & (modes.frequencies_hz < top)])
    groups = [group for group in np.array_split(own, min(MOST_BANDS, max(own.size, 1))) if group.size]
    between = [np.sqrt(one[-1] * two[0]) for one, two in zip(groups, groups[1:])]
    edges = np.array([0.0, *between, top])
    bands = np.column_stack([edges[:-1], edges[1:]])
    return bands[[band.any() for band in _members(frequencies, bands)]]


def _members(frequencies: Floats, bands: Floats) -> list[Floats]:
    """Of each band, which frequencies it holds; the lower edge belongs to it, the last band's upper one too."""
    last = bands[-1, 1]
    return [(frequencies >= low) & ((frequencies < high) | (high == last)) for low, high in bands]


def _with_disturbances(rig: Rig, sent: Floats, rng: np.random.Generator) -> tuple[Rig, Floats]:
    """The rig without noise, clipping and rounding, its random forces as inputs of their own, drawn anew."""
    sensors = [replace(sensor, limit=np.inf, step=0.0) for sensor in rig.sensors]
    random = [element for element in rig.elements if isinstance(element, RandomForce)]
    others = [element for element in rig.elements if not isinstance(element, RandomForce)]
    ports = [Actuator(f"random force {i + 1}", element.at, direct=True) for i, element in enumerate(random)]
    forces = [element.rms * rng.standard_normal(sent.shape[1]) for element in random]
    whole = replace(rig, sensors=tuple(sensors), elements=tuple(others), actuators=(*rig.actuators, *ports))
    return whole, np.vstack([sent, *forces])


def _unexplained(truth: Floats, share: float, frequencies: Floats, bands: Floats, rng: np.random.Generator) -> Floats:
    """Δ y of a relative error Δ with E|Δ|² = share², of its own for each sensor and frequency band."""
    if share == 0:
        return np.zeros_like(truth)
    error = np.zeros((truth.shape[0], frequencies.size), complex)
    for band in _members(frequencies, bands):
        error[:, band] = (rng.standard_normal((truth.shape[0], 2)) @ np.array([[1.0], [1.0j]])) * share / np.sqrt(2.0)
    return np.asarray(np.fft.irfft(error * np.fft.rfft(truth, axis=1), truth.shape[1], axis=1))


def _read(truth: Floats, rig: Rig, noise: Floats, rng: np.random.Generator) -> Floats:
    """Readings of the truth (..., n_outputs, n_samples): noise, then clipping, then rounding."""
    reading = truth + noise[:, None] * rng.standard_normal(truth.shape)
    for j, sensor in enumerate(rig.sensors):
        reading[..., j, :] = np.clip(reading[..., j, :], -sensor.limit, sensor.limit)
        if sensor.step > 0:
            reading[..., j, :] = sensor.step * np.round(reading[..., j, :] / sensor.step)
    return reading


def _over_time(truths: Floats, rig: Rig, noise: Floats, rng: np.random.Generator) -> list[Floats]:
    """Quantiles (n_outputs, n_samples) of the readings of all draws, sensor by sensor."""
    rows = []
    for j, sensor in enumerate(rig.sensors):
        one = replace(rig, sensors=(sensor,))
        readings = [_read(truths[:, [j]], one, noise[[j]], rng)[:, 0] for _ in range(NOISES)]
        rows.append(np.quantile(np.concatenate(readings), QUANTILES, axis=0, method="weibull"))
    return list(np.array(rows).transpose(1, 0, 2))
