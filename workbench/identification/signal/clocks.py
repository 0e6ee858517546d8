"""Complex shapes: how far each is from real, and the outputs that are late, which makes them so.

What a sensor records τ late has its entries of the shapes, s_jr, turned by e^{-λ_r τ}: the phase grows with frequency.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from workbench.arrays import Floats
from workbench.identification.signal.modal_estimates import SURE, ShapeEstimates
from workbench.identification.signal.searches import FALSE_ALARM
from workbench.structure.modes import SampledModes


@dataclass(frozen=True)
class ClocksSettings:
    """Constants of the search for a sensor that is late."""

    far: float = 0.1  # of a shape's size: what its nearest real one leaves, from which on it is remarked
    periods: float = 4.0  # of the fastest mode: the longest time that a sensor is taken to be late
    steps: int = 200  # of each period
    least: float = 0.1  # of a shape's size: an entry that has a phase
    phase: float = 0.1  # rad rms: of residues, from which on they are not real
    refined: float = 0.01  # rad rms: likewise, where outputs were found late before
    small: float = 0.01  # chance that small phases, as damping makes them, leave as little once put in time


CLOCKS = ClocksSettings()


def far_from_real(modes: SampledModes) -> np.ndarray:
    """Share of each shape's size that the nearest real shape leaves, (n_modes,): 0 of a real one, 0.71 at most.

    Of Σ |s_j|² the best phase leaves ½ (1 - MPC^½), MPC the phase collinearity.
    """
    return np.sqrt(0.5 * np.maximum(1.0 - np.sqrt(modes.phase_collinearity), 0.0))


def shape_errors(found: ShapeEstimates) -> np.ndarray:
    """Standard error of each shape's real part over its size, (n_modes,)."""
    return np.asarray(np.linalg.norm(found.shape_std, axis=0) / np.linalg.norm(found.modes.shapes, axis=0))


def are_far(far: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Modes, from 0, of which the nearest real one leaves a share, (n_modes,), beyond what errors (n_modes,) make."""
    return np.flatnonzero(far > np.maximum(CLOCKS.far, SURE * error))


def shape_remarks(found: ShapeEstimates, names: Sequence[str], only: Sequence[int]) -> tuple[str, ...]:
    """A remark where shapes are far from real, beyond their errors; it names the sensor that is late, if one is.

    Args:
        found: modes, and the covariance of their shapes.
        names: (n_outputs,) of the sensors.
        only: the modes to look at, from 0.
    """
    far = far_from_real(found.modes)
    which = np.intersect1d(only, are_far(far, shape_errors(found))).tolist()
    if not which:
        return ()
    late = _late(found.modes.select(list(only)))
    if late is None:
        which_modes = ("mode " if len(which) == 1 else "modes ") + ", ".join(str(r + 1) for r in which)
        return (
            f"{which_modes}: the shape is complex, the nearest real one leaves up to {100 * far[which].max():.0f} %:"
            " sensors that are not on one clock, close modes, or damping that is not proportional",
        )
    j, seconds = late
    side = "late" if seconds > 0 else "early"
    return (
        f"output {names[j]!r} is {abs(1e3 * seconds):.3g} ms {side} beside the others, by its phase in every mode: put"
        " it on their clock, or its part of the shapes is wrong",
    )


def _late(modes: SampledModes) -> tuple[int, float] | None:
    """The sensor that makes all shapes real once it is put right, and how late it is, s; None where it may be chance.

    A lateness agrees with the phases of n modes to δ by chance in (2 δ / π)^n, and up to a time T there are T ω / δ of
    them to choose from.
    """
    omega, poles, n_outputs = modes.poles.imag, modes.poles, modes.n_outputs
    best: tuple[float, int, float] | None = None
    for j in range(n_outputs):
        own, others = modes.shapes[j], np.delete(modes.shapes, j, axis=0)
        seen = np.abs(own) > CLOCKS.least * np.linalg.norm(modes.shapes, axis=0)
        if np.count_nonzero(seen) < 2:
            continue
        turn = np.angle(own) - 0.5 * np.angle((others**2).sum(axis=0))
        seconds, chance = _lateness(turn[seen], omega[seen], omega.max())
        chance *= n_outputs
        if best is None or chance < best[0]:
            best = chance, j, seconds
    if best is None or best[0] > FALSE_ALARM:
        return None
    _, j, seconds = best
    right = modes.shapes.copy()
    right[j] *= np.exp(poles * seconds)
    if (far_from_real(SampledModes(modes.omega, modes.zeta, right, modes.positions)) > CLOCKS.far).any():
        return None
    return j, seconds


def late_outputs(residues: np.ndarray, poles: np.ndarray, least: float = CLOCKS.phase) -> Floats:
    """By how much each output is late beside the inputs, (n_outputs,) s; 0 where the phases of its modes do not tell.

    One time for all outputs is looked for first, then one for each. Neighbours within a half-power bandwidth count as
    one mode: what a delay leaves of a direct term is fitted by modes beside the true ones.

    Args:
        residues: (n_modes, n_outputs, n_inputs) of displacement, times i: real, of real modes in time.
        poles: (n_modes,).
        least: rad rms, phase of residues from which on an output may be late.
    """
    order = np.argsort(poles.imag)
    width = -2.0 * np.minimum(poles.real[order][1:], poles.real[order][:-1])
    first = np.flatnonzero(np.r_[True, np.diff(poles.imag[order]) > width])
    omega = np.add.reduceat(poles.imag[order], first) / np.diff(np.r_[first, poles.size])
    joined = np.add.reduceat(residues[order], first)
    sizes = np.linalg.norm(joined, axis=2)
    share = sizes / np.linalg.norm(sizes, axis=1, keepdims=True)
    squares = (joined**2).sum(axis=2)  # of the phase twice that of a residue, whatever its sign

    def late(which: np.ndarray, at: np.ndarray) -> float:
        """That of the sum of some outputs, where all of them agree, by the modes `at` which it is asked."""
        if np.count_nonzero(at) < 2:
            return 0.0
        turn = 0.5 * np.angle(squares[:, which].sum(axis=1))
        seconds, chance = _lateness(turn[at], omega[at], omega.max())
        off = np.angle(squares[:, which, None] * np.exp(2j * omega[:, None, None] * [0.0, seconds])) / 2.0
        weights = share[:, which, None] ** 2 * at[:, None, None]
        before, after = np.sqrt((weights * off**2).sum(axis=(0, 1)) / weights.sum())
        told = chance * squares.shape[1] < FALSE_ALARM and before > least
        small = after < CLOCKS.phase and after < CLOCKS.small ** (1.0 / (np.count_nonzero(at) - 1)) * before
        return seconds if told and small else 0.0

    each = np.arange(squares.shape[1])
    together = late(each, np.ones(omega.size, bool))
    return (
        np.full(each.size, together)
        if together
        else np.array([late(each[j : j + 1], share[:, j] > CLOCKS.least) for j in each])
    )


def _lateness(turn: np.ndarray, omega: np.ndarray, fastest: float) -> tuple[float, float]:
    """The time, s, that phases (n_modes,) modulo π are nearest to, and the chance that they are by chance."""
    longest = CLOCKS.periods * 2.0 * np.pi / fastest
    times = np.linspace(-longest, longest, int(2 * CLOCKS.periods * CLOCKS.steps) + 1)
    coarse = times[np.argmin(_disagreement(turn, omega, times))]
    fine = coarse + np.linspace(-1.0, 1.0, 2 * CLOCKS.steps + 1) * (times[1] - times[0])
    apart = _disagreement(turn, omega, fine)
    seconds = float(fine[np.argmin(apart)])
    delta = max(float(apart.min()), (fine[1] - fine[0]) * fastest)
    return seconds, (1.0 + abs(seconds) * fastest / delta) * (2.0 * delta / np.pi) ** turn.size


def _disagreement(turn: np.ndarray, omega: np.ndarray, late: np.ndarray) -> np.ndarray:
    """Largest phase over the modes, modulo π, that is left of `turn` (n_modes,) once put right, (n_late,) rad."""
    left = np.abs(np.angle(np.exp(2j * (turn + np.outer(late, omega)))))
    return np.asarray(0.5 * left.max(axis=1))
