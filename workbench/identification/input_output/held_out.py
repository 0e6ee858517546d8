"""Cross-validation: modes that do not predict held-out data are removed.

The distortion of a nonlinear structure is not sensor noise: it appears in the lines about a resonance, often far above
the noise floor, and modes fitted to these lines explain them there alone. So the modes are fitted to the first half of
each record and extrapolated through the second half, with and without the weaker modes about each stronger one. True
modes improve the prediction, over-fitted ones make it worse.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.stats import f as variance_ratio

from workbench.arrays import Flags, Floats
from workbench.identification.input_output.known_inputs import KnownInputs
from workbench.identification.input_output.modal_fit import Fit, columns, only, projected, settled
from workbench.identification.input_output.time_variance import CHANGING, IS_MEAN, named_near
from workbench.identification.signal.searches import FALSE_ALARM, SELECTION, TimeLimit
from workbench.records.record import Record


@dataclass(frozen=True)
class HeldOutSettings:
    """Constants of the prediction of held-out data."""

    # ratio of the squared errors without and with these modes, below which they are removed. In sensor noise alone the
    # removal of true modes multiplies the error, and that of needless ones changes it by less than a tenth
    max_error_ratio: float = 0.8
    min_half_share: float = 0.1  # share of the energy of the stronger mode that either half must hold
    rows_per_column: int = 4  # samples of a half for each column of a fit, at least
    # mean residual power near the modes over the median of all lines, and over the mean below or above them, that it
    # must exceed. Smaller residuals are noise; two modes a line apart, which half a record cannot resolve, may be true
    min_residual_ratio: float = 10.0
    degrees_per_line: float = 4.0 / 3.0  # of freedom of a line with Hann's window, which correlates neighbours
    # of the power of the outputs: a mode below it, without others about it, is tested as a line
    faint_share: float = 0.01
    # of the response about a mode, 3 % of its amplitude: a larger residual is remarked
    min_share: float = 1e-3
    # of the largest residual about any mode, likewise: least squares spread up to 0.01 of it
    peak_share: float = 0.03


HELD_OUT = HeldOutSettings()


def without_unpredictive(
    data: KnownInputs, fit: Fit, strength: Floats, time_limit: TimeLimit
) -> tuple[Fit, tuple[complex, ...]]:
    """The fit without modes that make the prediction worse, and the poles of the stronger modes these stood about.

    The weaker modes, by their statistic `strength`, about each stronger one are tested together. Then faint modes that
    are undamped within the record are tested one by one: each fits a single line.
    """
    n, omega = fit.poles.size, fit.poles.imag
    reach = CHANGING.frequency_range * omega
    weaker_near = (np.abs(np.subtract.outer(omega, omega)) < reach[:, None]) & (strength < strength[:, None])
    undamped = -fit.poles.real < 0.5 * data.resolution
    shortest = min(record.n_samples // 2 for record in data.records)
    if n < 2 or not (weaker_near.any() or undamped.any()) or shortest <= data.first:
        return fit, ()
    whole = replace(data, line_std=None, beside=None, changing=())
    half = replace(whole, records=[_first_half(record) for record in whole.records])
    too_short = len(half.values) < HELD_OUT.rows_per_column * (2 * n + half.fixed.shape[1])
    if too_short or half.fixed.shape[1] != whole.fixed.shape[1]:  # inputs that are zero throughout a first half
        return fit, ()
    all_modes = projected(whole, fit.poles, fit.participation)
    noise, residual_of_all = all_modes.noise, _ResidualSpectra(whole, all_modes)

    @cache
    def prediction_error(kept: tuple[int, ...]) -> list[Floats] | None:
        """Power of the prediction error in the second half of each record, (n_lines,), in units of the noise."""
        try:
            start = projected(half, fit.poles[list(kept)], fit.participation[list(kept)])
            first_half = settled(half, start, SELECTION.trial_steps, time_limit)
            with np.errstate(over="ignore", invalid="ignore"):
                predicted = columns(whole, first_half.poles, first_half.participation)[0] @ first_half.coefficients
                errors = whole.as_samples((whole.values - predicted) / noise)
        except np.linalg.LinAlgError:
            return None
        seconds = [each[n_first:] for each, n_first in zip(errors, half.lengths, strict=True)]
        if not all(np.isfinite(each).all() for each in seconds):
            return None
        return [_power(each) for each in seconds]

    def error(kept: Flags, lowest: float, highest: float) -> float:
        """Squared prediction error in the lines between two frequencies, rad/s."""
        powers = prediction_error(tuple(np.flatnonzero(kept).tolist()))
        return np.inf if powers is None else float(_between(powers, whole.highest, lowest, highest).sum())

    kept, distorted = np.ones(n, bool), []
    tries = [(r, weaker_near[r]) for r in np.argsort(-strength)]
    tries += [(r, np.arange(n) == r) for r in np.argsort(strength) if undamped[r] and _is_faint(whole, all_modes, r)]
    for r, modes in tries:
        group = kept & modes
        if not (kept[r] and group.any() and (kept & ~group).any() and _is_in_both(whole, fit, r)):
            continue
        if time_limit.spent("check of modes by what they predict"):
            break
        band = omega[group].min() - 0.5 * reach[r], omega[group].max() + 0.5 * reach[r]
        if not residual_of_all.stands_out(*band):
            continue
        if error(kept & ~group, *band) < HELD_OUT.max_error_ratio * error(kept, *band):
            kept &= ~group
            if kept[r]:
                distorted.append(complex(fit.poles[r]))
    if kept.all():
        return fit, ()
    return settled(data, only(data, fit, kept), SELECTION.trial_steps, time_limit), tuple(distorted)


def _first_half(record: Record) -> Record:
    n = record.n_samples // 2
    return replace(record, outputs=record.outputs[:, :n], inputs=record.inputs[:, :n])


def _is_in_both(data: KnownInputs, fit: Fit, r: int) -> bool:
    """Whether both halves of the records hold a fair share of the energy of mode r."""
    powers = [np.abs(z) ** 2 for z in data.modal_coordinate(fit.poles[r], fit.participation[r])]
    halves = [(float(power[: power.size // 2].sum()), float(power[power.size // 2 :].sum())) for power in powers]
    return sum(map(min, halves)) > HELD_OUT.min_half_share * sum(map(sum, halves))


def _is_faint(data: KnownInputs, fit: Fit, r: int) -> bool:
    """Whether the response of mode r is a negligible share of the power of every output."""
    z = np.concatenate(data.modal_coordinate(fit.poles[r], fit.participation[r]))
    power = np.abs(fit.amplitudes[:, r]) ** 2 * 0.5 * (np.abs(z) ** 2).mean()
    outputs = np.hstack([record.outputs[:, data.first :] for record in data.records])
    return bool((power < HELD_OUT.faint_share * outputs.var(axis=1)).all())


def _power(samples: Floats) -> Floats:
    """Power of each line, (n_lines,), summed over outputs, of samples (n_samples, n_outputs)."""
    return np.asarray((np.abs(np.fft.rfft(samples, axis=0)) ** 2).sum(axis=1))


def _between(powers: list[Floats], highest_line: float, lowest: float, highest: float) -> Floats:
    """Power in the lines of all records between two frequencies, rad/s."""
    lines = [np.linspace(0.0, highest_line, len(power)) for power in powers]
    return np.concatenate([p[(at >= lowest) & (at <= highest)] for p, at in zip(powers, lines, strict=True)])


class _ResidualSpectra:
    """Residual and response of each record in lines of Hann's window, outputs in units of their noise."""

    def __init__(self, data: KnownInputs, fit: Fit) -> None:
        self.lines, self.response = (
            [_power(np.hanning(len(each))[:, None] * each / fit.noise) for each in data.as_samples(y)]
            for y in (fit.residual, data.values)
        )
        self.usual, self.highest = float(np.median(np.concatenate(self.lines))), data.highest

    def stands_out(self, lowest: float, highest: float) -> bool:
        """Whether the residual between two frequencies, rad/s, significantly exceeds that elsewhere.

        It must exceed the median of all lines, and the band of equal width below or above.
        """
        inside, width = _between(self.lines, self.highest, lowest, highest), highest - lowest
        if not inside.size or inside.mean() < HELD_OUT.min_residual_ratio * self.usual:
            return False
        for first in (lowest - width, highest):  # noise may be coloured
            beside = _between(self.lines, self.highest, first, first + width)
            if beside.size:
                degrees = (HELD_OUT.degrees_per_line * each.size for each in (inside, beside))
                chance = variance_ratio.isf(FALSE_ALARM, *degrees)
                if inside.mean() > max(HELD_OUT.min_residual_ratio, chance) * beside.mean():
                    return True
        return False

    def between(self, lowest: float, highest: float) -> tuple[float, float]:
        """Power of the residual and of the response between two frequencies, rad/s."""
        left, response = (_between(each, self.highest, lowest, highest).sum() for each in (self.lines, self.response))
        return float(left), float(response)


def left_about(data: KnownInputs, fit: Fit) -> tuple[complex, ...]:
    """The poles of a fit with a significant residual about them, of a size that matters beside the response.

    Where it is very large about one mode, least squares leave a little about the others too; these do not count.
    """
    whole = replace(data, line_std=None, beside=None, changing=())
    spectra = _ResidualSpectra(whole, projected(whole, fit.poles, fit.participation))
    bands = fit.poles.imag[:, None] * (1.0 + 0.5 * CHANGING.frequency_range * np.array([-1.0, 1.0]))
    residual, response = np.array([spectra.between(*band) for band in bands]).reshape(-1, 2).T
    significant = residual > np.maximum(HELD_OUT.min_share * response, HELD_OUT.peak_share * residual.max(initial=0.0))
    return tuple(complex(fit.poles[r]) for r in np.flatnonzero(significant) if spectra.stands_out(*bands[r]))


def unpredictive_remarks(fit: Fit, poles: Iterable[complex]) -> tuple[str, ...]:
    """A remark on the modes nearest to these poles, whose measured response exceeds that of linear modes."""
    which = ", ".join(named_near(fit, poles).values())
    if not which:
        return ()
    return (
        "modes change within the record, perhaps with amplitude, something is nonlinear, or a force is not measured:"
        f" the response near {which} is not that of linear modes to the inputs; {IS_MEAN}",
    )
