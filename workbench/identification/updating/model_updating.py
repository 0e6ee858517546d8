"""Model updating: chosen parameters of a model, with standard errors, from measured frequencies and shapes.

Friswell & Mottershead, Finite Element Model Updating in Structural Dynamics (1995), chapter 8: weighted least squares
on frequencies, modes paired by their shapes at every step. Repeated modes have no derivatives one by one: a measured
shape is compared with the span of them, and its frequency with Rayleigh's quotient of its projection there. Modes that
were measured as repeated stay so where the model takes them apart: their shapes say nothing of how they are turned.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from workbench.identification.shapes.mode_pairing import assigned, repeated_modes
from workbench.identification.signal.modal_estimates import rounded
from workbench.structure.modes import Modes, freeze
from workbench.structure.printed import Printed, counted


@dataclass(frozen=True)
class UpdatingSettings:
    """Constants of model updating."""

    least_mac: float = 0.5  # below it a measured mode is no mode of the model
    # of frequency, between modes that count as repeated: small imperfections mix closer ones
    repeated: float = 0.01
    step: float = 1e-4  # of the logarithm of a parameter, for central differences
    # smallest singular value of the scaled Jacobian over the largest: parameters that do the same
    indistinct: float = 1e-6


UPDATING = UpdatingSettings()


@dataclass(frozen=True, eq=False, repr=False)
class UpdatedModel(Printed):
    """A model fitted to measured modes.

    Attributes:
        parameters: (n_parameters,) in their own units.
        covariance: (n_parameters, n_parameters) of them.
        modes: of the model at these parameters.
        paired: (n_measured,) index of the model's mode that each measured mode is.
        mac: (n_measured,) of each pair; repeated modes as a subspace.
        residuals: (n_measured,) (model - measured) / standard error, of the frequencies.
        converged: whether the search ended at a minimum.
        reason: why it ended.
    """

    parameters: np.ndarray
    covariance: np.ndarray
    modes: Modes
    paired: np.ndarray
    mac: np.ndarray
    residuals: np.ndarray
    converged: bool
    reason: str

    def __post_init__(self) -> None:
        freeze(self, "parameters", "covariance", "mac", "residuals")

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        rows = [(str(i + 1), *rounded(p, e)) for i, (p, e) in enumerate(zip(self.parameters, self.std))]
        pairs = ", ".join(f"{i + 1} is {k + 1} ({m:.3f})" for i, (k, m) in enumerate(zip(self.paired, self.mac)))
        remarks = (
            f"measured modes are those of the model (MAC): {pairs}",
            f"frequencies off by {np.abs(self.residuals).max():.2g} standard errors at most",
            *(() if self.converged else (f"not converged: {self.reason}",)),
        )
        return f"{counted(len(rows), 'parameter')} updated", ("parameter", "value", "±"), rows, remarks

    @property
    def std(self) -> np.ndarray:
        """(n_parameters,) standard errors."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def update_model(
    build: Callable[[np.ndarray], Modes],
    start: ArrayLike,
    *,
    omega: ArrayLike,
    omega_std: ArrayLike,
    shapes: ArrayLike,
    places: object,
) -> UpdatedModel:
    """The parameters p > 0 that minimise Σ ((ω_r(p) - ω_r) / σ_r)², and their standard errors.

    The search goes downhill from where it starts; far from there it may end in another minimum, which residuals well
    beyond one and a low MAC show. The covariance is (Jᵀ J)⁻¹ at the minimum, J = ∂(ω(p) / σ)/∂p: errors of the
    measurement, not of the model's form.

    Args:
        build: modes of the model with parameters p, at least as many as were measured.
        start: (n_parameters,) p to start from, all positive.
        omega, omega_std: (n_measured,) measured frequencies and their standard errors, rad/s.
        shapes: (n_places, n_measured) measured shapes, of any scale, by which modes are paired.
        places: where they were measured, as the model's `Modes.phi` takes places.

    Raises:
        ValueError: numbers that are not positive, sizes that do not fit, more parameters than frequencies, a `build`
            that returns no modes, a measured mode that no mode of the model resembles, parameters that the measurements
            cannot distinguish.
    """
    first, target = np.atleast_1d(np.asarray(start, float)), np.asarray(omega, float)
    deviation, measured = np.asarray(omega_std, float), np.asarray(shapes)
    for name, values in (("start", first), ("omega", target), ("omega_std", deviation)):
        if not (np.isfinite(values) & (values > 0)).all():
            raise ValueError(f"{name} must be positive and finite; got {values}")
    if deviation.shape not in ((), target.shape):
        raise ValueError(f"omega_std is one number, or one per mode, {target.shape}; got {deviation.shape}")
    if first.size > target.size:
        raise ValueError(f"{target.size} measured frequencies cannot determine {first.size} parameters; choose fewer")
    if measured.ndim != 2 or measured.shape[1] != target.size or not np.isfinite(measured).all():
        raise ValueError(
            f"shapes must be finite, (n_places, n_measured) with {target.size} measured frequencies; got"
            f" {measured.shape}"
        )

    def paired(modes: Modes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of each measured mode: index and MAC of the model's, and the frequency that the model gives its shape."""
        if not isinstance(modes, Modes):
            raise ValueError(f"build must return modes, as model.modes(8) does; got {type(modes).__name__}")
        own = modes.phi(places)
        cluster = _joined(repeated_modes(modes.omega, UPDATING.repeated), own, measured, target)
        rows, columns, agreement = assigned(measured, own, cluster)
        if rows.size < target.size or agreement[rows, columns].min() < UPDATING.least_mac:
            lost = int(np.argmin(agreement.max(axis=1)))
            raise ValueError(
                f"measured mode {lost + 1}, {target[lost] / (2 * np.pi):.4g} Hz, resembles no mode of the model: the"
                f" best MAC is {agreement[lost].max():.2f}; let the model give more modes, or leave this one out"
            )
        quotients = modes.omega[columns]
        for r, s in enumerate(columns):
            alike = cluster == cluster[s]
            if alike.sum() > 1:
                share = np.abs(np.linalg.lstsq(own[:, alike], measured[:, r])[0]) ** 2
                quotients[r] = np.sqrt(share @ modes.omega[alike] ** 2 / share.sum())
        return columns, agreement[rows, columns], quotients

    def residuals(logarithms: np.ndarray) -> np.ndarray:
        return np.asarray((paired(build(first * np.exp(logarithms)))[2] - target) / deviation)

    def jacobian(logarithms: np.ndarray) -> np.ndarray:
        steps = UPDATING.step * np.eye(first.size)
        columns = [residuals(logarithms + step) - residuals(logarithms - step) for step in steps]
        return np.column_stack(columns) / (2.0 * UPDATING.step)

    found = least_squares(residuals, np.zeros(first.size), jac=jacobian, method="lm")
    parameters = first * np.exp(found.x)
    singular = np.linalg.svd(found.jac, compute_uv=False)
    if singular[-1] <= UPDATING.indistinct * singular[0]:
        raise ValueError(
            "the measured frequencies cannot distinguish the parameters: some change them alike, as stiffnesses in two"
            " directions do where repeated modes are turned half-way between; choose fewer"
        )
    modes = build(parameters)
    columns, agreement, _ = paired(modes)
    covariance = np.linalg.inv(found.jac.T @ found.jac) * np.outer(parameters, parameters)
    return UpdatedModel(
        parameters, covariance, modes, columns, agreement, found.fun, bool(found.success), str(found.message)
    )


def _joined(cluster: np.ndarray, own: np.ndarray, measured: np.ndarray, omega: np.ndarray) -> np.ndarray:
    """Clusters of the model's modes (n_modes,), those joined that modes measured as repeated are most like together.

    Without this a model whose parameters part two modes by a little more would no longer have the measured shapes, and
    the search end at that edge.
    """
    cluster, order = cluster.copy(), np.argsort(omega)
    repeated = np.empty(omega.size, int)
    repeated[order] = repeated_modes(omega[order], UPDATING.repeated)
    for each in np.unique(repeated):
        basis = np.linalg.qr(measured[:, repeated == each])[0]
        share = (np.abs(basis.conj().T @ own) ** 2).sum(axis=0) / (np.abs(own) ** 2).sum(axis=0)
        likest = np.argsort(-share, kind="stable")[: basis.shape[1]]
        cluster[np.isin(cluster, cluster[likest])] = cluster[likest].min()
    return cluster
