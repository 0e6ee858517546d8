"""Modes of a structure with something attached, from its modes alone."""

import numpy as np
from scipy.linalg import eigh

from workbench.structure.domain import NamedPoints
from workbench.structure.modes import Modes
from workbench.structure.supports import Attachment, PointDamper, PointMass, PointSpring


def attach(modes: Modes, attachments: tuple[Attachment, ...]) -> Modes:
    """The modes with masses, springs and dampers attached, by Rayleigh-Ritz in the modes at hand.

    Exact for dampers; for masses and springs as good as the modes at hand span the changed shapes (`truncation_error`).
    Damping ratios stay with the modes, in order. Where profiles or matrices are known, solve anew instead.
    """
    n = modes.n_modes
    mass, stiffness, extra_damping = np.eye(n), np.diag(modes.omega**2), []
    for part in attachments:
        if isinstance(part, PointDamper):
            extra_damping.append(part)
            continue
        target = mass if isinstance(part, PointMass) else stiffness
        pair = (
            (part.mass, part.rotary_inertia)
            if isinstance(part, PointMass)
            else (part.stiffness, part.rotational_stiffness)
        )
        for derivative, value in enumerate(pair):
            if value:
                shapes = _moved(modes, part, derivative)
                target += value * shapes.T @ shapes
    if any(isinstance(part, PointMass | PointSpring) for part in attachments):
        eigenvalues, vectors = eigh(stiffness, mass)
        vectors = vectors * np.where(np.diag(vectors) < 0, -1.0, 1.0)
        omega = np.sqrt(np.maximum(eigenvalues, 0.0))
        damping = np.diag(2.0 * modes.zeta * omega)
    else:
        omega, vectors, damping = modes.omega, np.eye(n), modes.damping
    for part in extra_damping:
        for derivative, value in enumerate((part.coefficient, part.rotational_coefficient)):
            if value:
                shape = _moved(modes, part, derivative) @ vectors
                damping = damping + value * shape.T @ shape
    unchanged = modes.shapes
    return Modes(
        omega=omega,
        damping=damping,
        shapes=lambda located, derivative: unchanged(located, derivative) @ vectors,
        domain=modes.domain,
        essential=modes.essential,
    )


def truncation_error(modes: Modes, attachments: tuple[Attachment, ...]) -> np.ndarray:
    """What leaving out further modes costs the frequencies of `attach`: (n_modes,) relative, inf where unknown.

    The change of a frequency as the upper half of the modes at hand is left out. The series of a point's receptance
    falls at least as 1/n, so that what the modes not at hand would change is no more than that. The upper half of the
    frequencies have no such estimate.
    """
    half = modes.n_modes // 2
    error = np.full(modes.n_modes, np.inf)
    if half:
        whole, part = attach(modes, attachments).omega[:half], attach(modes.select(slice(half)), attachments).omega
        error[:half] = np.abs(np.divide(part, whole, out=np.ones(half), where=whole > 0) - 1.0)
    return error


def _moved(modes: Modes, part: Attachment, derivative: int) -> np.ndarray:
    """Shapes (n_directions, n_modes) of what an attachment moves by: a mass moves in every direction of its node."""
    if isinstance(part, PointMass) and isinstance(modes.domain, NamedPoints) and derivative == 0:
        return modes.phi(modes.domain.translations(str(part.at)))
    return modes.phi_at(part.at, derivative)[None, :]
