"""Bars and beams, with profiles, end conditions and attachments, and their modes by finite elements of high degree."""

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from scipy.linalg import LinAlgError, eigh

from workbench.arrays import Floats
from workbench.structure.damping import Damping, ModalDamping, ViscousDamping
from workbench.structure.domain import Interval, position
from workbench.structure.modes import Modes
from workbench.structure.polynomials import Segments
from workbench.structure.printed import Printed
from workbench.structure.profile import Profile, ProfileLike, as_profile
from workbench.structure.supports import (
    HELD,
    Attachment,
    End,
    PointDamper,
    PointMass,
    PointSpring,
    as_end,
    masses_among,
    support_text,
)
from workbench.threads import one_blas_thread

HIGHEST_DEGREE = 60
EVERY = 3  # degrees are multiples of this, so that few bases are computed
MOST_FUNCTIONS = 2400
MOST_SEGMENTS = 600  # more would take minutes and gigabytes
THINNEST = {0: 1e-9, 1: 1e-4}  # least segment over the length, by continuity; bending is lost in round-off below
NO_SLIVER = 1e-5  # of the length: a jump of a profile nearer to an end, or to another jump, is moved there
PROFILE_UNITS = {"mass_per_length": "kg/m", "axial_stiffness": "N", "bending_stiffness": "N m²"}
TIP = 1e-9  # of the stiffness at midspan: an end of no more stiffness is a tip, where the stiffness vanishes
CROWDING, COARSEST = 4.0, 0.25  # ratio of neighbouring segments towards a tip, and the largest of them over the length
INSIDE = (np.arange(8) + 0.5) / 8  # points along a segment at which the wavelength is evaluated
BUCKLED = 3  # half waves for the segments, and loads computed: the first bending load, after rigid-body rotations
TURNS = 1e-7  # of the load of a half wave: a lower load is that of a rigid-body rotation
RIGID = 1e-13  # of the eigenvalue of a half wave: a lower one is that of a rigid-body mode


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class _Member(Printed):
    length: float
    mass_per_length: Profile
    left: End
    right: End
    attachments: tuple[Attachment, ...] = ()
    damping: Damping = field(default_factory=ModalDamping)
    frequency_errors: tuple[float, ...] = ()

    stiffness_name: ClassVar[str]
    strain_order: ClassVar[int]
    _ends: ClassVar[tuple[str, ...]]  # names of possible ends

    @property
    def stiffness(self) -> Profile:
        """The profile named `stiffness_name`."""
        return getattr(self, self.stiffness_name)  # type: ignore[no-any-return]

    @property
    def _continuity(self) -> int:
        """Of the shapes: 0 of displacements alone, 1 of slopes too."""
        return self.strain_order - 1

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        at = self.length * np.array([0.0, 0.5, 1.0])
        profiles = {name: value for name, value in vars(self).items() if isinstance(value, Profile)}
        rows = [
            (f"{name.replace('_', ' ')} [{PROFILE_UNITS[name]}]", *(f"{v:.4g}" for v in profile(at)))
            for name, profile in profiles.items()
        ]
        ends = f"left {support_text(self.left, self._ends)}, right {support_text(self.right, self._ends)}"
        line = f"{type(self).__name__.lower()}, {self.length:g} m, {ends}"
        return line, ("", *(f"x = {x:.4g} m" for x in at)), rows, tuple(map(str, self.attachments))

    def __post_init__(self) -> None:
        Interval(self.length)  # refuses a length that is not positive
        object.__setattr__(self, "left", as_end(self.left, allowed=self._ends))
        object.__setattr__(self, "right", as_end(self.right, allowed=self._ends))
        object.__setattr__(self, "attachments", tuple(self.attachments))
        for name in ("mass_per_length", self.stiffness_name):
            profile = as_profile(getattr(self, name))
            object.__setattr__(self, name, profile)
            _check_positive(name, profile, self.length)
        for part in self.attachments:
            if not isinstance(part.at, float):
                raise ValueError(f"{part}: a place along a bar or beam is a position x, m; got {part.at!r}")
            if not 0 <= part.at <= self.length:
                raise ValueError(f"{part} is outside the structure, which runs from 0 to {self.length:g}")
            if isinstance(part, PointMass) and (part.mass < 0 or part.rotary_inertia < 0):
                raise ValueError(f"{part}: a mass cannot be negative; leave it out or lower mass_per_length")

    def _segments(self, n_modes: int, extra: int) -> Segments:
        """Segments that represent n_modes half waves, with `extra` degrees more than estimated."""
        nodes = segment_ends((*self.mass_per_length.breaks, *self.stiffness.breaks), self.length)
        for part in self.attachments:
            # a node at an attachment, where a derivative of the shapes jumps
            if np.abs(nodes - part.at).min() >= self._thinnest:
                nodes = np.sort(np.r_[nodes, part.at, self._graded(position(part.at))])
        if nodes.size > MOST_SEGMENTS:
            raise ValueError(
                f"the profiles and attachments of the structure make {nodes.size - 1} segments; at most"
                f" {MOST_SEGMENTS} are solved: give fewer points, or a smooth function"
            )
        half_waves = n_modes * self._shares_of_waves(nodes)
        pieces = np.array([-(-(_degree_for(each) + extra) // HIGHEST_DEGREE) for each in half_waves])
        degrees = [_degree_for(each / n) + extra // n for each, n in zip(half_waves, pieces, strict=True)]
        ends = (np.linspace(a, b, n + 1)[1:] for (a, b), n in zip(pairwise(nodes), pieces, strict=True))
        return Segments(
            np.concatenate([nodes[:1], *ends]), tuple(np.repeat(degrees, pieces).tolist()), self._continuity
        )

    def _shares_of_waves(self, nodes: np.ndarray) -> np.ndarray:
        """Share (n_segments,) of a high mode's half waves in each segment, by the local wavenumber (WKB)."""
        points = nodes[:-1, None] + np.diff(nodes)[:, None] * INSIDE
        ratio = self.mass_per_length(points.ravel()) / self.stiffness(points.ravel())
        density = ratio.reshape(points.shape) ** (0.5 / self.strain_order)
        waves: Floats = np.diff(nodes) * density.mean(axis=1)
        return waves / float(waves.sum())

    def _graded(self, at: float) -> list[float]:
        """Nodes graded from a tip beyond an attachment near it, where the motion is nearly singular."""
        graded = []
        for tip, inward in ((0.0, 1.0), (self.length, -1.0)):
            away = abs(at - tip)
            while self._is_tip(tip) and away < COARSEST * self.length / CROWDING:
                away *= CROWDING
                graded.append(tip + inward * away)
        return graded

    def _is_tip(self, end: float) -> bool:
        """Whether the stiffness vanishes at an end."""
        return bool(self.stiffness(end) <= TIP * self.stiffness(0.5 * self.length))

    @property
    def _thinnest(self) -> float:
        return THINNEST[self._continuity] * self.length

    def _motion_at(self, segments: Segments, at: float, derivative: int) -> np.ndarray:
        """The row that maps coefficients to the motion of an attachment; one very near a node is rigidly tied to it."""
        node = segments.nodes[np.argmin(np.abs(segments.nodes - at))]
        if self._continuity == 0 or abs(at - node) >= self._thinnest:
            return segments.evaluation(at, derivative)
        lever = (at - node) * segments.evaluation(node, 1) if derivative == 0 else 0.0
        return segments.evaluation(node, derivative) + lever

    @one_blas_thread
    def _solve(self, n_modes: int, tolerance: float, tension: float = 0.0) -> Modes:
        if n_modes < 1:
            raise ValueError(f"the number of modes must be at least 1; got {n_modes}")
        extra = 0
        while True:
            segments = self._segments(n_modes, extra)
            omega, coefficients, essential = self._eigenpairs(segments, n_modes, tension)
            if segments.unresolved(coefficients) < tolerance:
                break
            extra = 10 + 2 * extra
            if segments.n_functions > MOST_FUNCTIONS:
                warnings.warn(
                    "the modes did not converge to the tolerance: is there a jump in a profile given as a function?"
                    " Give its place by Profile(function, breaks=(x,)).",
                    stacklevel=4,  # the caller of `modes`, beyond the limit of threads
                )
                break

        def shapes(x: np.ndarray, derivative: int) -> np.ndarray:
            return np.asarray(segments.evaluation(x, derivative) @ coefficients)

        known = self.frequency_errors[:n_modes]
        omega[: len(known)] *= np.exp(known)
        return Modes(
            omega=omega,
            damping=self._damping_matrix(omega, segments, coefficients),
            shapes=shapes,
            domain=Interval(self.length),
            essential=essential,
            masses=masses_among(self.attachments),
        )

    def _eigenpairs(
        self, segments: Segments, n_modes: int, tension: float
    ) -> tuple[Floats, Floats, tuple[tuple[float, int], ...]]:
        order, stiffness = self.strain_order, self.stiffness
        mass = segments.assemble(self.mass_per_length, 0)
        rigidity = segments.assemble(stiffness, order)
        if tension:
            rigidity += segments.assemble(Profile.constant(tension), 1)
        held, essential, springs = self.restraints(segments)
        for value, row in self.point_masses(segments):
            mass += value * row.T @ row
        for spring, row in springs:
            rigidity += spring * row.T @ row
        free = np.delete(np.arange(segments.n_functions), held)
        if n_modes > free.size:
            raise ValueError(f"{n_modes} modes requested of {free.size} functions")
        mass, rigidity = mass[np.ix_(free, free)], rigidity[np.ix_(free, free)]
        # The inverse problem M v = ν (K + σ M) v: its largest eigenvalues are the lowest modes, so that round-off is
        # relative to these and not to the highest frequency of the basis. σ keeps K + σ M definite with rigid-body
        # modes.
        middle = np.linspace(0.05, 0.95, 19) * self.length
        typical = np.mean(stiffness(middle)) / np.mean(self.mass_per_length(middle))
        shift = typical * (np.pi / self.length) ** (2 * order)
        try:
            _, vectors = eigh(mass, rigidity + shift * mass, subset_by_index=[free.size - n_modes, free.size - 1])
        except LinAlgError as error:
            raise ValueError(_unstable(tension)) from error
        vectors = vectors[:, ::-1]
        coefficients = np.zeros((segments.n_functions, n_modes))
        coefficients[free] = vectors / np.sqrt(np.sum(vectors * (mass @ vectors), axis=0))
        # Rayleigh quotients from the curvatures: on a short segment the entries of K, EI/h³, cancel in a low mode, so
        # that 1/ν - σ is inaccurate; a sum of squares does not cancel.
        eigenvalues = segments.form(stiffness, order, coefficients)
        if tension:
            eigenvalues += segments.form(Profile.constant(tension), 1, coefficients)
        for spring, row in springs:
            eigenvalues += spring * (row @ coefficients)[0] ** 2
        if (eigenvalues < -1e-7 * shift).any():
            raise ValueError(_unstable(tension))
        omega = np.sqrt(np.where(eigenvalues < RIGID * shift, 0.0, eigenvalues))
        rigid = np.flatnonzero(omega == 0)
        if rigid.size == 2:
            slope = segments.evaluation(0.5 * self.length, 1)[0] @ coefficients[:, rigid]
            c, s = slope[1] / np.hypot(*slope), slope[0] / np.hypot(*slope)
            coefficients[:, rigid] = coefficients[:, rigid] @ np.array([[c, s], [-s, c]])
        coefficients *= self._signs(segments, coefficients)
        return omega, coefficients, tuple(essential)

    def _attached(self, segments: Segments, kind: type[Attachment]) -> list[tuple[float, np.ndarray]]:
        """The coefficients of attachments of a kind that are not zero, with the rows of their motions."""
        return [
            (value, self._motion_at(segments, position(part.at), derivative))
            for part in self.attachments
            if isinstance(part, kind)
            for derivative, value in enumerate(part.pair)
            if value
        ]

    def point_masses(self, segments: Segments) -> list[tuple[float, np.ndarray]]:
        """Attached masses and rotary inertias with the rows of their motions."""
        return self._attached(segments, PointMass)

    def restraints(
        self, segments: Segments
    ) -> tuple[list[int], list[tuple[float, int]], list[tuple[float, np.ndarray]]]:
        """Functions held by the ends, their (x, derivative), and springs with the rows of their elongations."""
        order = self.strain_order
        held, essential = [], []
        springs: list[tuple[float, np.ndarray]] = []
        last = segments.nodes.size - 1
        for node, at, end in ((0, 0.0, self.left), (last, self.length, self.right)):
            for derivative, spring in enumerate((end.translation, end.rotation)[:order]):
                if spring == HELD:
                    held.append(order * node + derivative)
                    essential.append((at, derivative))
                elif spring:
                    springs.append((spring, segments.evaluation(at, derivative)))
        return held, essential, springs + self._attached(segments, PointSpring)

    def _signs(self, segments: Segments, coefficients: np.ndarray) -> np.ndarray:
        """Signs (n_modes,) that make the first derivative that does not vanish at the left end positive."""
        middle = 0.5 * self.length
        size = 1.0 / np.sqrt(float(self.mass_per_length(middle)) * self.length)
        signs = np.zeros(coefficients.shape[1])
        for derivative in range(self.strain_order + 1):
            start = (segments.evaluation(0.0, derivative) @ coefficients)[0] * self.length**derivative / size
            signs = np.where((signs == 0) & (np.abs(start) > 1e-6), np.sign(start), signs)
            if signs.all():
                break
        return np.where(signs == 0, 1.0, signs)

    def _damping_matrix(self, omega: np.ndarray, segments: Segments, coefficients: np.ndarray) -> np.ndarray:
        if isinstance(self.damping, ViscousDamping):
            profile = as_profile(self.damping.coefficient_per_length)
            matrix: Floats = coefficients.T @ segments.assemble(profile, 0) @ coefficients
        else:
            matrix = self.damping.matrix(omega)
        for value, row in self._attached(segments, PointDamper):
            shapes = row @ coefficients
            matrix = matrix + value * shapes.T @ shapes
        return matrix


def checked_places(breaks: tuple[float, ...], length: float) -> np.ndarray:
    """Places (n_places,) where mass and stiffness with these breaks must be positive, m."""
    nodes = segment_ends(breaks, length)
    return np.asarray((nodes[:-1, None] + np.diff(nodes)[:, None] * np.linspace(0.002, 0.998, 101)).ravel())


@lru_cache(maxsize=64)  # often only one of the profiles changes
def _check_positive(name: str, profile: Profile, length: float) -> None:
    inside = checked_places(profile.breaks, length)
    values = profile(inside)
    if not np.isfinite(values).all() or (values <= 0).any():
        i = int(np.argmax(~(values > 0)))
        raise ValueError(
            f"{name} must be positive inside the structure; it is {values[i]:g} at x = {inside[i]:g}"
            " (it may vanish at an end)"
        )


def segment_ends(breaks: Iterable[float], length: float, slack: float = NO_SLIVER) -> np.ndarray:
    """The ends of a structure and the breaks between them, at least `slack` of the length apart, m."""
    slack *= length
    inside = sorted(b for b in breaks if slack < b < length - slack)
    nodes = [0.0]
    for b in [*inside, length]:
        if b - nodes[-1] > slack:
            nodes.append(b)
    return np.array(nodes)


def _degree_for(half_waves: float) -> int:
    """The degree of a polynomial that represents half waves to ten digits, beyond which J_k(z) < 1e-10 (Bessel)."""
    degree = int(np.ceil(0.5 * np.pi * half_waves + 10.0 * half_waves ** (1.0 / 3.0))) + 3
    return -(-degree // EVERY) * EVERY


def _unstable(tension: float) -> str:
    if tension < 0:
        return f"a tension of {tension:g} compresses the beam beyond buckling; lower its magnitude"
    return "the structure is unstable: an eigenvalue ω² is negative; check springs and profiles"


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Bar(_Member):
    """A bar in axial vibration: -(EA u')' = ω² m u (4.26).

    Attributes:
        length: m.
        mass_per_length: kg/m; a number, a function of x, points (x, values), or a `Profile`.
        axial_stiffness: EA in N, likewise. Either may vanish at an end.
        left, right: "fixed", "free" or an `End(translation)`.
        attachments: `PointMass`, `PointSpring`, `PointDamper`.
        damping: `ModalDamping`, `ProportionalDamping` or `ViscousDamping`.
        frequency_errors: (n_modes,) ln of the ratio of natural frequencies to those computed from the profiles.
        stiffness_name: "axial_stiffness", the name of the profile `stiffness`, the EA of the strain energy.
        strain_order: 1, the order of the derivative of the shape in the strain energy.

    Raises:
        ValueError: a profile that is not positive, an end of unknown name, an attachment outside or against rotation, a
            spring or mass on a tip, where the stiffness vanishes.
    """

    axial_stiffness: Profile
    stiffness_name = "axial_stiffness"
    strain_order = 1
    _ends = ("fixed", "free")

    if TYPE_CHECKING:  # the arguments may have short forms, which become `Profile` and `End`

        def __init__(
            self,
            *,
            length: float,
            mass_per_length: ProfileLike,
            axial_stiffness: ProfileLike,
            left: str | End,
            right: str | End,
            attachments: Sequence[Attachment] = (),
            damping: Damping = ...,
            frequency_errors: Sequence[float] = (),
        ) -> None: ...

    def __post_init__(self) -> None:
        super().__post_init__()
        for part in self.attachments:
            if part.pair[1]:
                raise ValueError(f"{part}: a bar in axial vibration does not rotate; leave {fields(part)[-1].name} out")
            at = position(part.at)
            end = 0.0 if at < 0.5 * self.length else self.length
            on_end = abs(at - end) < NO_SLIVER * self.length and isinstance(part, PointSpring | PointMass)
            if on_end and self._is_tip(end):
                raise ValueError(
                    f"{part} is on a tip: axial_stiffness vanishes at x = {end:g}, where a point force has an"
                    " infinite displacement; attach it further in, or give the tip some stiffness"
                )

    def modes(self, n_modes: int, *, tolerance: float = 1e-10) -> Modes:
        """The lowest `n_modes` modes, mass-normalised, resolved to `tolerance` in their highest derivative."""
        return self._solve(n_modes, tolerance)


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Beam(_Member):
    """An Euler-Bernoulli beam in bending: (EI w'')'' - T w'' = ω² m w.

    Attributes:
        length: m.
        mass_per_length: kg/m; a number, a function of x, points (x, values), or a `Profile`.
        bending_stiffness: EI in N m², likewise. Either may vanish at an end.
        left, right: "hinged", "clamped", "free", "sliding" or an `End(translation, rotation)`.
        attachments: `PointMass`, `PointSpring`, `PointDamper`.
        damping: `ModalDamping`, `ProportionalDamping` or `ViscousDamping`.
        tension: axial load in N, positive in tension.
        frequency_errors: (n_modes,) ln of the ratio of natural frequencies to those computed from the profiles.
        stiffness_name: "bending_stiffness", the name of the profile `stiffness`, the EI of the strain energy.
        strain_order: 2, the order of the derivative of the shape in the strain energy.

    Raises:
        ValueError: a profile that is not positive, an end of unknown name, an attachment outside, buckling.
    """

    bending_stiffness: Profile
    tension: float = 0.0
    stiffness_name = "bending_stiffness"
    strain_order = 2
    _ends = ("hinged", "clamped", "free", "sliding")

    if TYPE_CHECKING:  # the arguments may have short forms, which become `Profile` and `End`

        def __init__(
            self,
            *,
            length: float,
            mass_per_length: ProfileLike,
            bending_stiffness: ProfileLike,
            left: str | End,
            right: str | End,
            attachments: Sequence[Attachment] = (),
            damping: Damping = ...,
            tension: float = 0.0,
            frequency_errors: Sequence[float] = (),
        ) -> None: ...

    def modes(self, n_modes: int, *, tolerance: float = 1e-10) -> Modes:
        """The lowest `n_modes` modes, mass-normalised, resolved to `tolerance` in their highest derivative."""
        return self._solve(n_modes, tolerance, self.tension)

    @one_blas_thread
    def buckling_load(self) -> float:
        """The buckling load, N: the least P of K v = P G v, G = ∫ w' w' dx, without the present tension.

        Rigid-body rotation of an unsupported beam, which occurs under any compression, is left out.

        Raises:
            ValueError: negative springs that make the beam unstable without compression.
        """
        segments = self._segments(BUCKLED, 0)
        rigidity = segments.assemble(self.bending_stiffness, 2)
        slopes = segments.assemble(Profile.constant(1.0), 1)
        held, _, springs = self.restraints(segments)
        for spring, row in springs:
            rigidity += spring * row.T @ row
        on_ground = [part.pair[0] for part in self.attachments if isinstance(part, PointSpring)]
        if not any((self.left.translation, self.right.translation, *on_ground)):
            held.append(0)  # excludes the rigid-body translation
        free = np.delete(np.arange(segments.n_functions), held)
        rigidity, slopes = rigidity[np.ix_(free, free)], slopes[np.ix_(free, free)]
        unit = float(np.mean(self.bending_stiffness(self.length * INSIDE))) * (np.pi / self.length) ** 2
        largest = [free.size - BUCKLED, free.size - 1]
        try:
            # largest eigenvalues of the inverse problem, as for the modes
            loads = 1.0 / eigh(slopes, rigidity + unit * slopes, eigvals_only=True, subset_by_index=largest) - unit
        except LinAlgError as error:
            raise ValueError(_unstable(0.0)) from error
        if (loads < -TURNS * unit).any():
            raise ValueError(_unstable(0.0))
        return float(loads[loads > TURNS * unit].min())


Structure = Bar | Beam
