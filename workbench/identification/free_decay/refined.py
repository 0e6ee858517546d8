"""What a fit of free decays says: its modes, with the covariance of frequencies, damping and shapes."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from workbench.identification.signal.modal_estimates import ModalEstimates, credible, normalised_shapes
from workbench.identification.signal.noise import noise_near
from workbench.identification.signal.projection import Projection, project
from workbench.identification.signal.synthesis import time_derivatives
from workbench.records.record import Record
from workbench.structure.modes import SampledModes, frozen


@dataclass(frozen=True, eq=False, repr=False)
class Refined(ModalEstimates):
    """Maximum likelihood modes of free decays, with their standard errors.

    Attributes:
        modes: refined; shapes of displacement, largest entry 1.
        covariance: (2 n_modes, 2 n_modes) of (ω, ζ), the Cramér-Rao bound at the estimate.
        amplitudes: one (n_outputs, n_modes) complex a record: y = Re Σ a_r e^{λ_r (t - t_first)}, in its own units.
        shape_covariance: (n_modes, n_outputs, n_outputs) of the real parts of the shapes, relative to each one's
            largest entry (which is 1 and so without error).
        noise: (n_records, n_outputs) standard deviation of the residual, in the unit of each output.
        converged: whether the search ended because the step was small.
        steps: taken.
    """

    modes: SampledModes
    covariance: np.ndarray
    amplitudes: tuple[np.ndarray, ...]
    shape_covariance: np.ndarray
    noise: np.ndarray
    converged: bool
    steps: int

    def select(self, which: np.ndarray) -> "Refined":
        """Some of the modes, by index; the others were fitted beside them."""
        both = np.r_[which, which + self.modes.n_modes]
        return replace(
            self,
            modes=self.modes.select(list(which)),
            covariance=frozen(self.covariance[np.ix_(both, both)]),
            amplitudes=tuple(frozen(each[:, which], complex) for each in self.amplitudes),
            shape_covariance=frozen(self.shape_covariance[which]),
        )

    @property
    def noise_std(self) -> np.ndarray:
        """Of each output (n_outputs,), root mean square over the records."""
        return np.asarray(np.sqrt((self.noise**2).mean(axis=0)))

    @property
    def shape_std(self) -> np.ndarray:
        """Standard error of the real part of each shape (n_outputs, n_modes)."""
        return np.asarray(np.sqrt(np.einsum("rjj->jr", self.shape_covariance)))


@dataclass(frozen=True, eq=False, repr=False)
class Identified(ModalEstimates):
    """The modes of a record, and what was taken for noise.

    Attributes:
        refined: the modes, with covariance.
        evidence: (n_modes,) χ² of each mode's amplitudes in the noise, 2 degrees of freedom a signal.
        limit: what the strongest mode fitted to white noise alone exceeds with the chance `false_alarm`.
        noise_modes: candidates rejected, each with an evidence below the limit, overdamped, or part of another.
        noise_evidence: (n_noise,) theirs.
        remarks: what was left undone, where the time was up.
    """

    refined: Refined
    evidence: np.ndarray
    limit: float
    noise_modes: SampledModes
    noise_evidence: np.ndarray
    remarks: tuple[str, ...] = field(default=())

    @property
    def modes(self) -> SampledModes:  # type: ignore[override]  # read-only here
        return self.refined.modes

    @property
    def covariance(self) -> np.ndarray:  # type: ignore[override]
        """(2 n_modes, 2 n_modes) of (ω, ζ)."""
        return self.refined.covariance

    def without_artefacts(self, nyquist: float, *, growing: bool = False) -> "Identified":
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
        evidence = self.evidence if self.evidence.size else np.zeros(good.size)
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
            evidence=frozen(self.evidence[kept]) if self.evidence.size else self.evidence,
            noise_modes=noise_modes,
            noise_evidence=frozen(np.r_[self.noise_evidence, evidence[out]][order]),
        )


def unshaped(poles: np.ndarray, record: Record) -> SampledModes:
    """Modes of which only the poles are known, by rising frequency: a start for `refine`."""
    omega = np.abs(poles)
    order = np.argsort(omega)
    shapes = np.ones((record.n_outputs, poles.size), complex)
    return SampledModes(omega[order], (-poles.real / omega)[order], shapes, record.positions)


def in_coloured_noise(refined: Refined, records: Record | Sequence[Record], *, offset: bool = True) -> Refined:
    """The same modes with standard errors that hold in noise of any smooth spectrum.

    A mode is disturbed by noise within its own band only. Where output j has noise of spectrum S_j, a least squares fit
    made for white noise s_j² has the covariance H^-1 (Σ_j J_j^T S_j J_j) H^-1 (White, Econometrica 48, 1980), and each
    column of J lives where its mode does, so that

        J_j^T S_j J_j  ≈  κ_jr^½ κ_js^½ (J_jr^T J_js),     κ_jr = S_j(ω_r) / s_j²,

    for modes r and s. Where the noise may be white κ is one: the Cramér-Rao bound.

    Args:
        refined: of `refine`, made for white noise.
        records: that it was identified from.
        offset: as in `refine`.
    """
    records = [records] if isinstance(records, Record) else list(records)
    fits = [project(record, refined.modes.poles, offset) for record in records]
    ratios = np.array(
        [
            noise_near(refined.modes.poles, fit.residual / noise, record.sample_time)
            for record, fit, noise in zip(records, fits, refined.noise, strict=True)
        ]
    )
    if (ratios == 1.0).all():
        return refined
    found = records, refined.modes.poles, fits, refined.noise
    return as_refined(*found, converged=refined.converged, steps=refined.steps, noise_ratio=ratios)


def as_refined(
    records: Sequence[Record],
    poles: np.ndarray,
    fits: Sequence[Projection],
    noise: np.ndarray,
    *,
    converged: bool,
    steps: int,
    noise_ratio: np.ndarray | None = None,
) -> Refined:
    """What a search ended with, with the covariance that follows from it.

    Args:
        records: of the fit.
        poles: (n_modes,) rad/s.
        fits: one a record.
        noise: (n_records, n_outputs) standard deviations.
        converged, steps: of the search.
        noise_ratio: κ (n_records, n_outputs, n_modes), variance of the noise about each mode over its mean; 1 unless
            given.
    """
    n = poles.size
    h, _ = normal_equations(fits, 1.0 / noise)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(h), 1e-300))
    covariance = np.linalg.pinv(h * np.outer(scale, scale), rcond=1e-14, hermitian=True) * np.outer(scale, scale)
    if noise_ratio is not None:
        disturbed = normal_equations(fits, 1.0 / noise, np.sqrt(noise_ratio).swapaxes(1, 2))[0]
        covariance = covariance @ disturbed @ covariance
    omega = np.abs(poles)
    sigma, omega_d = -poles.real, poles.imag
    # ω² = σ² + ω_d² and ζ = σ/ω carry the covariance of (σ, ω_d) to that of (ω, ζ).
    jacobian = np.block(
        [
            [np.diag(sigma / omega), np.diag(omega_d / omega)],
            [np.diag(omega_d**2 / omega**3), np.diag(-sigma * omega_d / omega**3)],
        ]
    )
    order = np.argsort(omega)
    both = np.r_[order, order + n]
    variance = noise[:, :, None] ** 2 * np.ones(n) * (1.0 if noise_ratio is None else noise_ratio)
    derivative = time_derivatives(records[0].output_channels)
    shapes, shape_covariance = _mean_shapes(fits, derivative, covariance, variance)
    return Refined(
        modes=SampledModes(
            omega[order], (sigma / omega)[order], normalised_shapes(shapes)[:, order], records[0].positions
        ),
        covariance=frozen((jacobian @ covariance @ jacobian.T)[np.ix_(both, both)]),
        amplitudes=tuple(frozen(fit.complex_amplitudes[:, order], complex) for fit in fits),
        shape_covariance=frozen(shape_covariance[order]),
        noise=frozen(noise),
        converged=bool(converged),
        steps=steps,
    )


def normal_equations(
    fits: Sequence[Projection], weights: np.ndarray, factor: np.ndarray | float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton matrix and right-hand side of (σ, ω_d), over all records, outputs weighted by 1 / noise.

    Args:
        fits: one a record, of the same poles.
        weights: (n_records, n_outputs).
        factor: (n_records, n_modes, n_outputs) of the share of each mode and output: κ^½ gives J^T S J.
    """
    size = fits[0].gram.shape[0]
    n = size // 2
    h, g = np.zeros((size, size)), np.zeros(size)
    factors = np.broadcast_to(factor, (len(fits), n, weights.shape[1]))
    for fit, weight, by in zip(fits, weights, factors, strict=True):
        a, b = fit.coefficients[:n] * weight * by, fit.coefficients[n : 2 * n] * weight * by
        aa, ab, bb = a @ a.T, a @ b.T, b @ b.T
        (cc, cs), (sc, ss) = fit.gram.reshape(2, n, 2, n).transpose(0, 2, 1, 3)
        h[:n, :n] += aa * cc + ab * cs + ab.T * sc + bb * ss
        h[n:, n:] += bb * cc - ab.T * cs - ab * sc + aa * ss
        cross = -(ab * cc) + aa * cs - bb * sc + ab.T * ss
        h[:n, n:] += cross
        h[n:, :n] += cross.T
        x, y = fit.slopes[:n] * weight, fit.slopes[n:] * weight
        g[:n] += -(a * x + b * y).sum(axis=1)
        g[n:] += (b * x - a * y).sum(axis=1)
    return h, g


def _mean_shapes(
    fits: Sequence[Projection], derivative: np.ndarray, pole_covariance: np.ndarray, variance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Shapes relative to their largest entry, (n_outputs, n_modes) complex, and the covariance of their real parts,
    (n_modes, n_outputs, n_outputs).

    Records share shapes but not amplitudes: of record i only ρ_j = s_j / s_k counts, k the largest entry. Each entry is
    the mean over the records by their own noise, so that a record that misses a mode, or is noisy, counts little.

    Args:
        fits: one a record, of the same poles.
        derivative: (n_outputs,) order of the time derivative each output measures.
        pole_covariance: (2 n_modes, 2 n_modes) of (σ, ω_d).
        variance: (n_records, n_outputs, n_modes) of the noise about each mode.
    """
    poles, n = fits[0].poles, fits[0].poles.size
    to_displacement = poles ** -derivative[:, None]
    shapes = np.array([fit.complex_amplitudes * to_displacement for fit in fits])
    spread = np.array([np.diag(fit.spread)[:n] + np.diag(fit.spread)[n : 2 * n] for fit in fits])
    own = variance * np.abs(to_displacement) ** 2 * spread[:, None]
    strongest = (np.abs(shapes) ** 2 / own).sum(axis=1).argmax(axis=0)
    root = _root(pole_covariance)
    mean, covariance = np.empty(shapes.shape[1:], complex), np.zeros((n, len(derivative), len(derivative)))
    for r in range(n):
        best = shapes[strongest[r], :, r]
        k = int(np.argmax(np.abs(best)))
        size = np.maximum(np.abs(shapes[:, k, r, None]) ** 2, 1e-300)
        weights = size / (own[:, :, r] + np.abs(best / best[k]) ** 2 * own[:, k, r, None])
        weights = weights / weights.sum(axis=0)
        ratios = shapes[:, :, r] / shapes[:, k, r, None]
        mean[:, r] = (weights * ratios).sum(axis=0)
        shared = np.zeros((len(derivative), 2 * n))
        for fit, each, weight, ratio, noise in zip(fits, shapes, weights, ratios, variance[:, :, r], strict=True):
            moved = _by_poles(fit, r) @ root * to_displacement[:, r, None]
            shared += weight[:, None] * ((moved - ratio[:, None] * moved[k]) / each[k, r]).real
            unit = to_displacement[:, r] / each[k, r]
            covariance[r] += np.outer(weight, weight) * _by_noise(fit, r, k, unit, ratio, noise)
        covariance[r] += shared @ shared.T
        covariance[r][k] = covariance[r][:, k] = 0.0
    return mean, covariance


def _by_poles(fit: Projection, r: int) -> np.ndarray:
    """∂ amplitudes of mode r / ∂ (σ, ω_d) of every mode, by -Φ^+ dΦ, (n_outputs, 2 n_modes) complex."""
    n = fit.poles.size
    # dΦ of mode p is -(α, β) tΦ_p by σ and (β, -α) tΦ_p by ω_d.
    alpha, beta = fit.coefficients[:n], fit.coefficients[n : 2 * n]
    cosine, sine = (np.array([1.0, -1j]) @ fit.tilt[[r, n + r]]).reshape(2, n, 1)
    return np.vstack([cosine * alpha + sine * beta, sine * alpha - cosine * beta]).T


def _by_noise(fit: Projection, r: int, k: int, unit: np.ndarray, ratio: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Covariance of the real parts by each output's own noise, (Φ^T Φ)^-1, and by that of the reference, poles held."""
    pair = np.array([1.0, -1j]) @ _root(fit.spread[np.ix_([r, fit.poles.size + r], [r, fit.poles.size + r])])
    each = np.sqrt(variance)[:, None] * pair * unit[:, None]
    common = (ratio[:, None] * each[k]).real
    return np.asarray(common @ common.T + np.diag((each.real**2).sum(axis=1)))


def _root(matrix: np.ndarray) -> np.ndarray:
    """R with R R^T = matrix, for a matrix that may be singular."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
