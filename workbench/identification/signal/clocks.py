"""Signs of clocks that differ: shapes that the delay of an output makes complex, and modes that come in pairs.

A delay τ of sensor j multiplies its entries s_jr of the shapes by e^{-λ_r τ}: their phase grows with frequency. An
output or record of another sample rate has all frequencies in one ratio to those of the others.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from workbench.arrays import Floats
from workbench.identification.signal.modal_estimates import SURE, ModalEstimates, ShapeEstimates
from workbench.identification.signal.searches import FALSE_ALARM
from workbench.structure.modes import SampledModes


@dataclass(frozen=True)
class ClocksSettings:
    """Constants of the search for delayed sensors."""

    min_shape_distance: float = 0.1  # of a complex shape from the nearest real one, relative to its norm
    max_delay_periods: float = 4.0  # of the highest mode
    steps_per_period: int = 200  # trial delays
    min_shape_entry: float = 0.1  # whose phase counts, relative to the norm of the shape
    min_phase: float = 0.1  # rad rms; of complex residues
    min_refined_phase: float = 0.01  # rad rms; likewise, once a delay was found
    max_rate_difference: float = 0.01  # relative difference of frequencies that is attributed to sample rates
    # that a delay by chance reduces the small phases of damped modes so far
    chance_probability: float = 0.01


CLOCKS = ClocksSettings()


def far_from_real(modes: SampledModes) -> np.ndarray:
    """Distance of each shape from the nearest real shape over its norm, (n_modes,): 0 if real, 0.71 at most.

    Its square is ½ (1 - MPC^½), MPC the modal phase collinearity.
    """
    return np.sqrt(0.5 * np.maximum(1.0 - np.sqrt(modes.phase_collinearity), 0.0))


def shape_errors(estimates: ShapeEstimates) -> np.ndarray:
    """Standard error of the real part of each shape over the norm of the shape, (n_modes,)."""
    return np.asarray(np.linalg.norm(estimates.shape_std, axis=0) / np.linalg.norm(estimates.modes.shapes, axis=0))


def are_far(far: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Indices of modes whose relative distance from the nearest real one, (n_modes,), exceeds its error."""
    return np.flatnonzero(far > np.maximum(CLOCKS.min_shape_distance, SURE * error))


def shape_remarks(estimates: ShapeEstimates, names: Sequence[str], only: Sequence[int]) -> tuple[str, ...]:
    """A remark where shapes are complex beyond their errors; it names a delayed sensor where that is the cause.

    `only` are the modes to examine, from 0.
    """
    far = far_from_real(estimates.modes)
    which = np.intersect1d(only, are_far(far, shape_errors(estimates))).tolist()
    if not which:
        return ()
    late = _delayed_sensor(estimates.modes.select(list(only)))
    if late is None:
        which_modes = ("mode " if len(which) == 1 else "modes ") + ", ".join(str(r + 1) for r in which)
        return (
            f"{which_modes}: the shape is complex, up to {100 * far[which].max():.0f} % from the nearest real one:"
            " sensors not sampled simultaneously, close modes, or non-proportional damping",
        )
    j, seconds = late
    side = "late" if seconds > 0 else "early"
    return (
        f"output {names[j]!r} is {abs(1e3 * seconds):.3g} ms {side} relative to the others, by its phase in every mode:"
        " correct its time, or its part of the shapes is wrong",
    )


def _delayed_sensor(modes: SampledModes) -> tuple[int, float] | None:
    """The sensor whose delay explains the complexity of all shapes, and the delay, s; None where it may be chance.

    A delay agrees with the phases of n modes to within δ by chance with probability (2 δ / π)^n, and up to a time T
    there are T ω / δ distinct delays.
    """
    omega, candidates = modes.poles.imag, []
    for j, own in enumerate(modes.shapes):
        visible = np.abs(own) > CLOCKS.min_shape_entry * np.linalg.norm(modes.shapes, axis=0)
        if np.count_nonzero(visible) < 2:
            continue
        phases = np.angle(own) - 0.5 * np.angle((np.delete(modes.shapes, j, axis=0) ** 2).sum(axis=0))
        seconds, chance = _delay_of_phases(phases[visible], omega[visible], omega.max())
        candidates.append((chance * modes.n_outputs, j, seconds))
    chance, j, seconds = min(candidates, default=(1.0, 0, 0.0))
    if chance > FALSE_ALARM:
        return None
    corrected = modes.shapes.copy()
    corrected[j] *= np.exp(modes.poles * seconds)
    if (far_from_real(replace(modes, shapes=corrected)) > CLOCKS.min_shape_distance).any():
        return None
    return j, seconds


def clock_remarks(estimates: ModalEstimates, only: Sequence[int]) -> tuple[str, ...]:
    """A remark where all modes, sorted by frequency, form pairs of equal damping and one ratio of frequencies: the
    sample rates differ. `only` are the modes to examine, from 0."""
    if len(only) < 4 or len(only) % 2:
        return ()
    both = estimates.modes.omega, estimates.modes.zeta, estimates.omega_std, estimates.zeta_std
    omega, zeta, omega_std, zeta_std = (values[list(only)].reshape(-1, 2).T for values in both)
    ratio, error = omega[1] / omega[0] - 1.0, np.hypot(*(omega_std / omega))
    mean = np.average(ratio, weights=error**-2)
    separate = (SURE * error < ratio) & (ratio < CLOCKS.max_rate_difference)
    alike = (np.abs(ratio - mean) < SURE * error) & (np.abs(np.diff(zeta, axis=0)[0]) < SURE * np.hypot(*zeta_std))
    if not (separate & alike).all():
        return ()
    return (
        f"modes come in pairs whose frequencies all differ by {100.0 * mean:.2g} %: does the sample rate of an output"
        " or a record differ by so much? Resample it to that of the others: each pair is then one mode",
    )


def late_outputs(residues: np.ndarray, poles: np.ndarray, least: float = CLOCKS.min_phase) -> Floats:
    """Delay of each output relative to the inputs, (n_outputs,) s; 0 where the phases of its modes do not show one.

    One delay for all outputs is tried first, then one for each. Neighbours within a half-power bandwidth count as one
    mode: a delayed direct term adds spurious modes near the true ones.

    Args:
        residues: (n_modes, n_outputs, n_inputs) of displacement, times i: real for real modes without delay.
        poles: (n_modes,) rad/s.
        least: rad rms, least phase of the residues of a delayed output.
    """
    order = np.argsort(poles.imag)
    width = -2.0 * np.minimum(poles.real[order][1:], poles.real[order][:-1])
    first = np.flatnonzero(np.r_[True, np.diff(poles.imag[order]) > width])
    omega = np.add.reduceat(poles.imag[order], first) / np.diff(np.r_[first, poles.size])
    merged = np.add.reduceat(residues[order], first)
    sizes = np.linalg.norm(merged, axis=2)
    share = sizes / np.linalg.norm(sizes, axis=1, keepdims=True)
    squares = (merged**2).sum(axis=2)  # their phase is twice that of a residue, whatever its sign

    def delay_of(which: np.ndarray, at: np.ndarray) -> float:
        """The common delay of some outputs, from the modes `at`; 0 where it is not significant in all of them."""
        if np.count_nonzero(at) < 2:
            return 0.0
        phases = 0.5 * np.angle(squares[:, which].sum(axis=1))
        seconds, chance = _delay_of_phases(phases[at], omega[at], omega.max())
        errors = np.angle(squares[:, which, None] * np.exp(2j * omega[:, None, None] * [0.0, seconds])) / 2.0
        weights = share[:, which, None] ** 2 * at[:, None, None]
        before, after = np.sqrt((weights * errors**2).sum(axis=(0, 1)) / weights.sum())
        significant = chance * squares.shape[1] < FALSE_ALARM and before > least
        by_chance = CLOCKS.chance_probability ** (1.0 / (np.count_nonzero(at) - 1))
        small = after < CLOCKS.min_phase and after < by_chance * before
        return seconds if significant and small else 0.0

    each = np.arange(squares.shape[1])
    together = delay_of(each, np.ones(omega.size, bool))
    if together:
        return np.full(each.size, together)
    return np.array([delay_of(each[j : j + 1], share[:, j] > CLOCKS.min_shape_entry) for j in each])


def _delay_of_phases(phases: np.ndarray, omega: np.ndarray, fastest: float) -> tuple[float, float]:
    """The delay, s, that fits phases (n_modes,) modulo π best, and the probability of such a fit by chance."""
    longest = CLOCKS.max_delay_periods * 2.0 * np.pi / fastest
    times = np.linspace(-longest, longest, int(2 * CLOCKS.max_delay_periods * CLOCKS.steps_per_period) + 1)
    coarse = times[np.argmin(_phase_error(phases, omega, times))]
    fine = coarse + np.linspace(-1.0, 1.0, 2 * CLOCKS.steps_per_period + 1) * (times[1] - times[0])
    errors = _phase_error(phases, omega, fine)
    seconds = float(fine[np.argmin(errors)])
    delta = max(float(errors.min()), (fine[1] - fine[0]) * fastest)
    return seconds, (1.0 + abs(seconds) * fastest / delta) * (2.0 * delta / np.pi) ** phases.size


def _phase_error(phases: np.ndarray, omega: np.ndarray, delays: np.ndarray) -> np.ndarray:
    """Largest phase over the modes, modulo π, after correction by each of some delays, (n_delays,) rad."""
    remaining = np.abs(np.angle(np.exp(2j * (phases + np.outer(delays, omega)))))
    return np.asarray(0.5 * remaining.max(axis=1))
