"""Structural modification: modes of a structure with attachments, computed from its modes alone."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.linalg import LinAlgError, eigh

from workbench.renamed import former_arguments
from workbench.structure.domain import Between, NamedPoints
from workbench.structure.modes import Modes
from workbench.structure.supports import Attachment, PointDamper, PointMass, masses_among

OWN = 4  # dynamic modes per requested mode
DIVERGES = 0.9  # ratio of flexibilities (see `truncation_error`) from which on the series counts as divergent
ROUNDING = 1e-9  # of the largest eigenvalue: rounding error of that of a rigid-body mode


@former_arguments(kept="n_modes", residual="residual_flexibility")
def attach(
    modes: Modes, attachments: tuple[Attachment, ...], *, n_modes: int | None = None, residual_flexibility: float = 0.0
) -> Modes:
    """The modes with masses, springs and dampers attached, by Rayleigh-Ritz in the given modes.

    Exact for dampers; for masses and springs the accuracy depends on how well the given modes span the changed shapes
    (`truncation_error`). Damping ratios stay with the modes, in order; a damping matrix that couples the modes is
    transformed as a property of the structure. Where profiles or matrices are known, solve the changed structure
    instead.

    Args:
        modes: of the structure without attachments; enough to represent the changed shapes.
        attachments: masses, springs and dampers.
        n_modes: number of modes returned. Four times as many of the given modes are dynamic; the others respond
            statically to the force of each attachment, with an error of the order of (ω / ω_n)⁴. By default all modes.
        residual_flexibility: flexibility at a point of all modes that are not given, m/N.

    MacNeal, Computers & Structures 1 (1971) 581, on residual flexibility.

    Raises:
        ValueError: more modes than given, a place outside, or masses or springs so negative that there are no modes.
    """
    if n_modes is not None:
        if not 1 <= n_modes <= modes.n_modes:
            raise ValueError(f"{modes.n_modes} modes give 1 to {modes.n_modes} with attachments; got n_modes={n_modes}")
        return _with_residual(modes, attachments, n_modes, residual_flexibility)
    n = modes.n_modes
    mass, stiffness = np.eye(n), np.diag(modes.omega**2)
    conservative = [part for part in attachments if not isinstance(part, PointDamper)]
    for part, derivative, value in _coefficients(conservative):
        shapes = _shapes_at(modes, part, derivative)
        target = mass if isinstance(part, PointMass) else stiffness
        target += value * shapes.T @ shapes
    if conservative:
        omega, vectors = _eigen(stiffness, mass)
        damping = _damping(modes, omega, vectors)
    else:
        omega, vectors, damping = modes.omega, np.eye(n), modes.damping
    for part, derivative, value in _coefficients(part for part in attachments if isinstance(part, PointDamper)):
        shape = _shapes_at(modes, part, derivative) @ vectors
        damping = damping + value * shape.T @ shape
    return _combined(modes, vectors, omega, damping, attachments)


def truncation_error(modes: Modes, attachments: tuple[Attachment, ...]) -> np.ndarray:
    """Estimated relative errors (n_modes,) of the frequencies of `attach` by modal truncation; inf where not known.

    The estimate is c max(r / (1 - r), 1). Here c is the change of a frequency when the upper half of the modes is left
    out, and r the ratio of contributions to the mean flexibility at a point: of the upper half of the modes over the
    quarter below. r is 1/8 for a beam and 1/2 for a plate. For a membrane or a solid it is 1 or more, as the
    flexibility at a point diverges, and there is no estimate; nor is there one for the upper half of the frequencies.
    """
    half = modes.n_modes // 2
    error = np.full(modes.n_modes, np.inf)
    if half:
        full, truncated = attach(modes, attachments).omega[:half], attach(modes.select(slice(half)), attachments).omega
        change = np.abs(np.divide(truncated, full, out=np.ones(half), where=full > 0) - 1.0)
        ratio = _decay(modes)
        error[:half] = (
            change * max(ratio / (1.0 - ratio), 1.0) if ratio < DIVERGES else np.where(change > 0, np.inf, 0.0)
        )
    return error


def _decay(modes: Modes) -> float:
    """Contribution of the upper half of modes to the mean flexibility at a point, over that of the quarter below."""
    n, elastic = modes.n_modes, modes.omega > 0
    mean = np.mean(modes.phi(modes.domain.grid(16)) ** 2, axis=0)
    flexibility = np.divide(mean, modes.omega**2, out=np.zeros(n), where=elastic)
    before, last = flexibility[n // 4 : n // 2].sum(), flexibility[n // 2 :].sum()
    return float(last / before) if before > 0 else 0.0


def _with_residual(modes: Modes, attachments: tuple[Attachment, ...], kept: int, residual: float) -> Modes:
    """The lowest `kept` modes, with the higher modes by their static response to each attachment.

    The residual flexibility of modes that are not given is a further coordinate per attachment, of the highest
    frequency.
    """
    own = min(OWN * kept, modes.n_modes)
    conservative = _coefficients(part for part in attachments if not isinstance(part, PointDamper))
    each = [_shapes_at(modes, part, derivative) for part, derivative, _ in conservative]
    rows = np.vstack([np.zeros((0, modes.n_modes)), *each])
    # rows of `rest`: static responses of the higher modes to the forces, of unit energy and orthogonal
    _, sizes, directions = np.linalg.svd(rows[:, own:] / modes.omega[own:], full_matrices=False)
    rest = directions[sizes > 1e-6 * sizes.max(initial=0.0)] / modes.omega[own:]
    places = list(dict.fromkeys(part.at for part, derivative, _ in conservative if derivative == 0 and residual))
    first = own + len(rest)  # of the coordinates of residual flexibility
    basis = np.zeros((modes.n_modes, first + len(places)))
    basis[:own, :own] = np.eye(own)
    basis[own:, own:first] = rest.T
    reduced = _combined(modes, basis, *np.zeros((2, basis.shape[1])))
    mass, stiffness = basis.T @ basis, basis.T @ (modes.omega[:, None] ** 2 * basis)
    stiffness[first:, first:] = np.eye(len(places))  # of unit energy
    mass[first:, first:] = np.eye(len(places)) / modes.omega[-1] ** 2
    for part, derivative, value in conservative:
        shapes = _shapes_at(reduced, part, derivative)
        if places and derivative == 0:
            shapes = shapes.copy()
            shapes[:, first + places.index(part.at)] = np.sqrt(residual)
        target = mass if isinstance(part, PointMass) else stiffness
        target += value * shapes.T @ shapes
    omega, vectors = _eigen(stiffness, mass, subset_by_index=[0, kept - 1])
    vectors = basis @ vectors
    changed = _combined(modes, vectors, omega, _damping(modes, omega, vectors), attachments)
    return attach(changed, tuple(part for part in attachments if isinstance(part, PointDamper)))


def _damping(modes: Modes, omega: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Damping (n_changed, n_changed) of changed modes: combinations (n_modes, n_changed) of the given, of `omega`."""
    if not modes.proportional:
        return np.asarray(vectors.T @ modes.damping @ vectors)
    given = slice(omega.size)
    # a rigid mode has no damping ratio: its coefficient c is kept
    of_rigid = np.diag(modes.damping)[given]
    return np.diag(np.where(modes.omega[given] > 0, 2.0 * modes.zeta[given] * omega, of_rigid))


def _coefficients(parts: Iterable[Attachment]) -> list[tuple[Attachment, int, float]]:
    """The coefficients that are not zero: the part, 0 of a displacement or 1 of a rotation, and the value."""
    return [(part, derivative, value) for part in parts for derivative, value in enumerate(part.pair) if value]


def _shapes_at(modes: Modes, part: Attachment, derivative: int) -> np.ndarray:
    """Shapes (n_directions, n_modes) at an attachment: of a mass, in every direction of its node."""
    if isinstance(part, PointMass) and isinstance(part.at, Between):
        raise ValueError(f"{part}: a mass is attached to one point; give it at each of the two")
    if isinstance(part, PointMass) and isinstance(modes.domain, NamedPoints) and derivative == 0:
        return modes.phi(modes.domain.translations(str(part.at)))
    return modes.phi_at(part.at, derivative)[None, :]


def _combined(
    modes: Modes, vectors: np.ndarray, omega: np.ndarray, damping: np.ndarray, attachments: tuple[Attachment, ...] = ()
) -> Modes:
    """Modes whose shapes are combinations `vectors` (n_modes, n_combined) of the given ones."""
    shapes = modes.shapes
    return replace(
        modes,
        omega=omega,
        damping=damping,
        shapes=lambda located, derivative: shapes(located, derivative) @ vectors,
        covariance=None,
        shape_covariance=None,
        masses=modes.masses + masses_among(attachments),
    )


def _eigen(stiffness: np.ndarray, mass: np.ndarray, **which: Any) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies, rad/s, and vectors of K v = ω² M v, with positive diagonal entries."""
    try:
        eigenvalues, vectors = eigh(stiffness, mass, **which)
    except LinAlgError as error:
        raise ValueError("a negative mass is too large: the mass matrix is not positive definite") from error
    if eigenvalues[0] < -ROUNDING * eigenvalues[-1]:
        raise ValueError("the structure is unstable with these springs: a negative stiffness is too large")
    return np.sqrt(np.maximum(eigenvalues, 0.0)), vectors * np.where(np.diag(vectors) < 0, -1.0, 1.0)
