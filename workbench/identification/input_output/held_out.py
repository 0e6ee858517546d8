"""Modes that a record seems to hold, and that do not predict the rest of it.

What a structure does beside its linear modes, where something is nonlinear, is no noise of the sensors: it stands in
the lines about a resonance, often far above that noise, and modes fitted to these lines explain it there and nowhere
else. So the modes are fitted to the first half of each record and carried on through the second, with and without those
about each stronger one: what is there makes the prediction better, what is not makes it worse.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.stats import f as variance_ratio

from workbench.arrays import Flags, Floats
from workbench.identification.input_output.known_inputs import KnownInputs
from workbench.identification.input_output.modal_fit import Fit, columns, only, projected, settled
from workbench.identification.input_output.time_variance import IS_MEAN, named_near
from workbench.identification.signal.searches import FALSE_ALARM, SELECTION, Budget


@dataclass(frozen=True)
class HeldOutSettings:
    """Constants of the prediction of what is held out."""

    reach: float = 0.15  # of the frequency of a mode, within which weaker ones may stand for what else it does
    # of the square of the error with these modes: what the error without them is below. In noise of the sensors alone
    # true modes make it a multiple, and needless ones change it by less than a tenth
    worse: float = 0.8
    least: float = 0.1  # share of the energy of the stronger mode that either half must hold, to tell anything
    rows: int = 4  # samples of a half for each column of a fit, at least
    # times the median power of a line of what all modes leave, and the mean below or above them, that stands about them
    # on the mean: of less it is noise, and two modes a line apart, of which half a record tells nothing, may be two
    loud: float = 10.0
    free: float = 4.0 / 3.0  # degrees of freedom of a line through Hann's window, which shares them with its neighbours
    faint: float = 0.01  # of the power of the outputs: what a mode with no other about it makes, to be taken for a line
    matters: float = 1e-3  # of the response about a mode, 3 % of its amplitude: what is left to be remarked
    beside: float = 0.03  # of what is left about another mode, likewise: least squares spread up to 0.01 of that


HELD_OUT = HeldOutSettings()


def without_unpredictive(
    data: KnownInputs, fit: Fit, strength: Floats, budget: Budget
) -> tuple[Fit, tuple[complex, ...]]:
    """The fit without modes that make the prediction worse, and the poles that these stood about.

    The weaker modes about each stronger one are tried together, and where they stay, faint ones that ring on through
    the record, or grow, one by one: a single line is all that they fit.

    Args:
        strength: (n_modes,) statistic of each mode.
    """
    n, omega = fit.poles.size, fit.poles.imag
    reach = HELD_OUT.reach * omega
    weaker = (np.abs(np.subtract.outer(omega, omega)) < reach[:, None]) & (strength < strength[:, None])
    lines = -fit.poles.real < 0.5 * data.resolution
    shortest = min(record.n_samples // 2 for record in data.records)
    if n < 2 or not (weaker.any() or lines.any()) or shortest <= data.first:
        return fit, ()
    whole = data.unweighted()
    half = whole.first_half()
    too_short = len(half.values) < HELD_OUT.rows * (2 * n + half.fixed.shape[1])
    if too_short or half.fixed.shape[1] != whole.fixed.shape[1]:  # inputs that rest through a first half
        return fit, ()
    all_modes = projected(whole, fit.poles, fit.participation)
    noise, left_by_all = all_modes.noise, _Left(whole, all_modes)
    known: dict[bytes, list[Floats] | None] = {}

    def missed(kept: Flags) -> list[Floats] | None:
        """Power of the error over the second half of each record, (n_lines,), outputs in units of their noise."""
        try:
            start = projected(half, fit.poles[kept], fit.participation[kept])
            found = settled(half, start, SELECTION.few_steps, budget)
            with np.errstate(over="ignore", invalid="ignore"):
                predicted = columns(whole, found.poles, found.participation)[0] @ found.coefficients
                left = (whole.values - predicted) / noise
        except np.linalg.LinAlgError:
            return None
        seconds = [left[a.start + b.stop - b.start : a.stop] for a, b in zip(whole.rows, half.rows)]
        if not all(np.isfinite(each).all() for each in seconds):
            return None
        return [_power(each) for each in seconds]

    def error(kept: Flags, lowest: float, highest: float) -> float:
        """Of the lines between two frequencies, rad/s."""
        key = kept.tobytes()
        if key not in known:
            known[key] = missed(kept)
        found = known[key]
        return np.inf if found is None else float(_between(found, whole.highest, lowest, highest).sum())

    kept, distorted = np.ones(n, bool), []
    tries = [(r, weaker[r]) for r in np.argsort(-strength)]
    tries += [(r, np.arange(n) == r) for r in np.argsort(strength) if lines[r] and _is_faint(whole, all_modes, r)]
    for r, modes in tries:
        group = kept & modes
        if not (kept[r] and group.any() and (kept & ~group).any() and _is_in_both(whole, fit, r)):
            continue
        if budget.spent("check of modes by what they predict"):
            break
        band = omega[group].min() - 0.5 * reach[r], omega[group].max() + 0.5 * reach[r]
        if not left_by_all.stands_out(*band):
            continue
        if error(kept & ~group, *band) < HELD_OUT.worse * error(kept, *band):
            kept &= ~group
            if kept[r]:
                distorted.append(complex(fit.poles[r]))
    if kept.all():
        return fit, ()
    return settled(data, only(data, fit, kept), SELECTION.few_steps, budget), tuple(distorted)


def _is_in_both(data: KnownInputs, fit: Fit, r: int) -> bool:
    """Whether both halves of the records hold a fair share of the energy of a mode."""
    halves = []
    for z in data.modal_coordinate(fit.poles[r], fit.participation[r]):
        power = np.abs(z) ** 2
        halves.append((float(power[: z.size // 2].sum()), float(power[z.size // 2 :].sum())))
    return sum(map(min, halves)) > HELD_OUT.least * sum(map(sum, halves))


def _is_faint(data: KnownInputs, fit: Fit, r: int) -> bool:
    """Whether a mode makes next to nothing of the outputs."""
    z = np.concatenate(data.modal_coordinate(fit.poles[r], fit.participation[r]))
    made = np.abs(fit.amplitudes[:, r]) ** 2 * 0.5 * (np.abs(z) ** 2).mean()
    return bool((made < HELD_OUT.faint * data.values.var(axis=0)).all())


def _power(samples: Floats) -> Floats:
    """Of each line, outputs together, (n_lines,), of samples (n_samples, n_outputs)."""
    return np.asarray((np.abs(np.fft.rfft(samples, axis=0)) ** 2).sum(axis=1))


def _between(powers: list[Floats], highest_line: float, lowest: float, highest: float) -> Floats:
    """The lines of all records between two frequencies, rad/s."""
    lines = [np.linspace(0.0, highest_line, len(power)) for power in powers]
    return np.concatenate([p[(at >= lowest) & (at <= highest)] for p, at in zip(powers, lines, strict=True)])


class _Left:
    """What a fit leaves of each record, lines of Hann's window, outputs in units of their noise."""

    def __init__(self, data: KnownInputs, fit: Fit) -> None:
        window = np.concatenate([np.hanning(rows.stop - rows.start) for rows in data.rows])[:, None] / fit.noise
        self.lines, self.response = (
            [_power((window * y)[rows]) for rows in data.rows] for y in (fit.residual, data.values)
        )
        self.usual, self.highest = float(np.median(np.concatenate(self.lines))), data.highest

    def stands_out(self, lowest: float, highest: float) -> bool:
        """Whether it is far more between two frequencies, rad/s, than elsewhere, below or above them and by chance."""
        about, width = _between(self.lines, self.highest, lowest, highest), highest - lowest
        if not about.size or about.mean() < HELD_OUT.loud * self.usual:
            return False
        for first in (lowest - width, highest):  # noise need not be white
            beside = _between(self.lines, self.highest, first, first + width)
            if beside.size:
                chance = variance_ratio.isf(FALSE_ALARM, HELD_OUT.free * about.size, HELD_OUT.free * beside.size)
                if about.mean() > max(HELD_OUT.loud, chance) * beside.mean():
                    return True
        return False

    def between(self, lowest: float, highest: float) -> tuple[float, float]:
        """What is left, and the response, between two frequencies."""
        left, response = (_between(each, self.highest, lowest, highest).sum() for each in (self.lines, self.response))
        return float(left), float(response)


def left_about(data: KnownInputs, fit: Fit) -> tuple[complex, ...]:
    """The poles of a fit about which far more is left than beside them, and enough of the response there to matter.

    Where very much is left about one mode, least squares leave a little about the others too: these do not count.
    """
    whole = data.unweighted()
    left = _Left(whole, projected(whole, fit.poles, fit.participation))
    bands = fit.poles.imag[:, None] * (1.0 + 0.5 * HELD_OUT.reach * np.array([-1.0, 1.0]))
    about, response = np.array([left.between(*band) for band in bands]).reshape(-1, 2).T
    enough = about > np.maximum(HELD_OUT.matters * response, HELD_OUT.beside * about.max(initial=0.0))
    return tuple(complex(fit.poles[r]) for r in np.flatnonzero(enough) if left.stands_out(*bands[r]))


def unpredictive_remarks(fit: Fit, poles: Iterable[complex]) -> tuple[str, ...]:
    """A remark on the modes next to these poles, about which more is seen than they make."""
    which = ", ".join(named_near(fit, poles).values())
    if not which:
        return ()
    return (
        "modes change within the record, perhaps with amplitude, something is nonlinear, or a force is not measured:"
        f" the response about {which} is more than linear modes make of the inputs; {IS_MEAN}",
    )
