"""One mode that changes, the rival of several linear ones in records with one input and one output.

    z' = (λ + Σ_k c_k g_k) z + l u,      g = t, t², t³,  or  r^p, r = |z| over its largest,

with a few powers p as those of a free decay (`backbone`). l u is what drives the constant mode from sample to sample;
what remains of a step is Heun's. The rival has no more numbers than the linear modes: the likelier is preferred.
All are compared in the lines of the cosine transform about the modes.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from workbench.arrays import Floats
from workbench.identification.input_output.known_inputs import KnownInputs
from workbench.identification.input_output.modal_fit import Fit, columns
from workbench.identification.input_output.noise_spectrum import lines_of
from workbench.identification.input_output.rivals import (
    RIVALS,
    beside_constant,
    left_by_motion,
    nearest_pole,
    taken_by_others,
)
from workbench.identification.signal.searches import Once


@dataclass(frozen=True)
class ChangingResponseSettings:
    """Constants of the fit of one mode that changes to records with known inputs."""

    most_tries: int = 40  # evaluations of a fit
    unseen: float = 1e-4  # of the slopes of what is left: a participation that moves less stays as it is
    faded: float = 16.0  # standard deviations of the time of its energy, from which on a mode stays as it is
    least: float = 1e-3  # of the largest amplitude: below it a mode changes no more
    undriven: float = 1e-12  # of its largest amplitude: nothing drives a mode where no more does
    step: float = 0.005  # time constants: of the steps where nothing drives, at most
    largest: float = 1e3  # times that of the constant mode: beyond this a motion diverges


RESPONSE = ChangingResponseSettings()
# Whether by time, and powers; λ is one number more.
LAWS = (
    (True, (1.0, 2.0)),
    (False, (1.0, 2.0)),
    (False, (0.5, 1.0)),
    (False, (-1.0, 1.0)),
    (True, (1.0, 2.0, 3.0)),
    (False, (0.5, 1.0, 2.0)),
    (False, (-1.0, 1.0, 2.0)),
)


@dataclass(frozen=True, eq=False)
class Motion:
    """One mode that changes: what it moves along beside a constant one, (n_rows, n_columns), and the pole of that."""

    moved: Floats
    pole: complex


def in_place_of(data: KnownInputs, fit: Fit, cluster: np.ndarray, limit: float) -> Motion | None:
    """One mode that changes in place of some of a fit, the strongest first; None where these are likelier."""
    response = _Response(data, fit, cluster)
    linear = response.left_by_linear()
    n = linear.shape[0] // fit.noise.size
    enough = np.log(_squares(linear, fit.noise.size)).sum() + limit * (cluster.size - 1) / n
    q, m = fit.participation.shape[1], fit.noise.size
    numbers = cluster.size * (q + m) - (q - 1 + m)
    for by_time, powers in LAWS:
        if len(powers) + 1 <= numbers:
            found = response.fitted(by_time, np.array(powers), enough)
            if found is not None:
                return found
    return None


def _squares(left: Floats, n_outputs: int) -> Floats:
    squares = (left.reshape(n_outputs, -1) ** 2).sum(axis=1)
    return np.asarray(squares + 1e-300)


@njit(cache=True, nogil=True)
def _moved(
    start: np.ndarray, drive: np.ndarray, change: np.ndarray, powers: Floats, by_time: bool, step: complex,
    scale: float, least: float, largest: float, dt: float, middle: float, width: float, faded: float,
    driven: int, many: int,
) -> np.ndarray:  # fmt: skip
    """z of a mode at the samples, (n, n_cases), for each row of changes c_0, c_1, ... (n_cases, 1 + n_powers).

    Args:
        start: (n_cases,) at the first sample.
        drive: (n - 1, n_cases) what drives the constant mode from each sample to the next.
        step: e^{λΔt}.
        middle, width: of time, as a share of the record.
        driven: samples after which nothing drives.
        many: samples of a step from there on, within which the rate goes straight from its first to its last.
    """
    n, n_cases = drive.shape[0] + 1, drive.shape[1]
    z = np.zeros((n, n_cases), np.complex128)
    for i in range(n_cases):
        at = start[i]
        z[0, i] = at
        k = 0
        while k < n - 1:
            ahead = 1 if k < driven else min(many, n - 1 - k)
            carried, force = step**ahead, drive[k, i] if k < driven else 0j
            first, rate, guess = 0j, 0j, at
            for stage in range(2):
                size = (
                    min(((k + stage * ahead) / (n - 1) - middle) / width, faded)
                    if by_time
                    else max(abs(guess) / scale, least)
                )
                now = change[i, 0]
                for p in range(powers.size):
                    now += change[i, p + 1] * size ** powers[p]
                if stage == 0:
                    first = rate = now
                    guess = carried * np.exp(rate * ahead * dt) * at + force * np.exp(0.5 * rate * dt)
                else:
                    rate = 0.5 * (rate + now)
            turn = (rate - first) * 2.0 * dt / ahead
            grows, more = step * np.exp(first * dt + 0.5 * turn), np.exp(turn)
            for j in range(1, ahead):
                z[k + j, i] = z[k + j - 1, i] * grows
                grows *= more
            at = carried * np.exp(rate * ahead * dt) * at + force * np.exp(0.5 * rate * dt)
            if not abs(at) < largest * scale:
                z[k + 1 :, i] = np.nan
                break
            k += ahead
            z[k, i] = at
    return z


class _Response:
    """The fit of a law about some modes; what is linear in the records drops out.

    The poles of the modes beside those in question may move, to first order.
    """

    def __init__(self, data: KnownInputs, fit: Fit, cluster: np.ndarray) -> None:
        self.data, self.fit = data, fit
        poles = fit.poles[cluster]
        rates = np.maximum(-poles.real, RIVALS.slowest * data.resolution)
        power = np.abs(fit.amplitudes[:, cluster] / fit.noise[:, None]).max(axis=0) ** 2 / rates
        self.pole = complex(np.average(-rates + 1j * poles.imag, weights=power))
        self.rate, self.participation = -self.pole.real, fit.participation[cluster[0]]
        self.cluster = cluster
        beyond = max(RIVALS.about * self.rate, RIVALS.fewest * data.resolution)
        self.low, self.high = poles.imag.min() - beyond, poles.imag.max() + beyond
        free = np.eye(self.participation.size)
        each = [data.modal_coordinate(self.pole, one) for one in free]
        self.coordinates = [np.column_stack(parts) for parts in zip(*each, strict=True)]
        strength = np.sqrt(sum((np.abs(z) ** 2).sum(axis=0) for z in self.coordinates))
        held = int(np.argmax(strength * np.abs(self.participation)))
        self.participation = self.participation / self.participation[held]
        self.held = held
        self.others = np.delete(np.arange(strength.size), held)
        self.units = strength[held] / np.maximum(strength[self.others], 1e-300)
        self.scale = max(max(float(np.abs(z @ self.participation).max()) for z in self.coordinates), 1e-300)
        energy = [np.abs(z @ self.participation) ** 2 for z in self.coordinates]
        share = np.concatenate([np.linspace(0.0, 1.0, each.size) for each in energy])
        self.middle = float(np.average(share, weights=np.concatenate(energy) + 1e-300))
        self.width = float(np.sqrt(np.average((share - self.middle) ** 2, weights=np.concatenate(energy) + 1e-300)))
        self.weights = self._weights()
        outside = np.setdiff1d(np.arange(fit.poles.size), cluster)
        self.values = [y / noise for y, noise in zip(self._about(data.values).T, fit.noise, strict=True)]
        self.bases = self._bases(outside, poles_only=True)
        self.values = [y - b @ (b.T @ y) for y, b in zip(self.values, self.bases, strict=True)]

    def left_by_linear(self) -> Floats:
        """What the fit leaves about the modes, all poles and participation moved to first order."""
        bases = self._bases(np.arange(self.fit.poles.size), poles_only=False)
        left = [y / noise for y, noise in zip(self._about(self.fit.residual).T, self.fit.noise, strict=True)]
        return np.concatenate([y - b @ (b.T @ y) for y, b in zip(left, bases, strict=True)])

    def fitted(self, by_time: bool, powers: Floats, enough: float) -> Motion | None:
        once = Once(lambda x: self._left(self._motions(x, by_time, powers)))
        best = self._together(by_time, powers)
        at = np.r_[best.real, best.imag]
        seen = np.linalg.norm(once(at)[1], axis=0)
        # After a blow, an initial state moves a mode as the input does.
        active = seen > RESPONSE.unseen * seen.max()
        if not active.any():
            return None

        def among_active(x: Floats) -> tuple[Floats, Floats]:
            at[active] = x
            left, slopes = once(at)
            return left, slopes[:, active]

        at[active] = Once(among_active).least(at[active], RESPONSE.most_tries)
        if np.log(_squares(once(at)[0], self.fit.noise.size)).sum() > enough:
            return None
        return self._motion(self._motions(at, by_time, powers))

    def _together(self, by_time: bool, powers: Floats) -> np.ndarray:
        """The numbers of a law that suit best how the linear modes move together, from sample to sample."""
        fit, dt = self.fit, self.data.dt
        shape = fit.amplitudes[:, self.cluster[0]] / fit.noise**2
        strength = shape.conj() @ fit.amplitudes[:, self.cluster]
        participation = strength @ fit.participation[self.cluster]
        unit = participation[self.held]
        x: list[np.ndarray] = []
        y: list[np.ndarray] = []
        modes = [
            (a / unit, pole, self.data.modal_coordinate(pole, l_r))
            for a, pole, l_r in zip(strength, fit.poles[self.cluster], fit.participation[self.cluster], strict=True)
        ]
        for k in range(len(self.coordinates)):
            z = sum(a * each[k] for a, _, each in modes)
            carried = sum(a * np.exp(pole * dt) * each[k][:-1] for a, pole, each in modes)
            n = z.size
            time = np.minimum((np.arange(n - 1) / (n - 1) - self.middle) / self.width, RESPONSE.faded)
            size = time if by_time else np.maximum(np.abs(z[:-1]) / self.scale, RESPONSE.least)
            g = np.column_stack([np.ones(n - 1), size[:, None] ** powers])
            x.append(g * z[:-1, None])
            y.append((carried * np.exp(-self.pole * dt) - z[:-1]) / dt / self.rate)
        found = np.linalg.lstsq(np.vstack(x), np.concatenate(y), rcond=None)[0]
        own = self.participation[self.others]
        return np.asarray(np.r_[found, (participation[self.others] / unit - own) / self.units])

    def _motions(self, unknowns: Floats, by_time: bool, powers: Floats) -> list[np.ndarray]:
        """z of each record, and how it moves with each unknown, (n_samples, 1 + n_unknowns)."""
        cases = np.vstack([unknowns, unknowns + RIVALS.slightly * np.eye(unknowns.size)])
        numbers = cases[:, : unknowns.size // 2] + 1j * cases[:, unknowns.size // 2 :]
        size = 1 + powers.size
        participation = np.tile(self.participation, (len(cases), 1))
        participation[:, self.others] += numbers[:, size:] * self.units
        step, found = np.exp(self.pole * self.data.dt), []
        for z in self.coordinates:
            all_cases = z @ participation.T
            drive = all_cases[1:] - step * all_cases[:-1]
            drives = np.flatnonzero(np.abs(drive).max(axis=1) > RESPONSE.undriven * self.scale)
            moved = _moved(
                np.ascontiguousarray(all_cases[0]), drive, self.rate * numbers[:, :size], powers, by_time, step,
                self.scale, RESPONSE.least, RESPONSE.largest, self.data.dt, self.middle, self.width, RESPONSE.faded,
                int(drives[-1]) + 1 if drives.size else 0, max(int(RESPONSE.step / (self.rate * self.data.dt)), 1),
            )  # fmt: skip
            found.append(np.column_stack([moved[:, 0], (moved[:, 1:] - moved[:, :1]) / RIVALS.slightly]))
        return found

    def _left(self, motions: list[np.ndarray]) -> tuple[Floats, Floats]:
        """What is left (n,) and its slopes (n, n_unknowns), the shape projected out (Kaufman 1975)."""
        if not all(np.isfinite(each).all() for each in motions):
            beyond = 10.0 * np.abs(np.concatenate(self.values))
            return beyond, np.zeros((beyond.size, motions[0].shape[1] - 1))
        both, found = self._about_samples([np.hstack([z.real, z.imag]) for z in motions]), []
        each = zip(self.values, self.bases, self.weights, self.fit.noise, strict=True)
        for y, basis, weight, noise in each:
            x = weight[:, None] * both / noise
            found.append(left_by_motion(y, x - basis @ (basis.T @ x)))
        return np.concatenate([left for left, _ in found]), np.vstack([slopes for _, slopes in found])

    def _motion(self, motions: list[np.ndarray]) -> Motion:
        moved = self.data.rows_of([np.hstack([z.real, z.imag]) for z in motions])
        pole = nearest_pole(self.data, moved[:, 0], self.pole, self.participation)
        return Motion(beside_constant(self.data, moved, pole, self.participation), pole)

    def _bases(self, modes: np.ndarray, poles_only: bool) -> list[Floats]:
        """Orthonormal, of modes, fixed columns and tangents, for each output."""
        fit = self.fit
        phi, tangents = columns(self.data, fit.poles[modes], fit.participation[modes])
        each, half = fit.participation.shape[1] + 1, tangents.shape[1] // 2
        step = each if poles_only else 1
        both = self._about(np.hstack([phi, tangents[:, :half:step], tangents[:, half::step]]), weighted=False)
        phi, real, imaginary = np.split(both, [phi.shape[1], phi.shape[1] + half // step], axis=1)
        found = []
        for weight, a in zip(self.weights, fit.amplitudes[:, modes], strict=True):
            a = a if poles_only else np.repeat(a, each)
            found.append(taken_by_others(weight[:, None], phi, (real, imaginary), a))
        return found

    def _which(self, n: int) -> np.ndarray:
        line = np.pi / self.data.dt / n
        return np.arange(max(int(self.low / line), 0), min(int(self.high / line) + 2, n))

    def _about(self, rows: Floats, weighted: bool = True) -> Floats:
        """Rows as the fit sees them, as lines about the modes."""
        parts = [rows[part] for part in self.data.rows]
        return np.vstack([(x if self.data.rows_are_lines else lines_of(x))[self._which(len(x))] for x in parts])

    def _about_samples(self, samples: list[np.ndarray]) -> Floats:
        return np.vstack([lines_of(x)[self._which(len(x))] for x in samples])

    def _weights(self) -> list[Floats]:
        data = self.data
        if data.weights is None:
            n = sum(self._which(part.stop - part.start).size for part in data.rows)
            return [np.ones(n)] * self.fit.noise.size
        return list(np.vstack([data.weights[part][self._which(part.stop - part.start)] for part in data.rows]).T)
