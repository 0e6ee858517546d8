"""Model updating: chosen parameters of a model, with standard errors, from measured frequencies and shapes.

Friswell & Mottershead, Finite Element Model Updating in Structural Dynamics (1995), chapter 8: weighted least squares
on frequencies, modes paired by their shapes at every step. Repeated modes have no individual derivatives: a measured
shape is compared with their span, and its frequency with Rayleigh's quotient of its projection on that span. Modes
measured as repeated stay so where the model separates them, since the directions of their shapes are arbitrary.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares
from scipy.stats import chi2 as chi2_distribution

from workbench.identification.shapes.mode_pairing import assigned, repeated_modes
from workbench.identification.signal.modal_estimates import rounded
from workbench.structure.modes import Modes, freeze
from workbench.structure.printed import Printed, counted, warns_of_remarks


@dataclass(frozen=True)
class UpdatingSettings:
    """Constants of model updating."""

    min_mac: float = 0.5  # below it a measured mode is no mode of the model
    doubtful_mac: float = 0.9  # below it the shapes differ: correlated modes are above (Ewins)
    false_alarm: float = 0.01  # chance of a false remark that the frequencies are not explained
    # decrease of χ² expected of a further step, above which the search is not at a minimum
    cost_tolerance: float = 0.01
    repeated_tolerance: float = 0.01  # relative difference of frequencies: small imperfections mix closer modes
    difference_step: float = 1e-4  # of the logarithm of a parameter, for central differences
    # smallest over largest singular value of the scaled Jacobian, of equivalent parameters
    min_singular_ratio: float = 1e-6


UPDATING = UpdatingSettings()
NO_MODEL = 1e8  # residual, in standard errors, of a trial step without such modes, so that it is rejected


@dataclass(frozen=True, eq=False, repr=False)
class UpdatedModel(Printed):
    """A model fitted to measured modes.

    Attributes:
        parameters: (n_parameters,) in their own units.
        covariance: (n_parameters, n_parameters) of the parameters.
        modes: of the model at these parameters.
        paired: (n_measured,) index of the model's mode paired with each measured mode.
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
            *self.remarks,
        )
        return f"{counted(len(rows), 'parameter')} updated", ("parameter", "value", "±"), rows, remarks

    @property
    def remarks(self) -> tuple[str, ...]:
        """Why the parameters are unreliable: no minimum, or frequencies or shapes that the model does not have."""
        remarks = [] if self.converged else [f"not converged: {self.reason}"]
        degrees_of_freedom = self.residuals.size - self.parameters.size
        chi2 = float(self.residuals @ self.residuals)
        limit = float(chi2_distribution.isf(UPDATING.false_alarm, degrees_of_freedom))
        if degrees_of_freedom and chi2 > limit:
            remarks.append(
                f"the frequencies are not explained: χ² is {chi2:.4g}, and noise alone gives at most {limit:.4g}; the"
                " standard errors of the parameters assume a model of the right form. Choose other or more parameters,"
                " or another start; else the standard errors of the frequencies are too small"
            )
        worst = int(np.argmin(self.mac))
        if self.mac[worst] < UPDATING.doubtful_mac:
            remarks.append(
                f"measured mode {worst + 1} does not look like the model's (MAC {self.mac[worst]:.2f}, at least"
                f" {UPDATING.doubtful_mac:g} where they agree): wrong parameters may give the right frequencies; choose"
                " those that change the shapes too"
            )
        return tuple(remarks)

    @property
    def std(self) -> np.ndarray:
        """(n_parameters,) standard errors."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


@warns_of_remarks
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

    The search is local: from a poor start it may end in another minimum, which residuals well beyond one and a low MAC
    show. The covariance is (Jᵀ J)⁻¹ at the minimum, J = ∂(ω(p) / σ)/∂p: it accounts for errors of the measurement, not
    of the model's form.

    Args:
        build: parameters p -> modes of the model, at least as many as were measured.
        start: (n_parameters,) p to start from, all positive.
        omega, omega_std: (n_measured,) measured frequencies and their standard errors, rad/s.
        shapes: (n_places, n_measured) measured shapes, of any scale, by which modes are paired.
        places: where they were measured, as the model's `Modes.phi` takes places.

    Raises:
        ValueError: numbers that are not positive, sizes that do not fit, more parameters than frequencies, a `build`
            that returns no modes, a measured mode that no mode of the model resembles, parameters that the measurements
            cannot distinguish.
        UserWarning: no minimum was reached, or the model at it does not have the measured frequencies or shapes.
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
        """For each measured mode: index and MAC of the model's mode, and Rayleigh's frequency of its shape."""
        if not isinstance(modes, Modes):
            raise ValueError(f"build must return modes, as model.modes(8) does; got {type(modes).__name__}")
        model_shapes = modes.phi(places)
        cluster = _joined(repeated_modes(modes.omega, UPDATING.repeated_tolerance), model_shapes, measured, target)
        rows, columns, agreement = assigned(measured, model_shapes, cluster)
        if rows.size < target.size or agreement[rows, columns].min() < UPDATING.min_mac:
            worst = int(np.argmin(agreement.max(axis=1)))
            raise ValueError(
                f"measured mode {worst + 1}, {target[worst] / (2 * np.pi):.4g} Hz, resembles no mode of the model: the"
                f" best MAC is {agreement[worst].max():.2f}; start nearer, let the model give more modes, or leave this"
                " one out"
            )
        quotients = modes.omega[columns]
        for r, s in enumerate(columns):
            members = cluster == cluster[s]
            if members.sum() > 1:
                share = np.abs(np.linalg.lstsq(model_shapes[:, members], measured[:, r])[0]) ** 2
                quotients[r] = np.sqrt(share @ modes.omega[members] ** 2 / share.sum())
        return columns, agreement[rows, columns], quotients

    refused: list[str] = []  # reasons why trial steps have no such modes; these steps are rejected

    def residuals(logarithms: np.ndarray) -> np.ndarray:
        try:
            return np.asarray((paired(build(first * np.exp(logarithms)))[2] - target) / deviation)
        except ValueError as error:
            refused.append(str(error))
            return np.full(target.size, NO_MODEL)

    def jacobian(logarithms: np.ndarray) -> np.ndarray:
        columns = []
        for step in UPDATING.difference_step * np.eye(first.size):
            sides = [(side, residuals(logarithms + side * step)) for side in (-1.0, 1.0)]
            valid = [(side, values) for side, values in sides if (values != NO_MODEL).any()]
            if len(valid) < 2:  # at the edge of the domain where the model has such modes: one-sided
                valid.append((0.0, residuals(logarithms)))
            (before, low), (after, high) = valid[0], valid[-1]
            columns.append((high - low) / ((after - before or 1.0) * UPDATING.difference_step))
        return np.column_stack(columns)

    paired(build(first))  # a start without such modes is an error of the user
    solution = least_squares(residuals, np.zeros(first.size), jac=jacobian, method="lm")
    parameters = first * np.exp(solution.x)
    singular = np.linalg.svd(solution.jac, compute_uv=False)
    if singular[-1] <= UPDATING.min_singular_ratio * singular[0]:
        raise ValueError(
            "the measured frequencies cannot distinguish the parameters: some change them alike, as stiffnesses in two"
            " directions do where repeated modes are turned half-way between; choose fewer"
        )
    modes = build(parameters)
    columns, agreement, _ = paired(modes)
    covariance = np.linalg.inv(solution.jac.T @ solution.jac) * np.outer(parameters, parameters)
    converged, reason = bool(solution.success), str(solution.message)
    if refused and ((np.linalg.qr(solution.jac)[0].T @ solution.fun) ** 2).sum() > UPDATING.cost_tolerance:
        converged = False
        reason = f"beyond these parameters the model has no such modes ({refused[-1]}); choose other parameters"
    return UpdatedModel(parameters, covariance, modes, columns, agreement, solution.fun, converged, reason)


def _joined(cluster: np.ndarray, model_shapes: np.ndarray, measured: np.ndarray, omega: np.ndarray) -> np.ndarray:
    """Cluster of each of the model's modes (n_modes,), joined as the modes measured as repeated.

    Each group of measured repeated modes joins the clusters of the modes whose shapes are most nearly in its span. Else
    a model whose parameters separate two modes slightly more would lose the measured shapes, and end the search.
    """
    cluster, order = cluster.copy(), np.argsort(omega)
    repeated = np.empty(omega.size, int)
    repeated[order] = repeated_modes(omega[order], UPDATING.repeated_tolerance)
    for each in np.unique(repeated):
        basis = np.linalg.qr(measured[:, repeated == each])[0]
        share = (np.abs(basis.conj().T @ model_shapes) ** 2).sum(axis=0) / (np.abs(model_shapes) ** 2).sum(axis=0)
        closest = np.argsort(-share, kind="stable")[: basis.shape[1]]
        cluster[np.isin(cluster, cluster[closest])] = cluster[closest].min()
    return cluster
