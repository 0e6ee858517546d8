"""The closed loop of all modes, controlled and residual, propagated exactly."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, wraps
from typing import Any, ParamSpec
from warnings import warn

import control
import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm, matrix_balance

from workbench.arrays import Complexes, Flags, Floats
from workbench.design.estimation.controller import Controller, check_readable
from workbench.design.estimation.modal_filter import ModalFilter
from workbench.design.laws.law import DesignError, Law, linear
from workbench.design.loop.peak import largest
from workbench.renamed import Renamed
from workbench.rig.statespace import modal_plant, signal_names
from workbench.structure.domain import Place
from workbench.structure.modes import Modes, freeze, frozen
from workbench.structure.printed import Printed, counted, place_text

UNOBSERVABLE = 1e-9  # response of a modal filter to a mode, below which the mode is unobservable
WELL_CONDITIONED = 1e6  # condition number of eigenvectors up to which the closed form is used
RESONANT = 1e-6  # of the fastest pole: poles nearer to each other have no closed form by partial fractions
EVEN = 1e-15  # of the last instant: instants count as uniform if they deviate by no more
ON_AXIS = 1e-9  # of the fastest pole: rounding of real parts
NULL = 1e-12  # of the largest singular value of the balanced A: one that counts as zero
DRIFTS = "unstable: a rigid-body mode drifts"

P = ParamSpec("P")


def stability(poles: np.ndarray) -> str:
    """Stability by the poles: stable, unstable, or marginally stable where the rightmost is on the imaginary axis."""
    rightmost, tolerance = poles.real.max(), rounding(poles)
    return "stable" if rightmost < -tolerance else "unstable" if rightmost > tolerance else "marginally stable"


def rounding(poles: np.ndarray) -> float:
    """How far rounding may move a pole (of `poles`, rad/s) off the imaginary axis, 1/s."""
    return float(ON_AXIS * max(np.abs(poles).max(), 1.0))


@dataclass(frozen=True, eq=False, repr=False)
class ClosedLoop(Printed):
    """The closed loop x' = A x of all modes under the forces u = -K x̂.

    The state x holds (q, q') of every mode, then lags and delays (see `delay_line`) of actuators and sensors, then an
    observer.

    Attributes:
        modes: controlled and residual.
        law: u = -K x̂.
        matrix: (n_states, n_states) A, rad/s; n_states is 2 n_modes where there are no lags, delays or observer.
        feedback: (n_actuators, n_states) from the state to the actuator forces, sign included.
    """

    modes: Modes
    law: Law
    matrix: np.ndarray
    feedback: np.ndarray

    def __post_init__(self) -> None:
        freeze(self, "matrix", "feedback")

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        further = len(self.matrix) - 2 * self.modes.n_modes
        of = counted(self.modes.n_modes, "mode") + (f" and {counted(further, 'further state')}" if further else "")
        one_of_pair = self.poles[self.poles.imag >= 0]
        rows = [
            (f"{abs(s) / (2.0 * np.pi):.4g}", f"{-100.0 * s.real / abs(s):.4g}" if s else "", f"{s.real:.4g}")
            for s in sorted(one_of_pair, key=abs)
        ]
        line = f"closed loop of {of}: {self.stability_text}"
        return line, ("frequency [Hz]", "damping ratio [%]", "Re λ [1/s]"), rows, ()

    @cached_property
    def poles(self) -> np.ndarray:
        """Closed-loop poles (n_states,), rad/s."""
        return frozen(np.linalg.eigvals(self.matrix), complex)

    @property
    def decay_rate(self) -> float:
        """Decay rate of the slowest pole (degree of stability), -max Re λ, 1/s; negative where the loop is unstable."""
        return float(-self.poles.real.max())

    margin = Renamed("decay_rate")

    @property
    def unstable_poles(self) -> np.ndarray:
        """Poles to the right of the imaginary axis beyond rounding, rad/s; those of undamped modes lie on it."""
        return self.poles[self.poles.real > rounding(self.poles)]

    @property
    def stability(self) -> str:
        """Stable, marginally stable or unstable, as of `stability`, and unstable where a rigid-body mode drifts.

        A rigid-body mode without control and damping is a double pole at zero with one eigenvector: its displacement
        grows as t, so it is not marginally stable, which takes as many eigenvectors as poles.
        """
        by_poles = stability(self.poles)
        return DRIFTS if by_poles != "unstable" and self._drifts() else by_poles

    @property
    def stability_text(self) -> str:
        """Stability, with the decay or growth rate."""
        rate = self.decay_rate
        texts = {"stable": f", decay rate {rate:.3g} 1/s", "unstable": f", growth rate {-rate:.3g} 1/s"}
        return self.stability + texts.get(self.stability, "")

    @property
    def stable(self) -> bool:
        """Whether the loop is asymptotically stable; for undamped modes see `unstable_poles` and `stability`."""
        return self.stability == "stable"

    def _drifts(self) -> bool:
        """Whether zero is a defective pole: with left and right null vectors W and V of A, WᵀV is singular."""
        if self.modes.omega.all():
            return False
        balanced, _ = matrix_balance(self.matrix, permute=False, separate=True)
        left, strength, right = np.linalg.svd(balanced)
        still = strength <= NULL * strength[0]
        if not still.any():
            return False
        return bool(np.linalg.svd(left[:, still].T @ right[still].T, compute_uv=False)[-1] <= ON_AXIS)

    def state_space(self) -> control.StateSpace:
        """The loop as python-control's `StateSpace`, from modal forces to (q, q') and the actuator forces."""
        n, size = self.modes.n_modes, len(self.matrix)
        modal = [f"{what}{r + 1}" for what in ("q", "dq") for r in range(n)]
        return control.ss(
            self.matrix,
            np.eye(size, n, k=-n),
            np.vstack([np.eye(2 * n, size), self.feedback]),
            np.zeros((2 * n + len(self.feedback), n)),
            inputs=[f"f{r + 1}" for r in range(n)],
            outputs=modal + signal_names(actuator.name for actuator in self.law.actuators),
        )

    def start(self, state: ArrayLike) -> Floats:
        """The state (n_states,) at t = 0 from that of the modes, (2 n_modes,), or more; the others start from zero."""
        return np.concatenate([state, np.zeros(len(self.matrix) - np.size(state))])

    def behind(self, states: Flags) -> Flags:
        """Which states (n_states,) drive the given ones, directly or through others; the given ones are included.

        Off-diagonal terms of proportional damping are rounding and count as zero.
        """
        n, links = self.modes.n_modes, self.matrix != 0
        if self.modes.proportional:
            not_fed_back = n + np.flatnonzero(~self.feedback[:, n : 2 * n].any(axis=0))
            links[n : 2 * n, not_fed_back] &= np.eye(n, dtype=bool)[:, not_fed_back - n]
        reached, new = states.copy(), states
        while new.any():
            new = links[new].any(axis=0) & ~reached
            reached = reached | new
        return reached


@dataclass(frozen=True, eq=False, repr=False)
class Response(Printed):
    """Modal motion and actuator forces over time.

    Attributes:
        time: (n_times,) s.
        modal: (2 n_modes, n_times) states (q, q').
        forces: (n_actuators, n_times).
        modes: give the shapes.
    """

    time: Floats
    modal: Floats
    forces: Floats
    modes: Modes

    def __post_init__(self) -> None:
        freeze(self, "time", "modal", "forces")

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        line = f"response of {counted(self.modes.n_modes, 'mode')} with {counted(len(self.forces), 'actuator')}"
        if not self.time.size:
            return f"{line}, no instants", (), (), ()
        line += f" over {self.time[-1] - self.time[0]:.4g} s, {counted(self.time.size, 'instant')}"
        rows = [
            (str(r + 1), f"{hz:.4g}", *(f"{value:.4g}" for value in (energy[0], energy.max(), energy[-1])))
            for r, (hz, energy) in enumerate(zip(self.modes.frequencies_hz, self.energy, strict=True))
        ]
        largest_forces = ", ".join(f"{peak:.4g}" for peak in np.abs(self.forces).max(axis=1))
        remarks = (f"largest command of each actuator: {largest_forces}",) if len(self.forces) else ()
        headings = ("mode", "frequency [Hz]", "energy at the start [J]", "largest [J]", "at the end [J]")
        return line, headings, rows, remarks

    def displacement(self, x: ArrayLike) -> Floats:
        """w(x, t): (n_points, n_times)."""
        return self.modes.phi(x) @ self.modal[: self.modes.n_modes]

    @property
    def energy(self) -> Floats:
        """Energy of each mode, (n_modes, n_times): ½ (q'² + ω² q²)."""
        n = self.modes.n_modes
        return 0.5 * (self.modal[n:] ** 2 + (self.modes.omega[:, None] * self.modal[:n]) ** 2)


def close_loop(modes: Modes, law: Law | Controller, filter_: ModalFilter | None = None) -> ClosedLoop:
    """The closed loop of a law on exact modal coordinates, through a modal filter, or of a controller.

    Args:
        modes: all modes, controlled and residual.
        law: u = -K x, or a controller, a law with its filter or observer.
        filter_: rows are the controlled modes, in the law's order; velocities use the same weights.

    Raises:
        DesignError: an on-off law, or a law of modes that the plant does not have.
        ValueError: a filter of another number of modes, or one whose sensors do not observe a controlled mode.
    """
    if isinstance(law, Controller) and filter_ is None:
        return close_with(modes, law)
    law = linear(law)
    n = modes.n_modes
    if max(law.controlled) >= n:
        raise DesignError(
            f"the law controls mode {max(law.controlled) + 1} and the plant has {counted(n, 'mode')}; give more modes"
        )
    if filter_ is None:
        output = np.zeros((law.n_controlled, n))
        output[np.arange(law.n_controlled), list(law.controlled)] = 1.0
    else:
        output = filter_.response_to(modes)
        if output.shape[0] != law.n_controlled:
            raise ValueError(f"the filter gives {output.shape[0]} modes; the law controls {law.n_controlled}")
        strength = np.abs(output[np.arange(law.n_controlled), list(law.controlled)])
        if strength.min() < UNOBSERVABLE:
            raise ValueError(
                f"mode {law.controlled[strength.argmin()] + 1} is unobservable: the filter's sensors at"
                f" {'; '.join(map(place_text, filter_.places))} are all at its nodes; move or add a sensor"
            )
    estimate = np.kron(np.eye(2), output)
    feedback = -law.gain @ estimate
    a, b, c, d, _ = modal_plant(modes, law.actuators, ())
    commands = np.hstack([feedback, np.zeros((len(feedback), len(a) - 2 * n))])
    return ClosedLoop(modes, law, a + b @ commands, c + d @ commands)


def close_with(modes: Modes, controller: Controller | Law) -> ClosedLoop:
    """The closed loop of all modes under a controller; a law alone acts on exact modal coordinates."""
    if isinstance(controller, Law):
        return close_loop(modes, controller)
    check_readable(controller.sensors)
    a, b, c, d, _ = modal_plant(modes, controller.law.actuators, controller.sensors)
    count = len(controller.sensors)
    reads, forces, feedthrough = c[:count], c[count:], d[count:]
    commands = np.hstack([controller.D @ reads, controller.C])
    plant = np.block([[a, np.zeros((len(a), len(controller.A)))], [controller.B @ reads, controller.A]])
    matrix = plant + np.vstack([b @ commands, np.zeros((len(controller.A), len(plant)))])
    forces = np.hstack([forces, np.zeros((len(forces), len(controller.A)))])
    return ClosedLoop(modes, controller.law, matrix, forces + feedthrough @ commands)


def impulse_state(modes: Modes, at: Place, impulse: float = 1.0) -> Floats:
    """State (2n,) just after an impulse (N s) at a place: q_r' = impulse φ_r(x) (5.58)."""
    return np.concatenate([np.zeros(modes.n_modes), impulse * modes.phi(at)[0]])


def _in_former_order(function: Callable[P, Response]) -> Callable[P, Response]:
    """`initial_response` that takes the former order and names too, (loop, state, time), with a warning."""

    def former(loop: ClosedLoop, state: Any, time: Any) -> tuple[ClosedLoop, Any, Any]:
        return loop, time, state

    def fits(loop: ClosedLoop, times: Any, state: Any) -> bool:
        """Whether these may be instants and a state."""
        rise = np.ndim(times) == 1 and np.size(times) and np.min(times) >= 0 and (np.diff(times) > 0).all()
        return bool(rise and np.shape(state) in ((2 * loop.modes.n_modes,), loop.matrix.shape[:1]))

    @wraps(function)
    def with_former(*args: Any, **kwargs: Any) -> Response:
        by_order = len(args) == 3 and not kwargs and fits(*former(*args))
        if by_order and fits(*args):
            raise ValueError(
                "either argument may be the instants and either the state, and their order has changed; name them:"
                " initial_response(loop, timepts=..., initial_state=...)"
            )
        if by_order or kwargs.keys() & {"state", "time"}:
            now = "initial_response(loop, state, time) is now initial_response(loop, timepts, initial_state)"
            warn(f"{now}; the old order goes with the next version", DeprecationWarning, 2)
            args, kwargs = former(*args, **kwargs), {}
        return function(*args, **kwargs)

    return with_former


@_in_former_order
def initial_response(
    loop: ClosedLoop, timepts: Sequence[float] | np.ndarray, initial_state: Sequence[float] | np.ndarray
) -> Response:
    """Free response from a state at t = 0, exact at every instant: x(t) = e^{At} x0.

    With exact modal coordinates it has a closed form; otherwise uniform instants share one matrix exponential, and
    others need one each. The arguments are those of python-control's `initial_response`.

    Args:
        loop: from `close_loop` or `explain_spillover`.
        timepts: (n_times,) instants, s.
        initial_state: x0, (2 n_modes,) of the modes alone, an observer starting from zero, or (n_states,).

    Raises:
        ValueError: times that do not increase from zero or later, a state of another size or not finite.
    """
    time = checked_times(timepts)
    sizes = (2 * loop.modes.n_modes, loop.matrix.shape[0])
    if np.shape(initial_state) not in ((sizes[0],), (sizes[1],)) or not np.isfinite(initial_state).all():
        more = f", or ({sizes[1]},) with the controller" if sizes[1] > sizes[0] else ""
        raise ValueError(f"the state must be finite, ({sizes[0]},) of the modes{more}; got {np.shape(initial_state)}")
    state = loop.start(initial_state)
    modal = _cascade(loop, state, time)
    if modal is None:
        modal = _stepped(loop.matrix, state, time)
    modal.flags.writeable = False  # so that `Response` does not copy a large array
    motion = modal if len(modal) == sizes[0] else modal[: sizes[0]]
    fed_back = np.flatnonzero(loop.feedback.any(axis=0))
    return Response(time, motion, loop.feedback[:, fed_back] @ modal[fed_back], loop.modes)


def peak_force(loop: ClosedLoop, state: np.ndarray, final_time: float) -> float:
    """The largest |F| of any actuator in continuous time up to a final time, to a relative error of a millionth.

    Args:
        loop: every pole that the forces depend on decays.
        state: as for `initial_response`.
        final_time: s; may be infinite.
    """
    # states that the forces do not depend on are left out: poles of residual modes need not decay
    own = np.flatnonzero(loop.behind(np.asarray(loop.feedback.any(axis=0))))
    if not own.size:
        return 0.0
    state = loop.start(state)
    poles, vectors = np.linalg.eig(loop.matrix[np.ix_(own, own)])
    amplitudes = (loop.feedback[:, own] @ vectors) * np.linalg.solve(vectors, state[own].astype(complex))
    return largest(poles, amplitudes, final_time)


def checked_times(time: ArrayLike) -> Floats:
    """Instants (n_times,) as an array, checked to increase from zero or later."""
    times = np.asarray(time, float)
    if times.ndim != 1 or times.size == 0 or (np.diff(times) <= 0).any() or times[0] < 0:
        raise ValueError("times must increase, from zero or later")
    return times


def _stepped(matrix: np.ndarray, state: np.ndarray, time: np.ndarray) -> np.ndarray:
    """e^{At} x0 (n_states, n_times), step by step; for uniform instants by doubling, x_{k+m} = (e^{Ah})^m x_k."""
    modal = np.empty((state.size, time.size))
    modal[:, 0] = expm(matrix * time[0]) @ state
    steps = np.diff(time)
    if steps.size and np.ptp(steps) <= 1e-12 * time[-1]:
        step, known = expm(matrix * steps[0]), 1
        while known < time.size:
            more = min(known, time.size - known)
            modal[:, known : known + more] = step @ modal[:, :more]
            known += more
            if known < time.size:
                step = step @ step
        return modal
    for k in range(1, time.size):
        modal[:, k] = expm(matrix * steps[k - 1]) @ modal[:, k - 1]
    return modal


def _cascade(loop: ClosedLoop, state: np.ndarray, time: np.ndarray) -> np.ndarray | None:
    """e^{At} x0 (2 n_modes, n_times) in closed form where only controlled modes are fed back; None elsewhere.

    With exact modal coordinates and proportional damping the controlled modes drive each residual mode by itself. With
    z = q' - p* q of a residual mode, z' = p z + g, and g = Σ_k g_k e^{λ_k t} of the controlled loop,
    z = e^{pt} z0 + Σ_k g_k (e^{λ_k t} - e^{pt}) / (λ_k - p).
    """
    modes, n = loop.modes, loop.modes.n_modes
    own = [*loop.law.controlled, *(n + r for r in loop.law.controlled)]
    rest = np.setdiff1d(np.arange(n), loop.law.controlled)
    c = np.diag(modes.damping)
    exact = len(loop.matrix) == 2 * n and not loop.feedback[:, np.r_[rest, n + rest]].any()
    if not (exact and modes.proportional and (modes.omega[rest] > 0.5 * c[rest]).all()):
        return None
    values, vectors = np.linalg.eig(loop.matrix[np.ix_(own, own)])
    if not np.linalg.cond(vectors) < WELL_CONDITIONED:
        return None
    terms = vectors * np.linalg.solve(vectors, state[own].astype(complex))
    outer, inner = _split(time)
    left, right = np.exp(np.outer(outer, values)), np.exp(np.outer(values, inner))
    modal = np.empty((2 * n, time.size))
    for row, amplitudes in zip(own, terms):
        modal[row] = _sum_of_exponentials(amplitudes, left, right)[: time.size]
    if not rest.size:
        return modal
    sigma, damped = 0.5 * c[rest], np.sqrt(modes.omega[rest] ** 2 - 0.25 * c[rest] ** 2)
    pole = -sigma + 1j * damped
    difference = values - pole[:, None]
    if np.abs(difference).min() < RESONANT * np.abs(pole).max():
        return None
    driven = loop.matrix[np.ix_(n + rest, np.asarray(own))] @ terms / difference
    free = state[n + rest] + (sigma + 1j * damped) * state[rest] - driven.sum(axis=1)
    # q = Im z / ω_d and q' = Im(p z) / ω_d
    z = -1j * np.column_stack([driven, free]) / damped[:, None]
    for r, p, amplitudes in zip(rest, pole, z):
        factors = np.column_stack([left, np.exp(p * outer)]), np.vstack([right, np.exp(p * inner)])
        modal[r] = _sum_of_exponentials(amplitudes, *factors)[: time.size]
        modal[n + r] = _sum_of_exponentials(p * amplitudes, *factors)[: time.size]
    return modal


def _split(time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Instants (n_outer,) and (n_inner,) whose sums, row by row, begin with `time`.

    Uniform instants are split into about √n_times of each, so that few exponentials are needed.
    """
    n = time.size
    step = (time[-1] - time[0]) / max(n - 1, 1)
    if np.abs(time - time[0] - step * np.arange(n)).max() > EVEN * time[-1]:
        return time, np.zeros(1)
    width = int(np.ceil(np.sqrt(n)))
    return time[0] + step * width * np.arange(-(-n // width)), step * np.arange(width)


def _sum_of_exponentials(amplitudes: Complexes, left: Complexes, right: Complexes) -> Floats:
    """Re Σ_k a_k e^{λ_k (t_a + t_b)} at all instants, from factors (n_outer, n_poles) and (n_poles, n_inner)."""
    scaled = left * amplitudes
    return (np.hstack([scaled.real, -scaled.imag]) @ np.vstack([right.real, right.imag])).ravel()
