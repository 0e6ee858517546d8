"""Modes from what went in and what came out, whatever the excitation.

What each pole answers is known sample by sample (`known_inputs.py`); all of it is fitted at once as `modal_fit` says:
output error, most likely where the noise is the sensors' and normal. How that noise runs along frequency is learnt from
what the modes leave, and they from it in turn (`noise_course.py`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import control
import numpy as np

from workbench.identification.free_decay.ibrahim import check_alike, normalised_shapes
from workbench.identification.free_decay.identified import FALSE_ALARM
from workbench.identification.input_output.fit_errors import errors, fixed_std, pole_covariance
from workbench.identification.input_output.known_inputs import KnownInputs
from workbench.identification.input_output.modal_fit import Fit, projected, settled
from workbench.identification.input_output.model_order import Told, tell
from workbench.identification.input_output.noise_spectrum import alike
from workbench.identification.signal.standard_errors import StandardErrors
from workbench.identification.signal.synthesis import time_derivatives
from workbench.records.record import Channel, Record
from workbench.structure.modes import SampledModes, frozen
from workbench.threads import one_blas_thread

# Modes by which the noise is first told, and how often it is learnt: it and the modes settle together.
STRONGEST, LEARNT = 8, 4
# Times the limit up to which a mode may be noise that was taken out of the noise.
DOUBTED, MOST_GROWTH = 4.0, 0.5


@dataclass(frozen=True, eq=False)
class Driven(StandardErrors):
    """Modes with what drives them: H(s) = D + Σ_r [c_r l_r^T / (s - λ_r) + conjugate].

    Attributes:
        modes: shapes of displacement, largest entry 1.
        covariance: (2 n_modes, 2 n_modes) of (ω, ζ); in white noise the Cramér-Rao bound at the estimate.
        shape_std: (n_outputs, n_modes) standard error of the real part of each shape.
        participation: (n_modes, n_inputs) complex l_r, for c_r the shape as the outputs measure it, ψ_r λ_r^k with
            k = 0, 1, 2 for displacement, velocity, acceleration.
        participation_std: (n_modes, n_inputs) its standard error, root mean square of real and imaginary part.
        feedthrough: (n_outputs, n_inputs) D: what an acceleration feels at once, and the modes above those found.
        feedthrough_std: (n_outputs, n_inputs).
        initial: one (n_modes,) complex a record: z_r at its first sample, where y = Re Σ 2 c_r z_r; zero if at rest.
        noise: (n_records, n_outputs) standard deviation of what the modes leave, in the unit of each output.
        evidence: (n_modes,) χ² of each mode in the noise.
        limit: what a mode fitted to noise alone exceeds with the chance of a false alarm.
        converged: whether the search ended because the step was small.
        output_channels, input_channels: of the records.
    """

    modes: SampledModes
    covariance: np.ndarray
    shape_std: np.ndarray = field(repr=False)
    participation: np.ndarray = field(repr=False)
    participation_std: np.ndarray = field(repr=False)
    feedthrough: np.ndarray = field(repr=False)
    feedthrough_std: np.ndarray = field(repr=False)
    initial: tuple[np.ndarray, ...] = field(repr=False)
    noise: np.ndarray
    evidence: np.ndarray
    limit: float
    converged: bool
    output_channels: tuple[Channel, ...] = field(repr=False)
    input_channels: tuple[Channel, ...] = field(repr=False)

    @property
    def noise_std(self) -> np.ndarray:
        """Of each output (n_outputs,), root mean square over the records."""
        return np.sqrt((self.noise**2).mean(axis=0))

    @property
    def residues(self) -> np.ndarray:
        """c_r l_r^T, (n_modes, n_outputs, n_inputs) complex."""
        return np.einsum("jr,ri->rji", self._measured_shapes, self.participation)

    @property
    def _measured_shapes(self) -> np.ndarray:
        return self.modes.shapes * self.modes.poles ** time_derivatives(self.output_channels)[:, None]

    @property
    def state_space(self) -> control.StateSpace:
        """The model from inputs to outputs in real modal form, two states a mode, with the names of the record.

        z = re + i im of each mode: A has blocks [[Re λ, -Im λ], [Im λ, Re λ]], and y = Re Σ 2 c z + D u.
        """
        n, poles = self.modes.n_modes, self.modes.poles
        a = np.zeros((2 * n, 2 * n))
        even, odd = 2 * np.arange(n), 2 * np.arange(n) + 1
        a[even, even] = a[odd, odd] = poles.real
        a[even, odd], a[odd, even] = -poles.imag, poles.imag
        b = np.stack([self.participation.real, self.participation.imag], axis=1).reshape(2 * n, -1)
        c = 2.0 * self._measured_shapes
        c = np.stack([c.real, -c.imag], axis=2).reshape(c.shape[0], 2 * n)
        return control.ss(
            a,
            b,
            c,
            self.feedthrough,
            inputs=[channel.name for channel in self.input_channels],
            outputs=[channel.name for channel in self.output_channels],
            states=[f"{part}{r + 1}" for r in range(n) for part in ("re", "im")],
            name="identified",
        )

    def initial_state(self, record: int = 0) -> np.ndarray:
        """States of `state_space` at the first sample of a record, (2 n_modes,)."""
        z = self.initial[record]
        return np.stack([z.real, z.imag], axis=1).ravel()


@one_blas_thread
def identify_driven(
    records: Record | Sequence[Record],
    *,
    at_rest: bool = False,
    straight: bool = False,
    feedthrough: bool = True,
    most_modes: int = 40,
    false_alarm: float = FALSE_ALARM,
) -> Driven:
    """The modes that inputs and outputs show, as many as there are, with shapes, participation and standard errors.

    Any excitation serves that moves the modes: noise, multisine, PRBS, a blow. Each mode enters if it raises the
    likelihood by more than noise would in one record of a thousand.

    Args:
        records: with the same inputs and outputs at one rate; each output may hold a constant, another in each record.
        at_rest: that nothing moves at the first sample; otherwise each record has an initial state of its own.
        straight: whether inputs run straight from sample to sample, as measured signals through a filter nearly do;
            otherwise they are held over each sample interval, as a converter gives them.
        feedthrough: whether outputs may also feel inputs at once: accelerations do, and the modes beyond the sample
            rate look so to every sensor.
        most_modes: where to stop at the latest.
        false_alarm: chance that noise alone is taken for a mode.

    Returns:
        `Driven`. Its standard errors hold in noise of any smooth spectrum.

    Raises:
        ValueError: no inputs, inputs that never move or move alike; records that differ; too few samples; no mode.
    """
    records = [records] if isinstance(records, Record) else list(records)
    check_alike(records)
    _check_inputs(records)
    drive = KnownInputs(records, at_rest=at_rest, straight=straight, feedthrough=feedthrough)
    rows, columns = drive.fixed.shape
    if rows < columns + 4 * (drive.n_drives + 2):
        raise ValueError(
            f"record {records[0].name!r}: {rows} samples are too few for {records[0].n_inputs} inputs; measure longer"
        )
    drive, told = _told(drive, most_modes=min(most_modes, (rows - columns) // 6), false_alarm=false_alarm)
    if told.fit.poles.size == 0:
        raise ValueError(
            f"record {records[0].name!r}: no mode between inputs {', '.join(records[0].input_names)} and outputs"
            f" {', '.join(records[0].output_names)} rises above the noise; excite harder or longer, or look whether"
            " inputs and outputs belong together"
        )
    return _report(records, drive, told)


def _told(drive: KnownInputs, **how) -> tuple[KnownInputs, Told]:
    """The modes, in the noise that they leave; the strongest first, for noise that is not white passes for modes.

    What a false mode took out of its lines, their noise lacks, and so the mode seems true. So the noise is learnt anew
    with all doubtful modes left in it; they stay if modes and noise are then less likely by what so many modes take.
    """
    few = {**how, "most_modes": min(STRONGEST, how["most_modes"])}
    drive, told = _with_noise(drive, tell(drive, **few), few, how)
    doubted = (told.evidence < DOUBTED * told.limit) | ~_rings(drive, told)
    if drive.sizes is None or not doubted.any():
        return drive, told
    sure = settled(drive, projected(drive, told.fit.poles[~doubted], told.fit.loads[~doubted]))
    other = drive.weighing(drive.course(sure))
    other, fewer = _with_noise(other, tell(other, **how), how, how)
    worth = told.limit * (told.fit.poles.size - fewer.fit.poles.size)
    strange = (~_rings(drive, told)).sum() > (~_rings(other, fewer)).sum()
    return (other, fewer) if strange or other.cost(fewer.fit) - drive.cost(told.fit) <= worth else (drive, told)


def _rings(drive: KnownInputs, told: Told) -> np.ndarray:
    """Which modes swing within a record and hardly grow; what else comes in may be noise that is not white."""
    poles, span = told.fit.poles, 2.0 * np.pi / drive.resolution
    return (np.abs(poles) > drive.resolution) & (poles.real * span < MOST_GROWTH)


def _with_noise(drive: KnownInputs, told: Told, once: dict, how: dict) -> tuple[KnownInputs, Told]:
    """Modes and noise that leave each other as they are; `once` is how `told` was told."""
    for _ in range(LEARNT):
        sizes = drive.course(told.fit)
        if alike(sizes, drive.sizes) and not (told.full and once["most_modes"] < how["most_modes"]):
            break
        drive, once = drive.weighing(sizes), how
        told = tell(drive, **how)
    return drive, told


def _check_inputs(records: Sequence[Record]) -> None:
    first = records[0]
    if first.n_inputs == 0:
        raise ValueError(f"record {first.name!r} has no inputs; of a free decay `identify` finds the modes")
    for record in records[1:]:
        if record.input_names != first.input_names:
            raise ValueError(
                f"records identified together must have the same inputs; {first.name!r} has"
                f" {', '.join(first.input_names)} and {record.name!r} has {', '.join(record.input_names)}"
            )
    inputs = np.hstack([record.inputs for record in records])
    size = np.linalg.norm(inputs, axis=1)
    if (size == 0).any():
        name = first.input_names[int(np.argmin(size))]
        raise ValueError(f"record {first.name!r}: input {name!r} is zero throughout; leave it out, or excite there")
    alike = (inputs / size[:, None]) @ (inputs / size[:, None]).T - np.eye(len(size))
    i, k = np.unravel_index(int(np.argmax(np.abs(alike))), alike.shape)
    if abs(alike[i, k]) > 1.0 - 1e-9:
        raise ValueError(
            f"inputs {first.input_names[i]!r} and {first.input_names[k]!r} are the same signal but for its size, so"
            " what each does cannot be told; excite them one after the other, or by signals of their own"
        )


def _report(records: Sequence[Record], drive: KnownInputs, told: Told) -> Driven:
    fit: Fit = told.fit
    channels, n_inputs = records[0].output_channels, records[0].n_inputs
    derivative = time_derivatives(channels)[:, None]
    n = fit.poles.size
    seen = fit.amplitudes / fit.poles**derivative
    shapes = normalised_shapes(seen)
    largest = np.abs(seen).argmax(axis=0)
    each = np.arange(n)
    # y = Re Σ a z and H = Σ a l / 2 (s - λ) + conjugate: what the shape loses by its normalisation the loads take up.
    scale = 0.5 * seen[largest, each] / shapes[largest, each]
    loads = fit.loads * scale[:, None]

    def figures(poles, loads, amplitudes):
        seen = amplitudes / poles**derivative
        relative = seen / seen[largest, each]
        driven = (loads * (0.5 * seen[largest, each] / shapes[largest, each])[:, None])[:, :n_inputs]
        return np.concatenate([relative.real.ravel(), driven.real.ravel(), driven.imag.ravel()])

    heard, beside = drive.heard(fit)
    std = np.sqrt(np.diag(errors(fit, figures, heard)))
    m = len(channels)
    shape_std = std[: m * n].reshape(m, n)
    shape_std[largest, each] = 0.0
    real, imaginary = std[m * n :].reshape(2, n, n_inputs)
    direct = np.zeros((m, n_inputs))
    direct_std = np.zeros((m, n_inputs))
    if drive.feedthrough:
        direct = fit.coefficients[2 * n : 2 * n + n_inputs].T
        direct_std = fixed_std(fit, heard, beside)[:n_inputs].T
    return Driven(
        modes=SampledModes(np.abs(fit.poles), -fit.poles.real / np.abs(fit.poles), shapes, records[0].positions),
        covariance=frozen(pole_covariance(fit, heard)),
        shape_std=frozen(shape_std),
        participation=frozen(loads[:, :n_inputs], complex),
        participation_std=frozen(np.sqrt(0.5 * (real**2 + imaginary**2))),
        feedthrough=frozen(direct),
        feedthrough_std=frozen(direct_std),
        initial=tuple(
            frozen(np.zeros(n) if drive.at_rest else loads[:, n_inputs + k], complex) for k in range(len(records))
        ),
        noise=frozen(drive.noise(fit)),
        evidence=frozen(told.evidence),
        limit=told.limit,
        converged=fit.converged,
        output_channels=channels,
        input_channels=records[0].input_channels,
    )
