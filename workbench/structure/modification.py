"""Modes of a structure with something attached, from its modes alone."""

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.linalg import LinAlgError, eigh

from workbench.renamed import former_arguments
from workbench.structure.domain import Between, NamedPoints
from workbench.structure.modes import Modes
from workbench.structure.supports import Attachment, PointDamper, PointMass, PointSpring, masses_among

OWN = 4  # modes that move on their own, for each that is asked for
DIVERGES = 0.9  # of that ratio: from here on the flexibility at a point has no end in sight
ROUNDING = 1e-9  # of the largest eigenvalue: what a rigid-body mode may be off by


@former_arguments(kept="n_modes", residual="residual_flexibility")
def attach(
    modes: Modes, attachments: tuple[Attachment, ...], *, n_modes: int | None = None, residual_flexibility: float = 0.0
) -> Modes:
    """The modes with masses, springs and dampers attached, by Rayleigh-Ritz in the modes at hand.

    Exact for dampers; for masses and springs as good as the modes at hand span the changed shapes (`truncation_error`).
    Damping ratios stay with the modes, in order; a damping matrix that couples them is that of dampers, and stays with
    the structure. Where profiles or matrices are known, solve anew instead.

    Args:
        modes: as many as the changed shapes take.
        attachments: what is attached.
        n_modes: how many modes come out, and how many of those at hand move on their own, four times as many; the
            others go with the force of each attachment as they do at rest: an error of the order of (ω / ω_n)⁴. All of
            them where not given.
        residual_flexibility: flexibility at a point of all modes that are not at hand, m/N.

    MacNeal, Computers & Structures 1 (1971) 581, on residual flexibility.
    """
    if n_modes is not None:
        return _with_residual(modes, attachments, n_modes, residual_flexibility)
    n = modes.n_modes
    mass, stiffness, extra_damping = np.eye(n), np.diag(modes.omega**2), []
    for part in attachments:
        if isinstance(part, PointDamper):
            extra_damping.append(part)
            continue
        target = mass if isinstance(part, PointMass) else stiffness
        for derivative, value in enumerate(part.pair):
            if value:
                shapes = _moved(modes, part, derivative)
                target += value * shapes.T @ shapes
    if any(isinstance(part, PointMass | PointSpring) for part in attachments):
        omega, vectors = _eigen(stiffness, mass)
        if modes.proportional:
            # a rigid mode has no ratio: what damps it stays as it is
            damping = np.diag(np.where(modes.omega > 0, 2.0 * modes.zeta * omega, np.diag(modes.damping)))
        else:
            damping = vectors.T @ modes.damping @ vectors
    else:
        omega, vectors, damping = modes.omega, np.eye(n), modes.damping
    for part in extra_damping:
        for derivative, value in enumerate(part.pair):
            if value:
                shape = _moved(modes, part, derivative) @ vectors
                damping = damping + value * shape.T @ shape
    return _combined(modes, vectors, omega, damping, attachments)


def truncation_error(modes: Modes, attachments: tuple[Attachment, ...]) -> np.ndarray:
    """What leaving out further modes costs the frequencies of `attach`: (n_modes,) relative, inf where unknown.

    The change of a frequency as the upper half of the modes at hand is left out, c, times r / (1 - r), and no less than
    c. Here r is what the last half of the modes adds to the mean flexibility at a point over what the quarter before
    adds: 1/8 of a beam, 1/2 of a plate. Of a membrane or a solid it is 1 or more: the flexibility at a point grows with
    every mode that is known, and nothing is known of the rest. The upper half of the frequencies have no such estimate.
    """
    half = modes.n_modes // 2
    error = np.full(modes.n_modes, np.inf)
    if half:
        whole, part = attach(modes, attachments).omega[:half], attach(modes.select(slice(half)), attachments).omega
        change = np.abs(np.divide(part, whole, out=np.ones(half), where=whole > 0) - 1.0)
        ratio = _decay(modes)
        error[:half] = (
            change * max(ratio / (1.0 - ratio), 1.0) if ratio < DIVERGES else np.where(change > 0, np.inf, 0.0)
        )
    return error


def _decay(modes: Modes) -> float:
    """What the upper half of modes adds to the mean flexibility at a point, over what the quarter before adds."""
    n, elastic = modes.n_modes, modes.omega > 0
    mean = np.mean(modes.phi(modes.domain.grid(16)) ** 2, axis=0)
    flexibility = np.divide(mean, modes.omega**2, out=np.zeros(n), where=elastic)
    before, last = flexibility[n // 4 : n // 2].sum(), flexibility[n // 2 :].sum()
    return float(last / before) if before > 0 else 0.0


def _with_residual(modes: Modes, attachments: tuple[Attachment, ...], kept: int, residual: float) -> Modes:
    """The lowest modes, from the next few as they are and the rest by their static answer to each attachment.

    Modes that are not at hand answer at the place of the force alone: a coordinate of its own, as fast as the highest.
    """
    own = min(OWN * kept, modes.n_modes)
    moving = [part for part in attachments if not isinstance(part, PointDamper)]
    rows = np.vstack([np.zeros((0, modes.n_modes)), *(_moved(modes, part, 0) for part in moving)])
    # each row of `rest` is the rest's static answer to one force, all of them of unit energy and apart from each other
    _, sizes, directions = np.linalg.svd(rows[:, own:] / modes.omega[own:], full_matrices=False)
    rest = directions[sizes > 1e-6 * sizes.max(initial=0.0)] / modes.omega[own:]
    places = list(dict.fromkeys(part.at for part in moving)) if residual else []
    alone = own + len(rest)
    basis = np.zeros((modes.n_modes, alone + len(places)))
    basis[:own, :own] = np.eye(own)
    basis[own:, own:alone] = rest.T
    reduced = _combined(modes, basis, *np.zeros((2, basis.shape[1])))
    mass, stiffness = basis.T @ basis, basis.T @ (modes.omega[:, None] ** 2 * basis)
    stiffness[alone:, alone:] = np.eye(len(places))  # of unit energy, as the others
    mass[alone:, alone:] = np.eye(len(places)) / modes.omega[-1] ** 2
    for part in moving:
        shapes = _moved(reduced, part, 0)
        if places:
            shapes = shapes.copy()
            shapes[:, alone + places.index(part.at)] = np.sqrt(residual)
        target = mass if isinstance(part, PointMass) else stiffness
        target += part.pair[0] * shapes.T @ shapes
    omega, vectors = _eigen(stiffness, mass, subset_by_index=[0, kept - 1])
    changed = _combined(modes, basis @ vectors, omega, modes.zeta[:kept], attachments)
    return attach(changed, tuple(part for part in attachments if isinstance(part, PointDamper)))


def _moved(modes: Modes, part: Attachment, derivative: int) -> np.ndarray:
    """Shapes (n_directions, n_modes) of what an attachment moves by: a mass moves in every direction of its node."""
    if isinstance(part, PointMass) and isinstance(part.at, Between):
        raise ValueError(f"{part}: a mass stands at one point; give it at each of the two")
    if isinstance(part, PointMass) and isinstance(modes.domain, NamedPoints) and derivative == 0:
        return modes.phi(modes.domain.translations(str(part.at)))
    return modes.phi_at(part.at, derivative)[None, :]


def _combined(
    modes: Modes,
    vectors: np.ndarray,
    omega: np.ndarray,
    damping: np.ndarray,
    attachments: tuple[Attachment, ...] = (),
) -> Modes:
    """Modes whose shapes are the columns of `vectors` (n_modes, n_combined) in those at hand."""
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
    """Frequencies, rad/s, and vectors of K v = ω² M v, each with its own mode positive."""
    try:
        eigenvalues, vectors = eigh(stiffness, mass, **which)
    except LinAlgError as error:
        raise ValueError("more mass is taken away than there is: a negative one is too large") from error
    if eigenvalues[0] < -ROUNDING * eigenvalues[-1]:
        raise ValueError("the structure is unstable with these springs: one of negative stiffness is too strong")
    return np.sqrt(np.maximum(eigenvalues, 0.0)), vectors * np.where(np.diag(vectors) < 0, -1.0, 1.0)
