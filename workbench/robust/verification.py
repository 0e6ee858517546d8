"""Monte Carlo verification of a controller on draws of the uncertain rig, with its small-gain margin."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from workbench.arguments import whole
from workbench.design.estimation.digital import DigitalController
from workbench.design.loop.rig_loop import LoopRun, LoopTest, of_loops, run_loop
from workbench.renamed import Renamed, former_arguments
from workbench.rig.actuators import Actuator
from workbench.rig.elements import PeriodicForce, RandomForce
from workbench.rig.rig import Rig, shape_of
from workbench.rig.sensors import Sensor
from workbench.robust.posterior import WHAT_DRAWS, UncertainRig
from workbench.robust.small_motion import loop_poles, modes_in_motion, small_gain_margin
from workbench.structure.domain import NamedPoints, middle
from workbench.structure.modes import Modes, freeze
from workbench.structure.printed import all_rounded, rounded
from workbench.threads import one_blas_thread

SETTLED = 0.01  # of the largest energy: a tenth of the amplitude
GROWN = 2.0  # ratio of the largest energies in the last and in the first quarter above which the motion grows
LEVEL = 0.95  # probability of an interval
QUANTILES = (0.5, 0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL)


@dataclass(frozen=True, eq=False)
class Verification:
    """The performance of a controller on draws of an uncertain rig.

    Attributes:
        stable: (n_draws,) whether the linearised loop is stable and the motion under test does not grow; with forces
            in the test, whether the motion decays after it.
        damping: (n_draws, n_modes) closed-loop damping ratio of each mode, linearised about the motion under test.
        peak_force, stroke: (n_draws,) the largest force of any actuator, N, and displacement at any actuator, m.
        work: (n_draws, n_modes) W_r; controlled: zero-based modes among them.
        effort: (n_draws,) ∫ FᵀF dt.
        vibration: (n_draws,) ∫ of the energy of all modes over time.
        settling: (n_draws,) s until the energy stays below a hundredth of its peak; inf where it does not within the
            test.
        controlled_settling: the same of the energy of the controlled modes; of all where none is named.
        energy: (3, n_samples) of all modes: median over the draws, and lower and upper end of the 95 % interval.
        small_gain_margin: relative error of all outputs at once, of any phase, that cannot destabilise the loop; 0
            where the loop is unstable, inf without feedback, nan for on-off control.
        margin_frequency_hz: frequency of its minimum.
    """

    stable: np.ndarray
    damping: np.ndarray
    peak_force: np.ndarray
    stroke: np.ndarray
    work: np.ndarray
    controlled: tuple[int, ...]
    effort: np.ndarray
    vibration: np.ndarray
    settling: np.ndarray
    controlled_settling: np.ndarray
    energy: np.ndarray
    small_gain_margin: float
    margin_frequency_hz: float

    margin = Renamed("small_gain_margin")

    def __post_init__(self) -> None:
        freeze(self, "stable", dtype=bool)
        freeze(self, "damping", "peak_force", "stroke", "work", "effort")
        freeze(self, "vibration", "settling", "controlled_settling", "energy")

    @property
    def n_draws(self) -> int:
        return int(self.stable.size)

    @property
    def n_stable(self) -> int:
        return int(self.stable.sum())

    @property
    def share_stable(self) -> float:
        return float(self.stable.mean())

    @property
    def worst_damping(self) -> np.ndarray:
        """(n_draws,) the minimum damping ratio of all modes."""
        return np.asarray(self.damping.min(axis=1))

    @property
    def all_work(self) -> np.ndarray:
        """W (n_draws,) = Σ_r |W_r|."""
        return np.asarray(np.abs(self.work).sum(axis=1))

    @property
    def controlled_work(self) -> np.ndarray:
        """W_C of each draw (n_draws,)."""
        return np.asarray(self.work[:, list(self.controlled)].sum(axis=1))

    @property
    def residual_work(self) -> np.ndarray:
        """W_R of each draw (n_draws,)."""
        return np.asarray(self.work.sum(axis=1) - self.controlled_work)

    def to_json(self) -> dict[str, Any]:
        """Median and 95 % interval of each quantity, as JSON numbers; null where not finite."""

        def of(*names: str) -> dict[str, Any]:
            return {name: all_rounded(interval(getattr(self, name))) for name in names}

        return {
            "draws": self.n_draws,
            "stable": self.n_stable,
            "small_gain_margin": rounded(self.small_gain_margin),
            "margin_frequency_hz": rounded(self.margin_frequency_hz),
            "damping": [all_rounded(interval(self.damping[:, r])) for r in self.controlled],
            **of("worst_damping", "peak_force", "stroke"),
            "W_C": all_rounded(interval(self.controlled_work)),
            "W_R": all_rounded(interval(self.residual_work)),
            **of("effort", "vibration", "settling", "controlled_settling"),
        }


def interval(values: np.ndarray | Sequence[np.ndarray]) -> np.ndarray:
    """Median, and lower and upper end of the 95 % interval, over the draws (n_draws, ...): shape (3, ...).

    They are order statistics, since values may be infinite.
    """
    return np.asarray(np.quantile(values, QUANTILES, axis=0, method="nearest"))


@former_arguments(possible="rig", centre="margin_rig")
@one_blas_thread
def verify(
    rig: UncertainRig | Sequence[Rig],
    controller: DigitalController,
    test: LoopTest,
    *,
    controlled: Sequence[int] = (),
    draws: int = 200,
    seed: int = 0,
    margin_rig: Rig | None = None,
) -> Verification:
    """The performance of a controller on draws of an uncertain rig under a test, with all nonlinear elements.

    The unexplained share of a diagnosis is drawn too, as an error of each sensor's gain within ± that share.

    Args:
        rig: rig with its uncertainty, or rigs drawn from it.
        controller: of the test's sample time.
        test: the excitation, with independent noise in each draw where it has a seed.
        controlled: zero-based modes whose work is W_C.
        draws: number of rigs to draw from an uncertain rig.
        seed: of the draws.
        margin_rig: the rig for the small-gain margin; by default the central estimate, or the first of given rigs.

    Raises:
        TypeError: no uncertain rig, no sampled controller, no test, or an argument that is no number.
        ValueError: a controller or a test that does not fit the rig, draws that are no whole number above zero, or a
            controlled mode that the rigs do not have.
    """
    _check_kinds(rig, controller, test, margin_rig)
    draws, seed = whole(draws, WHAT_DRAWS, least=1), whole(seed, "seed")
    if isinstance(rig, UncertainRig):
        rigs: Sequence[Rig] = drawn_with_errors(rig, draws, seed)
        margin_rig = margin_rig or rig.rig
    else:
        rigs, margin_rig = rig, margin_rig or rig[0]
    index = _indices(controlled)
    n_modes = min(rig.modes.n_modes for rig in rigs)
    unknown = [r for r in index if not 0 <= r < n_modes]
    if unknown:
        raise ValueError(f"controlled are modes 0 to {n_modes - 1} of the rigs, counted from zero; got {unknown[0]}")

    def drawn(rig: Rig, one: LoopTest, run: LoopRun) -> tuple[Any, ...]:
        poles, energy = loop_poles(rig, controller, modes_in_motion(rig, run)), run.response.energy
        with np.errstate(over="ignore", invalid="ignore"):
            total = energy.sum(axis=0)
            of_controlled = energy[index].sum(axis=0) if index else total
            bounded = poles.spectral_radius <= 1.0 + 1e-9 and _stays_bounded(rig, controller, one, run)
            peak_force, stroke = np.abs(run.response.forces).max(), _stroke(rig, controller, run)
            damping, work = poles.damping[:n_modes], run.work[:n_modes]
            return bounded, damping, peak_force, stroke, work, run.effort, total, of_controlled

    results = zip(*of_loops(rigs, controller, test, drawn))
    stable, damping, peak_force, stroke, work, effort, energies, of_controlled = results
    modes = modes_in_motion(margin_rig, run_loop(margin_rig, controller, test))
    margin, frequency = small_gain_margin(margin_rig, controller, modes)
    dt = test.sample_time
    with np.errstate(over="ignore", invalid="ignore"):
        return Verification(
            stable=np.array(stable),
            damping=np.array(damping),
            peak_force=_finite(peak_force),
            stroke=_finite(stroke),
            work=_finite(work),
            controlled=tuple(index),
            effort=_finite(effort),
            vibration=_finite([energy.sum() * dt for energy in energies]),
            settling=_settlings(energies, stable, dt),
            controlled_settling=_settlings(of_controlled, stable, dt),
            energy=interval(energies),
            small_gain_margin=margin,
            margin_frequency_hz=frequency,
        )


def _indices(controlled: Sequence[int]) -> list[int]:
    """Zero-based modes as a list of whole numbers."""
    if isinstance(controlled, str) or not isinstance(controlled, Sequence | np.ndarray):
        raise TypeError(f"controlled is a sequence of modes, counted from zero, such as (0, 1); got {controlled!r}")
    return [whole(r, "each of controlled, a mode counted from zero,") for r in controlled]


def _check_kinds(uncertain: object, controller: object, test: object, margin_rig: object) -> None:
    """Refuse arguments of `verify` of the wrong type."""
    drawn = isinstance(uncertain, Sequence) and len(uncertain) > 0 and all(isinstance(rig, Rig) for rig in uncertain)
    if not (isinstance(uncertain, UncertainRig) or drawn):
        raise TypeError(
            f"a controller is verified on an UncertainRig, or on rigs drawn from it; got {type(uncertain).__name__}:"
            " make one from a diagnosis by UncertainRig.of(verdict)"
        )
    check_loop_kinds(controller, test)
    if not isinstance(margin_rig, Rig | None):
        raise TypeError(f"margin_rig must be a Rig, for the small-gain margin; got {type(margin_rig).__name__}")


def check_loop_kinds(controller: object, test: object) -> None:
    """Refuse a controller that is not a `DigitalController`, or a test that is not a `LoopTest`."""
    if not isinstance(controller, DigitalController):
        raise TypeError(
            f"the controller must be a DigitalController; got {type(controller).__name__}: make one of a law and an"
            " estimator by sampled(kalman_controller(...), sample_time)"
        )
    check_test(test)


def check_test(test: object) -> None:
    """Refuse a test that is not a `LoopTest`."""
    if not isinstance(test, LoopTest):
        raise TypeError(
            f"the test must be a LoopTest; got {type(test).__name__}: make one by LoopTest(n_samples, sample_time,"
            " impulse_at=...), from workbench.design.loop.rig_loop"
        )


def drawn_with_errors(uncertain: UncertainRig, draws: int, seed: int = 0) -> tuple[Rig, ...]:
    """Samples of an uncertain rig, with an error of each sensor's gain, uniform within ± the unexplained share."""
    rng = np.random.default_rng(seed)
    rigs = uncertain.draws(draws, rng)
    if not uncertain.unexplained:
        return rigs

    def erring(sensor: Sensor) -> Sensor:
        return replace(sensor, gain=sensor.gain * (1.0 + uncertain.unexplained * rng.uniform(-1.0, 1.0)))

    return tuple(replace(rig, sensors=tuple(map(erring, rig.sensors))) for rig in rigs)


def _finite(values: ArrayLike) -> np.ndarray:
    values = np.asarray(values, float)
    return np.where(np.isfinite(values), values, np.inf)


def _stays_bounded(rig: Rig, controller: DigitalController, test: LoopTest, run: LoopRun) -> bool:
    """Whether the free motion does not grow: under test, or after a test with forces.

    Forces may make the motion of a stable loop grow. A test with forces is therefore continued without them for as long
    again, in which the motion must decay.
    """
    forced = test.forces is not None or any(isinstance(e, PeriodicForce | RandomForce) for e in rig.elements)
    if not (run.bounded and forced):
        return run.bounded and not _grows(run.response.energy.sum(axis=0))
    after = run_loop(rig, controller, test, free=test.n_samples)
    return after.bounded and not _grows(after.response.energy.sum(axis=0)[test.n_samples :])


def _grows(energy: np.ndarray) -> bool:
    quarter = max(energy.size // 4, 1)
    return bool(energy[-quarter:].max() > GROWN * energy[:quarter].max())


def _settlings(energies: Sequence[np.ndarray], stable: Sequence[bool], sample_time: float) -> np.ndarray:
    return np.array([settling(e, sample_time) if s else np.inf for e, s in zip(energies, stable, strict=True)])


def settling(energy: np.ndarray, sample_time: float) -> float:
    """Time until an energy (n_samples,) stays below a hundredth of its peak, s; infinite where it does not."""
    above = np.flatnonzero(energy > SETTLED * energy.max())
    last = above[-1] if above.size else -1  # none above: no motion
    return np.inf if last == energy.size - 1 else float(sample_time * (last + 1))


def displacement_at(modes: Modes, actuator: Actuator) -> np.ndarray:
    """Displacement (n_modes,) of each mode at an actuator: at the middle of a patch; at named points its own motion."""
    if actuator.quantity == "force" or isinstance(modes.domain, NamedPoints):
        return shape_of(modes, actuator)
    return np.asarray(modes.phi(middle(actuator.at))[0])


def _stroke(rig: Rig, controller: DigitalController, run: LoopRun) -> float:
    driven = [a for a in rig.actuators if a.name in controller.actuators]
    shapes = np.array([displacement_at(rig.modes, a) for a in driven])
    return float(np.abs(shapes @ run.response.modal[: rig.modes.n_modes]).max())
