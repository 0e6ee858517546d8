"""Types of modal estimates with standard errors, how they are printed, and remarks on neighbouring modes."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.special import ndtri

from workbench.records.record import Channel
from workbench.renamed import Renamed
from workbench.rig.sensors import MEASURED
from workbench.structure.modes import SampledModes, frozen
from workbench.structure.printed import Printed, counted

# Two neighbours are one mode of two set-ups if their frequencies differ by less than this, relative; if the cosine
# between the moduli of their shapes is less than this (noise makes it 0.01); and if that of participation factors is
# more than this.
NEAR, APART, ALIKE = 0.05, 0.1, 0.9
SURE = 3.0  # number of standard errors that makes a difference significant
HEADINGS = ("mode", "frequency [Hz]", "±", "damping [%]", "±", "phase collinearity")


class ModalEstimates(Printed):
    """Modes with a covariance of (ω_1..ω_n, ζ_1..ζ_n), (2 n_modes, 2 n_modes), and their standard errors."""

    modes: SampledModes
    covariance: np.ndarray

    @property
    def omega_std(self) -> np.ndarray:
        """Standard error of each frequency (n_modes,), rad/s."""
        return np.sqrt(np.diag(self.covariance)[: self.modes.n_modes])

    @property
    def zeta_std(self) -> np.ndarray:
        """Standard error of each damping ratio (n_modes,)."""
        return np.sqrt(np.diag(self.covariance)[self.modes.n_modes :])

    def interval(self, level: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
        """Confidence intervals of ω and of ζ, (2, n_modes) each: lower row, upper row.

        Raises:
            ValueError: a level outside 0..1.
        """
        check_level(level)
        width = float(ndtri(0.5 * (1.0 + level)))
        both = ((self.modes.omega, self.omega_std), (self.modes.zeta, self.zeta_std))
        omega, zeta = (np.stack([value - width * std, value + width * std]) for value, std in both)
        return omega, zeta

    def _remarks(self) -> tuple[str, ...]:
        """What to print below the table."""
        return tuple(getattr(self, "remarks", ()))

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        return "", HEADINGS, tuple(rows_of(self)), self._remarks()

    def __repr__(self) -> str:
        hz = self.modes.frequencies_hz
        first = ", ".join(f"{f:.4g}" for f in hz[:4]) + (", ..." if hz.size > 4 else "")
        return f"{type(self).__name__}({counted(hz.size, 'mode')}{f': {first} Hz' if hz.size else ''})"


@dataclass(frozen=True, eq=False, repr=False)
class ParticipatingModes(ModalEstimates):
    """Modes between inputs and outputs, with a joint covariance of the shape and participation factors of each mode."""

    modes: SampledModes
    covariance: np.ndarray
    vector_covariance: np.ndarray
    participation: np.ndarray

    @property
    def shape_covariance(self) -> np.ndarray:
        """(n_modes, n_outputs, n_outputs) of the real parts of the shapes, over the largest entry of each."""
        return self.vector_covariance[:, : self.modes.n_outputs, : self.modes.n_outputs]

    @property
    def shape_std(self) -> np.ndarray:
        """Standard error of the real part of each shape (n_outputs, n_modes)."""
        return self._vector_std[:, : self.modes.n_outputs].T

    @property
    def participation_std(self) -> np.ndarray:
        """Standard error of participation factors (n_modes, n_inputs), rms of real and imaginary part."""
        real, imaginary = np.split(self._vector_std[:, self.modes.n_outputs :], 2, axis=1)
        return np.asarray(np.sqrt(0.5 * (real**2 + imaginary**2)))

    @property
    def _vector_std(self) -> np.ndarray:
        return np.asarray(np.sqrt(np.diagonal(self.vector_covariance, axis1=1, axis2=2)))


@dataclass(frozen=True, eq=False, repr=False)
class RefinedModes(ModalEstimates):
    """Maximum likelihood modes of free decays, with their standard errors.

    Attributes:
        modes: refined; shapes of displacement, largest entry 1.
        covariance: (2 n_modes, 2 n_modes) of (ω, ζ), the Cramér-Rao bound at the estimate.
        amplitudes: one (n_outputs, n_modes) complex per record: y = Re Σ a_r e^{λ_r (t - t_first)}, in its own units.
        shape_factor, shape_variance: F (n_modes, n_outputs, n_factors) and v (n_modes, n_outputs) of the covariance
            F F^T + diag v of the real parts of the shapes, relative to the largest entry of each (which is 1, without
            error).
        noise: (n_records, n_outputs) standard deviation of the residual, in the unit of each output.
        converged: whether the search ended because the step was negligible.
        steps: number of steps.
    """

    modes: SampledModes
    covariance: np.ndarray
    amplitudes: tuple[np.ndarray, ...]
    shape_factor: np.ndarray
    shape_variance: np.ndarray
    noise: np.ndarray
    converged: bool
    steps: int

    def select(self, which: np.ndarray) -> "RefinedModes":
        """Some of the modes, by index, as they were fitted together with the others."""
        both = np.r_[which, which + self.modes.n_modes]
        return replace(
            self,
            modes=self.modes.select(list(which)),
            covariance=frozen(self.covariance[np.ix_(both, both)]),
            amplitudes=tuple(frozen(each[:, which], complex) for each in self.amplitudes),
            shape_factor=frozen(self.shape_factor[which]),
            shape_variance=frozen(self.shape_variance[which]),
        )

    @cached_property
    def shape_covariance(self) -> np.ndarray:
        """(n_modes, n_outputs, n_outputs) of the real parts of the shapes, over the largest entry of each.

        Computed on demand: that of thousands of outputs fills the memory.
        """
        covariance = np.matmul(self.shape_factor, self.shape_factor.transpose(0, 2, 1))
        np.einsum("rjj->rj", covariance)[:] += self.shape_variance
        covariance.setflags(write=False)
        return np.asarray(covariance)

    @property
    def noise_std(self) -> np.ndarray:
        """Noise of each output (n_outputs,), root mean square over the records."""
        return np.asarray(np.sqrt((self.noise**2).mean(axis=0)))

    @property
    def shape_std(self) -> np.ndarray:
        """Standard error of the real part of each shape (n_outputs, n_modes)."""
        return np.asarray(np.sqrt((self.shape_factor**2).sum(axis=2) + self.shape_variance).T)


class RefinedEstimates(ModalEstimates):
    """A result that contains refined modes and presents their estimates and errors as its own."""

    refined: RefinedModes

    @property
    def modes(self) -> SampledModes:  # type: ignore[override]  # read-only here
        return self.refined.modes

    @property
    def covariance(self) -> np.ndarray:  # type: ignore[override]
        """(2 n_modes, 2 n_modes) of (ω, ζ)."""
        return self.refined.covariance

    @property
    def shape_covariance(self) -> np.ndarray:
        """(n_modes, n_outputs, n_outputs) of the real parts of the shapes, over the largest entry of each."""
        return self.refined.shape_covariance

    @property
    def shape_std(self) -> np.ndarray:
        """Standard error of the real part of each shape (n_outputs, n_modes)."""
        return self.refined.shape_std


ShapeEstimates = RefinedModes | RefinedEstimates | ParticipatingModes  # those with a covariance of the shapes


@dataclass(frozen=True, eq=False, repr=False)
class IdentifiedModes(RefinedEstimates):
    """The modes of a record, and the candidates rejected as noise.

    Attributes:
        refined: the modes, with covariance.
        statistic: (n_modes,) χ² of each mode's amplitudes in the noise, 2 degrees of freedom per signal.
        threshold: value that the strongest mode fitted to white noise alone exceeds with probability `false_alarm`.
        noise_modes: rejected candidates: insignificant, overdamped, or split off another mode.
        noise_statistic: (n_noise,) test statistics of these.
        remarks: on searches that the time limit ended early, among others.
    """

    refined: RefinedModes
    statistic: np.ndarray
    threshold: float
    noise_modes: SampledModes
    noise_statistic: np.ndarray
    remarks: tuple[str, ...] = field(default=())

    evidence, limit, noise_evidence = Renamed("statistic"), Renamed("threshold"), Renamed("noise_statistic")

    def without_artefacts(self, nyquist: float, *, growing: bool = False) -> "IdentifiedModes":
        """Only poles that can be modes (`credible`); the others join `noise_modes`.

        Args:
            nyquist: frequency, rad/s.
            growing: whether poles of negative damping stay.
        """
        zeta_std = np.full(self.modes.n_modes, np.inf) if growing else self.zeta_std
        good = credible(self.modes, self.omega_std, zeta_std, nyquist)
        if good.all() or not good.any():
            return self
        kept, out = np.flatnonzero(good), np.flatnonzero(~good)
        statistic = self.statistic if self.statistic.size else np.zeros(good.size)
        joined = np.r_[self.noise_modes.omega, self.modes.omega[out]]
        order = np.argsort(joined)
        noise_modes = SampledModes(
            joined[order],
            np.r_[self.noise_modes.zeta, self.modes.zeta[out]][order],
            np.hstack([self.noise_modes.shapes, self.modes.shapes[:, out]])[:, order],
            self.modes.positions,
        )
        return replace(
            self,
            refined=self.refined.select(kept),
            statistic=frozen(self.statistic[kept]) if self.statistic.size else self.statistic,
            noise_modes=noise_modes,
            noise_statistic=frozen(np.r_[self.noise_statistic, statistic[out]][order]),
        )


def rows_of(estimates: ModalEstimates) -> Iterator[tuple[str, ...]]:
    """One row per mode under `HEADINGS`, values to the second digit of their standard errors."""
    modes = estimates.modes
    collinearity = modes.phase_collinearity
    for r in range(modes.n_modes):
        frequency = rounded(modes.frequencies_hz[r], estimates.omega_std[r] / (2.0 * np.pi))
        damping = rounded(100 * modes.zeta[r], 100 * estimates.zeta_std[r])
        yield str(r + 1), *frequency, *damping, f"{collinearity[r]:.4f}"


def rounded(value: float, error: float) -> tuple[str, str]:
    """A value and its standard error, both to the second digit of the error."""
    if not (math.isfinite(error) and error > 1e-9 * abs(value)):
        return f"{value:.10g}", f"{error:.1g}"
    digits = max(0, 1 - math.floor(math.log10(error)))
    return f"{value:.{digits}f}", f"{error:.{digits}f}"


def credible(modes: SampledModes, omega_std: np.ndarray, zeta_std: np.ndarray, nyquist: float) -> np.ndarray:
    """Which estimates can be modes, (n_modes,): damping not significantly negative, a significant frequency below
    Nyquist's, rad/s."""
    growing = modes.zeta < -SURE * zeta_std
    return np.asarray(~growing & (omega_std < modes.omega) & (modes.omega < nyquist))


def repeated_remarks(estimates: ModalEstimates) -> tuple[str, ...]:
    """A remark on neighbours of equal frequency and damping within their errors: a repeated root."""
    modes, std = estimates.modes, np.array([estimates.omega_std, estimates.zeta_std])
    differences = np.abs(np.diff([modes.omega, modes.zeta], axis=1))
    equal = (differences < SURE * np.hypot(std[:, :-1], std[:, 1:])).all(axis=0)
    pairs = _neighbours(modes, equal & (differences[0] < (modes.zeta * modes.omega)[:-1]))
    if not pairs:
        return ()
    return (
        f"modes {pairs} may be one repeated root: only the plane of their two shapes is determined; each shape is one"
        " of many in that plane, and need not be real",
    )


def _neighbours(modes: SampledModes, which: np.ndarray) -> str:
    """Pairs of a mode and the next one, in words, where that is so by flag (n_modes - 1,)."""
    return ", ".join(f"{r + 1} and {r + 2} ({modes.frequencies_hz[r]:.4g} Hz)" for r in np.flatnonzero(which).tolist())


def set_up_remarks(estimates: ParticipatingModes) -> tuple[str, ...]:
    """A remark on neighbours that the same inputs excite but that no sensor shows both: one mode in two set-ups.

    Roving sensors load the structure at other places in each set-up and so shift its frequencies. Two different modes
    that an input excites would both be seen by a sensor near that input.
    """
    moduli = np.abs(estimates.modes.shapes.T), np.abs(estimates.participation)
    units = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in moduli)
    of_shapes, of_inputs = (np.array([a @ b for a, b in zip(unit, unit[1:])]) for unit in units)
    omega = estimates.modes.omega
    near = np.abs(np.diff(omega)) < NEAR * omega[:-1]
    pairs = _neighbours(estimates.modes, near & (of_shapes < APART) & (of_inputs > ALIKE))
    if not pairs:
        return ()
    return (
        f"modes {pairs} share no sensor: one mode, measured in two set-ups that load the structure differently? Then"
        " neither has its whole shape, and modal masses are wrong: identify each set-up alone",
    )


def by_poles(poles: np.ndarray) -> np.ndarray:
    """Jacobian ∂(ω, ζ)/∂(x, y) of poles λ = x + iy, (2 n_modes, 2 n_modes).

    dω = (x dx + y dy)/ω, dζ = -(y² dx - x y dy)/ω³.
    """
    x, y, omega = poles.real, poles.imag, np.abs(poles)
    return np.block(
        [[np.diag(x / omega), np.diag(y / omega)], [np.diag(-(y**2) / omega**3), np.diag(x * y / omega**3)]]
    )


def check_level(level: float) -> None:
    """Refuse a confidence level outside 0..1, by a ValueError."""
    if not 0.0 < level < 1.0:
        raise ValueError(f"the level of a confidence interval or band lies between 0 and 1; got {level}")


def check_placed(sampled: SampledModes) -> None:
    """Refuse a sensor without a place, by a ValueError that names it, from 1."""
    if sampled.without_position.any():
        raise ValueError(f"sensor {int(np.argmax(sampled.without_position)) + 1} has no place; give its channel `at`")


def check_finite(shapes: np.ndarray) -> None:
    """Refuse shapes (n_sensors, n_modes) with an entry that is not finite, by a ValueError."""
    if not np.isfinite(shapes).all():
        i, r = np.argwhere(~np.isfinite(shapes))[0]
        raise ValueError(f"shapes must be finite; of mode {r + 1} sensor {i + 1} has {shapes[i, r]}: leave it out")


def normalised_shapes(shapes: np.ndarray) -> np.ndarray:
    """Shapes rotated to be most nearly real, largest entry 1, the first entry of over 0.05 positive.

    A ValueError refuses an entry that is not finite, and a shape that is zero at all sensors.
    """
    check_finite(shapes)
    still = ~np.any(shapes, axis=0)
    if still.any():
        raise ValueError(f"the shape of mode {int(np.argmax(still)) + 1} is zero at all sensors: leave the mode out")
    rotated = shapes * np.exp(-0.5j * np.angle((shapes**2).sum(axis=0)))
    rotated = rotated / np.abs(rotated).max(axis=0)
    first = np.argmax(np.abs(rotated.real) > 0.05, axis=0)
    return np.asarray(rotated * np.where(rotated.real[first, np.arange(rotated.shape[1])] < 0, -1.0, 1.0))


def time_derivatives(channels: Sequence[Channel]) -> np.ndarray:
    """Order of the time derivative each channel measures, (n_channels,); 0 where its quantity is not a motion."""
    return np.array([MEASURED.get(channel.quantity, (0, 0))[1] for channel in channels])
