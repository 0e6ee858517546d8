"""Modes: frequencies, damping and shapes, computed or identified, in one type."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from workbench.arrays import Complexes, Flags, Floats, Integers
from workbench.renamed import Renamed, former_arguments
from workbench.structure.domain import (
    Between,
    Derivative,
    Domain,
    Interval,
    Location,
    NamedPoints,
    Patch,
    PlaceError,
    Rectangle,
    as_domain,
    position,
)
from workbench.structure.printed import Printed, counted
from workbench.structure.supports import PointMass

Shapes = Callable[[np.ndarray, Any], np.ndarray]
HELD = 1e-9  # of the largest displacement: a place that moves less is held by a support
EDGE_POINTS = 12, 2.0  # quadrature points of a patch's edge: fixed number, and per half wave along it
PATCHES_AT_ONCE = 256


def frozen(array: ArrayLike, dtype: type = float) -> np.ndarray:
    """A read-only copy of an array, for the fields of frozen types; the array itself where it is read-only already."""
    if type(array) is np.ndarray and array.dtype == dtype and array.base is None and not array.flags.writeable:
        return array
    copy: np.ndarray = np.array(array, dtype=dtype)
    copy.flags.writeable = False
    return copy


def freeze(owner: object, *names: str, dtype: type | None = float) -> None:
    """Make fields of a frozen type read-only copies, for its `__post_init__`; no dtype for places, numbers or names."""
    for name in names:
        value = getattr(owner, name)
        kind = dtype or (object if np.asarray(value).dtype.kind in "OU" else float)
        object.__setattr__(owner, name, frozen(value, kind))


def modal_state_matrix(stiffness: ArrayLike, damping: ArrayLike) -> np.ndarray:
    """A = [0 I; -S -C] of q'' + C q' + S q = f, states (q_1..q_n, q_1'..q_n'): (2 n_modes, 2 n_modes), rad/s.

    S (1/s²) and C (1/s) are matrices (n_modes, n_modes), or their diagonals.
    """
    s, c = (np.diag(m) if np.ndim(m) == 1 else np.asarray(m) for m in (stiffness, damping))
    return np.block([[np.zeros(s.shape), np.eye(len(s))], [-s, -c]])


@dataclass(frozen=True, eq=False, repr=False)
class Modes(Printed):
    """Mass-normalised modes with shapes at every place of a domain: ∫ m φ_r φ_s dx = δ_rs (2.5), with attached masses.

    Each modal coordinate obeys q_r'' + Σ_s c_rs q_s' + ω_r² q_r = f_r (2.10).

    Attributes:
        omega: (n_modes,) undamped natural frequencies, rad/s, not decreasing; 0 for a rigid-body mode.
        damping: (n_modes, n_modes) coefficients c_rs of (2.11), 1/s; diagonal 2 ζ_r ω_r for modal damping. A vector
            (n_modes,) is taken as the damping ratios ζ_r.
        shapes: callable (located, derivative) -> (n_points, n_modes), located as returned by `domain.locate`:
            positions (n_points,) on an interval, with the order of the derivative along x; (n_points, 2) on a
            rectangle, with the orders (i, j) along x and y; indices (n_points,) of named points, without derivative.
        domain: the set of places; a number is the length, m, of an interval.
        essential: ((x, derivative), ...) where the supports of an interval hold the shape or its slope at zero.
        covariance: (2 n_modes, 2 n_modes) of (ω, ζ) of identified modes; None of computed ones.
        shape_covariance: (n_modes, n_points, n_points) of each identified mode's shape at named points; None of
            computed modes, or where the identification gives none.
        masses: attached at points; the normalisation includes them beside the mass per length or area.

    Raises:
        ValueError: negative or non-finite frequencies, mismatched shapes.
    """

    omega: np.ndarray
    damping: np.ndarray
    shapes: Shapes
    domain: Domain
    essential: tuple[tuple[float, int], ...] = ()
    covariance: np.ndarray | None = None
    shape_covariance: np.ndarray | None = None
    masses: tuple[PointMass, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "domain", as_domain(self.domain))
        freeze(self, "omega")
        omega = self.omega
        damping = np.asarray(self.damping, float)
        if omega.ndim != 1 or omega.size == 0:
            raise ValueError(f"Modes.omega must have shape (n_modes,) with at least one mode; got {omega.shape}")
        if not np.isfinite(omega).all() or (omega < 0).any():
            raise ValueError(f"Modes.omega must be finite and not negative, rad/s; got {omega}")
        if damping.ndim < 2:
            damping = np.diag(np.broadcast_to(2.0 * damping * omega, omega.shape))
        if damping.shape != (omega.size, omega.size) or not np.isfinite(damping).all():
            raise ValueError(
                f"Modes.damping must be finite, (n_modes,) ratios or (n_modes, n_modes) c_rs with n_modes ="
                f" {omega.size}; got shape {damping.shape}"
            )
        object.__setattr__(self, "damping", frozen(damping))
        freeze(self, *(name for name in ("covariance", "shape_covariance") if getattr(self, name) is not None))
        if self.shape_covariance is not None:
            n_points = len(self.domain.names) if isinstance(self.domain, NamedPoints) else 0
            if self.shape_covariance.shape != (omega.size, n_points, n_points):
                raise ValueError(
                    f"Modes.shape_covariance is of shapes at named points, {(omega.size, n_points, n_points)}; got"
                    f" {self.shape_covariance.shape} on {self.domain}"
                )

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        each = enumerate(zip(self.frequencies_hz, self.zeta))
        rows = [(str(r + 1), f"{f:.6g}", f"{100 * z:.4g}") for r, (f, z) in each]
        coupled = () if self.proportional else ("damping couples the modes; the ratios are those of its diagonal",)
        line = f"{counted(self.n_modes, 'mode')}, {_range_hz(self.frequencies_hz)}, on {self.domain}"
        return line, ("mode", "frequency [Hz]", "damping [%]"), rows, coupled

    @property
    def n_modes(self) -> int:
        return self.omega.size

    @property
    def state_matrix(self) -> np.ndarray:
        """A = [0 I; -Ω² -C], states (q, q'): (2 n_modes, 2 n_modes), rad/s."""
        return modal_state_matrix(self.omega**2, self.damping)

    @property
    def zeta(self) -> np.ndarray:
        """Damping ratios (n_modes,): c_rr / (2 ω_r), and 0 for a rigid-body mode."""
        c = np.diag(self.damping)
        return np.divide(c, 2.0 * self.omega, out=np.zeros_like(c), where=self.omega > 0)

    @property
    def frequencies_hz(self) -> np.ndarray:
        """Natural frequencies (n_modes,), Hz."""
        return self.omega / (2.0 * np.pi)

    @property
    def proportional(self) -> bool:
        """Whether damping does not couple the modes (2.14)."""
        diagonal = np.diag(self.damping)
        return bool(np.abs(self.damping - np.diag(diagonal)).max() <= 1e-12 * max(np.abs(diagonal).max(), 1e-300))

    @property
    def length(self) -> float:
        """Length of the interval, m.

        Raises:
            AttributeError: modes of another domain, which has a `domain.size`.
        """
        if not isinstance(self.domain, Interval):
            raise AttributeError("only modes along an interval have a length; see domain.size")
        return self.domain.length

    def phi(self, places: Any, derivative: Derivative = 0, *, direction: str | None = None) -> Floats:
        """Mode shapes at places, or their slopes: (n_places, n_modes).

        Args:
            places: one or several of the domain: positions x (m), pairs (x, y), or names.
            derivative: 0 for the displacement, 1 for the slope, further ones along an interval; (i, j) for those along
                x and y of a rectangle.
            direction: of the displacement, or the axis of the slope, where the domain has more than one.

        Raises:
            ValueError: a place outside the structure, a direction that it does not have there.
        """
        places, derivative, sign = self.domain.slope(places, derivative, direction)
        values = np.asarray(self.shapes(self.domain.locate(places), derivative), float)
        return values if sign == 1.0 else sign * values

    def phi_at(self, where: Location, derivative: Derivative = 0, *, direction: str | None = None) -> Floats:
        """Mode shapes (n_modes,) at a place, their difference between two, or ∮ ∂φ/∂n ds of a patch."""
        if isinstance(where, Between):
            first, second = (self.phi(place, derivative, direction=direction)[0] for place in where)
            return np.asarray(first - second)
        if isinstance(where, Patch):
            if derivative != 1:
                raise PlaceError("a patch acts on a plate by moments along its edges, not by a force or displacement")
            return np.asarray(self.edge_slopes([where], direction=direction)[0])
        at = position(where) if isinstance(self.domain, Interval) else where
        return np.asarray(self.phi(at, derivative, direction=direction)[0])

    def edge_slopes(self, patches: Any, *, direction: str | None = None) -> Floats:
        """Slopes across the edges of patches of a plate, integrated along them: (n_patches, n_modes).

        ∮ ∂φ_r/∂n ds with n outward: the modal force of a line moment of 1 N m/m along all four edges, equal to
        ∫∫ ∇²φ_r dA (Dimitriadis, Fuller & Rogers, J. Vib. Acoust. 113 (1991) 100).

        Args:
            patches: (n_patches, 4) middle (x, y), width and height, m.
            direction: "y" for the two edges across x alone, whose moments act about y; "x" for the other two.

        Raises:
            PlaceError: another domain, or a patch that reaches outside.
        """
        if not isinstance(self.domain, Rectangle):
            raise PlaceError(f"a patch is placed on a plate; these modes are of {self.domain}")
        each = np.asarray(patches, float).reshape(-1, 4)
        if len(each) > PATCHES_AT_ONCE:
            parts = np.array_split(each, -(-len(each) // PATCHES_AT_ONCE))
            return np.concatenate([self.edge_slopes(part, direction=direction) for part in parts])
        # mode n has at most n half waves along a side
        fixed, per_wave = EDGE_POINTS
        n_points = fixed + round(per_wave * self.n_modes * (each[:, 2:] / self.domain.length).clip(0, 1).max(initial=0))
        total = np.zeros((len(each), self.n_modes))
        for at, derivative, weights in self.domain.around(each, direction, n_points):
            slopes = self.phi(at.reshape(-1, 2), derivative).reshape(*weights.shape, -1)
            total += np.einsum("pk,pkr->pr", weights, slopes)
        return total

    def is_held(self, where: Location, derivative: Derivative = 0, *, direction: str | None = None) -> bool:
        """Whether a support holds the displacement, or the slope, of every mode at a place at zero."""
        if isinstance(self.domain, Interval) and not isinstance(where, Between):
            slack = 1e-9 * self.domain.length
            return any(held == derivative and abs(where - at) <= slack for at, held in self.essential)  # type: ignore
        if derivative:
            return False
        return bool(self._hardly_move(self.phi_at(where, derivative, direction=direction)))

    are_still = Renamed("are_held")

    def are_held(self, places: ArrayLike) -> Flags:
        """Whether supports hold the displacements at places (n_places,); see `is_held`."""
        return self._hardly_move(self.phi(places))

    def _hardly_move(self, phi: Floats) -> Flags:
        """Whether all mode shapes' values (..., n_modes) are negligible beside the largest displacement, (...)."""
        return np.asarray(np.abs(phi).max(axis=-1) <= HELD * self._largest)

    @cached_property
    def _largest(self) -> float:
        """The largest displacement of any mode on a grid over the domain."""
        return float(np.abs(self.phi(self.domain.grid(12))).max())

    def select(self, modes: Sequence[int] | slice) -> "Modes":
        """The modes of some zero-based indices, of a slice, or of a mask (n_modes,)."""
        index = _indices(modes, self.n_modes)
        if index.size == 0 or index.min() < 0 or index.max() >= self.n_modes:
            raise ValueError(f"modes {index.tolist()} are not all among the {self.n_modes} modes at hand (from 0)")
        shapes, both = self.shapes, np.r_[index, index + self.n_modes]
        return replace(
            self,
            omega=self.omega[index],
            damping=self.damping[np.ix_(index, index)],
            shapes=lambda located, derivative: shapes(located, derivative)[:, index],
            covariance=None if self.covariance is None else self.covariance[np.ix_(both, both)],
            shape_covariance=None if self.shape_covariance is None else self.shape_covariance[index],
        )


Modes.__init__ = former_arguments(length="domain")(Modes.__init__)  # type: ignore[method-assign]


class PointShapes:
    """Shapes known at named points only: `values` (n_points, n_modes), mass-normalised, in the order of the points."""

    def __init__(self, values: ArrayLike) -> None:
        self.values: Floats = frozen(np.atleast_2d(values))

    def __call__(self, index: Integers, derivative: int = 0) -> Floats:
        return self.values[index]


@dataclass(frozen=True, eq=False, repr=False)
class SampledModes(Printed):
    """Identified modes: complex, of arbitrary scale, with shapes at the sensors only.

    Attributes:
        omega: (n_modes,) rad/s, increasing.
        zeta: (n_modes,) damping ratios.
        shapes: (n_outputs, n_modes) complex, one row per sensor; scale arbitrary.
        positions: places of the sensors: (n_outputs,) or (n_outputs, 2) m, nan where unknown, or (n_outputs,) names.
    """

    omega: Floats
    zeta: Floats
    shapes: Complexes
    positions: np.ndarray

    @classmethod
    def of_poles(cls, poles: Complexes, shapes: np.ndarray, positions: np.ndarray) -> "SampledModes":
        """Modes of poles λ (n_modes,), rad/s, in order of increasing |λ|: ω = |λ| and ζ = -Re λ / |λ|."""
        return cls(np.abs(poles), -poles.real / np.abs(poles), shapes, positions)

    def __post_init__(self) -> None:
        freeze(self, "omega", "zeta")
        freeze(self, "shapes", dtype=complex)
        freeze(self, "positions", dtype=None)
        n, m = self.omega.size, len(self.positions)
        if self.zeta.shape != (n,) or self.shapes.shape != (m, n):
            raise ValueError(
                f"SampledModes with {n} frequencies and {m} positions needs zeta ({n},) and shapes ({m}, {n}); got"
                f" {self.zeta.shape} and {self.shapes.shape}"
            )

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        each = enumerate(zip(self.frequencies_hz, self.zeta, self.phase_collinearity))
        rows = [(str(r + 1), f"{f:.6g}", f"{100 * z:.4g}", f"{mpc:.4f}") for r, (f, z, mpc) in each]
        sensors = counted(self.n_outputs, "sensor")
        line = f"{counted(self.n_modes, 'mode')} at {sensors}, {_range_hz(self.frequencies_hz)}"
        return line, ("mode", "frequency [Hz]", "damping [%]", "phase collinearity"), rows, ()

    @property
    def n_modes(self) -> int:
        return self.omega.size

    @property
    def frequencies_hz(self) -> np.ndarray:
        """Natural frequencies (n_modes,), Hz."""
        return self.omega / (2.0 * np.pi)

    @property
    def n_outputs(self) -> int:
        return len(self.shapes)

    unplaced, is_along, is_over = Renamed("without_position"), Renamed("on_interval"), Renamed("on_plate")

    @property
    def without_position(self) -> Flags:
        """Which sensors have no known position, (n_outputs,)."""
        if self.positions.dtype == object:
            return np.array([place is None for place in self.positions])
        return np.asarray(~np.isfinite(self.positions.reshape(self.n_outputs, -1)).all(axis=1))

    @property
    def on_interval(self) -> bool:
        """Whether every sensor has a known position along an interval."""
        return self.positions.ndim == 1 and self.positions.dtype != object and not self.without_position.any()

    @property
    def on_plate(self) -> bool:
        """Whether every sensor has a known position on a plate."""
        return self.positions.ndim == 2 and not self.without_position.any()

    @property
    def poles(self) -> Complexes:
        """Upper-half-plane poles (n_modes,): -ζω + iω√(1-ζ²), rad/s."""
        return -self.zeta * self.omega + 1j * self.omega * np.sqrt(np.maximum(1.0 - self.zeta**2, 0.0))

    def select(self, modes: Sequence[int] | slice) -> "SampledModes":
        """The modes of some zero-based indices, of a slice, or of a mask (n_modes,)."""
        index = _indices(modes, self.n_modes)
        return SampledModes(self.omega[index], self.zeta[index], self.shapes[:, index], self.positions)

    @property
    def phase_collinearity(self) -> Floats:
        """Modal phase collinearity MPC (n_modes,): 1 for a real shape, 0 for a travelling wave.

        Pappa, Elliott & Schenk, NASA TM-107607 (1992).
        """
        x, y = self.shapes.real, self.shapes.imag
        sxx, syy, sxy = (x * x).sum(0), (y * y).sum(0), (x * y).sum(0)
        ratio: Floats = np.hypot(sxx - syy, 2.0 * sxy) / np.maximum(sxx + syy, 1e-300)
        return ratio**2


def mac(first: ArrayLike, second: ArrayLike) -> Floats:
    """Modal assurance criterion between two sets of shapes at the same places.

    MAC_rs = |φ_r^H ψ_s|² / (φ_r^H φ_r · ψ_s^H ψ_s) (Allemang & Brown 1982).

    Args:
        first: (n_points, n_first) shapes, real or complex.
        second: (n_points, n_second).

    Returns:
        (n_first, n_second), between 0 and 1.
    """
    a, b = np.asarray(first), np.asarray(second)
    a, b = a.reshape(a.shape[0], -1), b.reshape(b.shape[0], -1)
    if a.shape[0] != b.shape[0]:
        raise ValueError(f"MAC compares shapes at the same places; got {a.shape[0]} and {b.shape[0]} of them")
    norms = np.outer((np.abs(a) ** 2).sum(0), (np.abs(b) ** 2).sum(0))
    return np.asarray(np.abs(a.conj().T @ b) ** 2 / np.maximum(norms, 1e-300))


def _indices(modes: Sequence[int] | slice, n_modes: int) -> Integers:
    """Zero-based indices of modes that are given by them, by a slice, or by a mask."""
    if isinstance(modes, slice) or np.asarray(modes).dtype == bool:
        return np.arange(n_modes)[modes]
    return np.asarray(modes, int)


def _range_hz(frequencies: np.ndarray) -> str:
    ends = [f"{f:.4g}" for f in (frequencies.min(initial=np.inf), frequencies.max(initial=0.0))]
    return f"{' to '.join(dict.fromkeys(ends))} Hz" if frequencies.size else "no frequency"
