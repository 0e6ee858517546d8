"""The work of the actuators in every mode: negative in the controlled ones, spillover in the residual ones.

Dissertation (5.18)-(5.44). With W_r the work of all actuators in mode r, W_C sums the controlled modes and W_R the
residual ones. For an undamped residual mode at rest and t_f to infinity the double integral (5.43) is

    W_r = ½ |b_rᵀ F(iω_r)|²,   F(s) = -K (s I - A_C)⁻¹ x_C(0),

the energy that the actuators' forces leave in the mode. Work, cost and effort are linear in the second moments
∫ x xᵀ dt of the state.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm, matrix_balance, solve_continuous_lyapunov

from workbench.arrays import Complexes, Flags, Floats
from workbench.design.laws.coupled import ON_AXIS
from workbench.design.laws.imsc import riccati_matrices
from workbench.design.laws.law import DesignError, Law, controlled_indices
from workbench.design.laws.on_off import OnOffLaw
from workbench.design.loop.closed_loop import ClosedLoop, Response, close_loop
from workbench.design.loop.on_off_response import motion, switchings
from workbench.renamed import Renamed, former_fields
from workbench.rig.linear import integrated
from workbench.rig.statespace import input_matrix
from workbench.structure.domain import gauss_between
from workbench.structure.modes import Modes, freeze
from workbench.structure.printed import Printed

GAUSS_POINTS = 12  # per radian of the fastest mode between switchings


@former_fields(by_mode="work_by_mode")
@dataclass(frozen=True, eq=False, repr=False)
class Spillover(Printed):
    """Work of the actuators by mode, J (or the consistent unit).

    Attributes:
        work_by_mode: (n_modes,) W_r of every mode, controlled or residual.
        controlled: zero-based indices of the controlled modes.
        final_time: s; inf for the limit.
    """

    work_by_mode: np.ndarray
    controlled: tuple[int, ...]
    final_time: float

    residual, controlled_total = Renamed("residual_modes"), Renamed("controlled_work")
    residual_total = Renamed("residual_work")

    def __post_init__(self) -> None:
        freeze(self, "work_by_mode")

    @property
    def residual_modes(self) -> tuple[int, ...]:
        """Zero-based indices of the residual modes (n_residual,)."""
        return tuple(r for r in range(self.work_by_mode.size) if r not in self.controlled)

    @property
    def residual_work_by_mode(self) -> np.ndarray:
        """W_r of the residual modes, (n_residual,)."""
        return self.work_by_mode[list(self.residual_modes)]

    @property
    def controlled_work(self) -> float:
        """W_C = Σ W_r of the controlled modes."""
        return float(self.work_by_mode[list(self.controlled)].sum())

    @property
    def residual_work(self) -> float:
        """W_R = Σ W_r of the residual modes."""
        return float(self.residual_work_by_mode.sum())

    @property
    def total(self) -> float:
        """W = W_C + W_R (5.27)."""
        return float(self.work_by_mode.sum())

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        until = "for all time" if np.isinf(self.final_time) else f"until {self.final_time:g} s"
        line = f"work of the actuators {until}: W_C = {self.controlled_work:.4g} J, W_R = {self.residual_work:.4g} J"
        rows = [
            (str(r + 1), "controlled" if r in self.controlled else "residual", f"{work:.4g}")
            for r, work in enumerate(self.work_by_mode)
        ]
        return line, ("mode", "", "W_r [J]"), rows, ()


def spillover(modes: Modes, law: Law, state: np.ndarray) -> Spillover:
    """Work in every mode for t_f to infinity, in closed form, of a law on exact modal coordinates.

    The controlled modes lose all their energy: W_r = -E_r(0). A residual mode must be undamped; from rest it gains
    ½|b_rᵀF(iω_r)|², and from another state also Re(conj(q_r'(0) + iω_r q_r(0)) b_rᵀ F(iω_r)).

    Raises:
        DesignError: damping or gyroscopic terms (take a finite time), or a loop that does not settle.
    """
    n, index = modes.n_modes, list(law.controlled)
    residual = [r for r in range(n) if r not in law.controlled]
    if modes.damping.any():
        raise DesignError(
            "with damping the actuators' work is no longer the energy left in a mode: use"
            " workbench.design.spillover.spillover.finite_spillover(close_loop(modes, law), state, final_time)"
        )
    loop, start, feedback, _ = _controlled_loop(modes, law, state)
    if np.linalg.eigvals(loop).real.max() >= 0:
        raise DesignError("the controlled modes do not settle, so their work has no limit; take a finite time")
    work = np.zeros(n)
    work[index] = -_energies(modes, state)[index]
    if residual:
        omega = modes.omega[residual]
        force = input_matrix(modes, law.actuators)[residual]
        drive = np.einsum("rj,jr->r", force, _force_transform(loop, start, feedback, 1j * omega))
        moving = state[[n + r for r in residual]] + 1j * omega * state[residual]
        # z = q' + iω q leaves z(∞) e^{-iωt} = z0 + F(iω)
        work[residual] = 0.5 * np.abs(drive) ** 2 + (np.conj(moving) * drive).real
    return Spillover(work, law.controlled, np.inf)


def _force_transform(loop: Floats, start: Floats, feedback: Floats, s: Complexes) -> Complexes:
    """Laplace transforms (n_actuators, n_s) of the forces of the loop x' = A x from its start, at s (n_s,), rad/s."""
    values, vectors = np.linalg.eig(loop)
    if np.linalg.cond(vectors) < 1e6:
        weights = (feedback @ vectors) * np.linalg.solve(vectors, start.astype(complex))
        return np.asarray(weights @ (1.0 / (s[None, :] - values[:, None])))
    eye = np.eye(loop.shape[0])
    return np.array([feedback @ np.linalg.solve(si * eye - loop, start) for si in s]).T


def _controlled_loop(modes: Modes, law: Law, state: Floats) -> tuple[Floats, Floats, Floats, Flags]:
    """The closed loop of the states that the actuator forces depend on: A, start, feedback, and their mask (n_states,).

    These are the controlled modes, and others where damping couples them, without the displacement of a rigid mode
    that has no gain.
    """
    loop, index = close_loop(modes, law), np.array(law.controlled)
    own = np.asarray(loop.feedback.any(axis=0))
    own[np.r_[index[modes.omega[index] > 0], modes.n_modes + index]] = True
    needed = loop.behind(own)
    return loop.matrix[np.ix_(needed, needed)], loop.start(state)[needed], loop.feedback[:, needed], needed


def check_final_time(final_time: float) -> None:
    """Refuse a final time that is not positive and finite."""
    if not (np.isfinite(final_time) and final_time > 0):
        raise DesignError(f"the final time must be positive and finite; got {final_time:g}")


def finite_spillover(loop: ClosedLoop, state: np.ndarray, final_time: float) -> Spillover:
    """Work of the actuators in every mode up to a finite time, exact, with damping and estimators.

    W_r = ∫ b_rᵀF q_r' dt is the integral of a quadratic form of the state, by one matrix exponential.
    """
    check_final_time(final_time)
    moments = second_moments(loop.matrix, loop.start(state), final_time)
    return Spillover(work_by_mode(loop, moments), loop.law.controlled, final_time)


def work_by_mode(loop: ClosedLoop, moments: Floats) -> Floats:
    """W_r = ∫ b_rᵀF q_r' dt (n_modes,) from the second moments ∫ x xᵀ dt of the state."""
    n = loop.modes.n_modes
    forces = input_matrix(loop.modes, loop.law.actuators) @ loop.feedback
    return np.array([forces[r] @ moments[:, n + r] for r in range(n)])


def on_off_work(modes: Modes, law: OnOffLaw, state: np.ndarray, final_time: float) -> Spillover:
    """Work of the actuators in every mode up to a finite time, ∫ f_r q_r' dt, piece by piece between switchings.

    Raises:
        DesignError: an actuator that `respond_on_off` refuses.
    """
    response, weights = on_off_motion(modes, law, state, final_time)
    power = (input_matrix(modes, law.actuators) @ response.forces) * response.modal[modes.n_modes :]
    return Spillover(power @ weights, law.controlled, final_time)


def on_off_motion(modes: Modes, law: OnOffLaw, state: np.ndarray, final_time: float) -> tuple[Response, Floats]:
    """The motion at quadrature instants (n_times,) up to a final time, and the quadrature weights (n_times,), s."""
    segments = switchings(modes, law, state, final_time)
    events = np.unique(np.r_[0.0, [s.end for mode in segments for s in mode], final_time])
    pieces = np.maximum(1, np.ceil(np.diff(events) * modes.omega.max())).astype(int)
    edges = np.concatenate(
        [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(events[:-1], events[1:], pieces)] + [[final_time]]
    )
    at, weights = gauss_between(edges, GAUSS_POINTS)
    return motion(modes, law, state, at, segments), weights


def effort(modes: Modes, law: Law, state: np.ndarray) -> float:
    """∫ Fᵀ F dt over all time, of a law on exact modal coordinates; inf where the loop does not settle."""
    return _integral(modes, law, state, 0.0, 1.0)


def _integral(modes: Modes, law: Law, state: Floats, energies: float, weight: float | Floats) -> float:
    """∫ (energies Σ (q_r'² + ω_r² q_r²) + Fᵀ R F) dt over all time, Σ over the controlled modes, R `weight`.

    By a Lyapunov equation; inf where the loop does not settle.
    """
    loop, start, feedback, kept = _controlled_loop(modes, law, state)
    poles = np.linalg.eigvals(loop)
    if poles.real.max() >= -ON_AXIS * np.abs(poles).max():
        return np.inf
    index, weighed = np.array(law.controlled), np.zeros(kept.size)
    weighed[index], weighed[modes.n_modes + index] = energies * modes.omega[index] ** 2, energies
    r = feedback.T @ weight @ feedback if np.ndim(weight) else weight * feedback.T @ feedback
    return float(np.trace((np.diag(weighed[kept]) + r) @ settled_moments(loop, start)))


def quadratic_cost(modes: Modes, law: Law, state: np.ndarray, weight: float | np.ndarray) -> float:
    """∫ (Σ q_r'² + ω_r² q_r² + Fᵀ R F) dt of the controlled modes over all time; inf where the loop does not settle.

    Args:
        weight: R, a number or (n_actuators, n_actuators).
    """
    return _integral(modes, law, state, 1.0, weight)


def modal_cost(modes: Modes, law: Law, state: np.ndarray, weight: float) -> float:
    """`quadratic_cost` with modal forces weighted, R fᵀf, f = B F."""
    b = input_matrix(modes, law.actuators)[list(law.controlled)]
    return quadratic_cost(modes, law, state, weight * b.T @ b)


def distributed_cost(modes: Modes, controlled: int | Sequence[int], state: np.ndarray, weight: float) -> float:
    """The lowest `modal_cost` of any law: that of distributed control, f(x, t) = Σ m φ_r f_r (5.5), with W_R = 0.

    Distributed control has a free force in every mode, so its cost is Σ x_rᵀ P_r x_r of the closed-form Riccati
    equations.
    """
    index = list(controlled_indices(modes, controlled))
    p = riccati_matrices(modes.omega[index], weight, np.diag(modes.damping)[index])
    x = np.array([state[index], state[[modes.n_modes + r for r in index]]])
    return float(np.einsum("ir,rij,jr->", x, p, x))


def settled_moments(a: Floats, starts: Floats) -> Floats:
    """∫_0^∞ x xᵀ dt (n, n) for a stable A, summed over the initial states `starts`, (n,) or (n, n_starts)."""
    # balanced: displacements and rates differ by the frequency, and their rounding errors by its square
    a, (scale, _) = matrix_balance(a, permute=False, separate=True)
    starts = starts.reshape(len(a), -1) / scale[:, None]
    moments: Floats = solve_continuous_lyapunov(a, -starts @ starts.T)
    return np.asarray(scale[:, None] * moments * scale)


def second_moments(a: Floats, state: Floats, final_time: float) -> Floats:
    """∫_0^t x xᵀ dt (n, n), from dM/dt = A M + M Aᵀ + x0 x0ᵀ over a short time that is doubled repeatedly."""
    a, (scale, _) = matrix_balance(a, permute=False, separate=True)
    state = state / scale
    halvings = max(0, int(np.ceil(np.log2(max(np.abs(a).sum(axis=1).max() * final_time, 1.0)))))
    _, moments = integrated(a, np.outer(state, state), final_time, halvings)
    return np.asarray(scale[:, None] * moments * scale)


def _energies(modes: Modes, state: Floats) -> Floats:
    n = modes.n_modes
    return 0.5 * (state[n : 2 * n] ** 2 + (modes.omega * state[:n]) ** 2)


def energy_gained(loop: ClosedLoop, state: np.ndarray, final_time: float) -> np.ndarray:
    """Energy gained by each mode (n_modes,) from t = 0 to the final time, from the motion itself."""
    start = loop.start(state)
    end = expm(loop.matrix * final_time) @ start
    return _energies(loop.modes, end) - _energies(loop.modes, start)
