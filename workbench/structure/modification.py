"""Modes of a structure with something attached, from its modes alone."""

import numpy as np
from scipy.linalg import eigh

from workbench.structure.modes import Modes
from workbench.structure.supports import Attachment, PointDamper, PointMass, PointSpring


def attach(modes: Modes, attachments: tuple[Attachment, ...]) -> Modes:
    """The modes with masses, springs and dampers attached, by Rayleigh-Ritz in the modes at hand.

    Exact for dampers; for masses and springs as good as the modes at hand span the changed shapes. Damping ratios stay
    with the modes, in order. For a structure whose profiles are known, solve it anew instead.
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
                shape = modes.phi(part.at, derivative)[0]
                target += value * np.outer(shape, shape)
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
                shape = modes.phi(part.at, derivative)[0] @ vectors
                damping = damping + value * np.outer(shape, shape)
    shapes = modes.shapes
    return Modes(
        omega=omega,
        damping=damping,
        shapes=lambda x, derivative: shapes(x, derivative) @ vectors,
        length=modes.length,
        essential=modes.essential,
    )
