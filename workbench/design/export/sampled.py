"""A design at a sampling rate: its decay rate, phase lag and delay margin."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from workbench.arguments import number
from workbench.design.estimation.controller import Controller
from workbench.design.estimation.digital import DigitalController, sampled
from workbench.design.export.sampled_loop import MOST_PAST, sampled_loop
from workbench.design.export.source import command_words, reading_words
from workbench.design.laws.law import DesignError, Law, numbered
from workbench.design.laws.on_off import OnOffLaw
from workbench.design.loop.closed_loop import close_with, stability
from workbench.records.units import SI, Units
from workbench.renamed import Renamed
from workbench.structure.modes import Modes, freeze
from workbench.structure.printed import Printed

ON_CIRCLE = 1e-9  # a pole no further outside the unit circle counts as on it
COMFORTABLE = 10.0  # samples per period of the highest controlled mode, recommended where the rate is too slow
FASTEST = 1024.0  # times the given rate: up to there a rate with a stable loop is looked for
MOST_LATE, TRIES = 40, 160  # further delay that is tried for the delay margin, samples, and the number of steps


@dataclass(frozen=True, eq=False, repr=False)
class SampledDesign(Printed):
    """A discretised controller with the loop of all modes that it closes.

    Attributes:
        modes: controlled and residual.
        source: the controller in continuous time.
        controller: the discretised controller, each reading held until the next.
        computing_delay: from a reading to the first effect of its command, s.
        poles: (n_states,) of the sampled loop of all modes, in the z-plane.
        delay_margin: least further delay that destabilises, s; infinite where 40 samples do not.
        units: of readings, commands and states.
    """

    modes: Modes
    source: Controller
    controller: DigitalController
    computing_delay: float
    poles: np.ndarray
    delay_margin: float
    units: Units = SI

    def __post_init__(self) -> None:
        freeze(self, "poles", dtype=complex)

    @property
    def sample_rate_hz(self) -> float:
        return 1.0 / self.controller.sample_time

    @property
    def decay_rate(self) -> float:
        """Decay rate of the slowest pole of the sampled loop, -ln|z| / T, 1/s; negative where it is unstable."""
        return float(-np.log(np.abs(self.poles).max()) / self.controller.sample_time)

    @property
    def phase_lag(self) -> np.ndarray:
        """Phase lag (n_controlled,) of hold and computing delay at each controlled mode, ω (T/2 + τ), rad."""
        own = self.modes.omega[list(self.source.law.controlled)]
        return np.asarray(own * (0.5 * self.controller.sample_time + self.computing_delay))

    phase_lost, margin = Renamed("phase_lag"), Renamed("decay_rate")

    @property
    def states(self) -> tuple[str, ...]:
        """What each state of the controller is, in order."""
        return tuple(map(self.units.named, self.controller.states))

    @property
    def readings(self) -> tuple[str, ...]:
        """What each reading is, in order."""
        return reading_words(self.modes.domain, self.source.sensors, self.units)

    @property
    def commands(self) -> tuple[str, ...]:
        """What each command is, in order."""
        return command_words(self.modes.domain, self.source.law.actuators, self.units)

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        hz = self.units.named("Hz")
        late = f", computation delay {self._duration(self.computing_delay)}" if self.computing_delay else ""
        line = f"{self.controller.name} at {self.sample_rate_hz:.6g} {hz}{late}"
        own = self.source.law.controlled
        rows = [
            (str(r + 1), f"{f:.5g}", f"{self.sample_rate_hz / f:.3g}" if f else "", f"{np.degrees(lag):.3g}")
            for r, f, lag in zip(own, self.modes.frequencies_hz[list(own)], self.phase_lag)
        ]
        return line, ("mode", f"frequency [{hz}]", "samples per period", "phase lag [°]"), rows, self.remarks

    def _duration(self, time: float) -> str:
        return f"{1e3 * time:.3g} ms" if self.units == SI else f"{time:.3g} {self.units.time}"

    @property
    def remarks(self) -> tuple[str, ...]:
        """Stability before and after sampling, rigid modes that are not held, and modes that are aliased."""
        before = close_with(self.modes, self.source)
        delay = f"delay margin {self._duration(self.delay_margin)}"
        if not np.isfinite(self.delay_margin):
            delay = f"delay margin beyond {MOST_LATE} samples"
        # a decay rate within rounding is stated as zero
        own = 0.0 if abs(self.decay_rate) * self.controller.sample_time < ON_CIRCLE else self.decay_rate
        continuous = 0.0 if stability(before.poles) == "marginally stable" else before.decay_rate
        per_time, hz = self.units.named("1/s"), self.units.named("Hz")
        remarks = [f"decay rate {own:.3g} {per_time}, {continuous:.3g} {per_time} in continuous time; {delay}"]
        rate, law = self.sample_rate_hz, self.source.law
        free = [r for i, r in enumerate(law.controlled) if self.modes.omega[r] == 0 and not law.gain[:, i].any()]
        if free:
            remarks.append(
                f"no gain acts on the displacement of the rigid mode(s) {numbered(free)}; assign poles to hold it"
            )
        folded = [(r, f) for r, f in enumerate(self.modes.frequencies_hz) if f > 0.5 * rate and r not in law.controlled]
        if folded:
            r, f = folded[0]
            more = f", and {len(folded) - 1} more above it" if len(folded) > 1 else ""
            remarks.append(
                f"mode {r + 1} at {f:.4g} {hz}{more}: above the Nyquist frequency, aliased to"
                f" {abs(f - rate * round(f / rate)):.4g} {hz}; add an anti-aliasing filter, or sample faster"
            )
        return tuple(remarks)


def sample_design(
    modes: Modes, controller: Controller | Law | OnOffLaw, *, sample_rate_hz: float, computing_delay: float = 0.0
) -> SampledDesign:
    """The controller discretised at a sampling rate, with the loop of all modes that it closes.

    Args:
        modes: controlled and residual.
        controller: a law through a modal filter, or on an observer.
        sample_rate_hz: Hz.
        computing_delay: τ from a reading to the first effect of its command, beside the actuators' own delays, s.

    Raises:
        TypeError: no modes, no controller, or a rate or a delay that is no number.
        DesignError: a law that reads no sensors, a loop that is unstable in continuous time, a rate too slow for the
            modes, or a delay with which no rate is stable.
    """
    if not isinstance(modes, Modes):
        raise TypeError(
            f"modes must be Modes; got {type(modes).__name__}: give structure.modes(n), or the modes of a rig"
        )
    if isinstance(controller, OnOffLaw):
        raise DesignError(
            f"{controller.name} switches, and sample_design needs a linear controller; redesign(possible, law) puts it"
            " on a Kalman filter, and export of its result writes it"
        )
    if isinstance(controller, Law):
        raise DesignError(
            f"{controller.name} acts on modal coordinates, which no sensor reads; put it on an observer"
            " (luenberger_controller, kalman_controller) or through a modal filter first"
        )
    number(computing_delay, "computing_delay", "s")
    if not (np.isfinite(number(sample_rate_hz, "sample_rate_hz", "Hz")) and sample_rate_hz > 0):
        raise DesignError(f"the sampling rate must be positive; got {sample_rate_hz:g} Hz")
    digital = sampled(controller, 1.0 / sample_rate_hz)
    before = close_with(modes, controller)
    if before.unstable_poles.size:
        raise DesignError(
            f"{controller.name}: the loop of all {modes.n_modes} modes is unstable in continuous time, a pole at"
            f" {-before.decay_rate:+.3g} 1/s: make the observer slower (a Kalman filter by less disturbance), ask for"
            " less damping, or control that mode too; explain_spillover or `workbench design` names the path"
        )
    highest = max(controller.law.controlled, key=lambda r: float(modes.omega[r]))
    fastest = float(modes.frequencies_hz[highest])
    if sample_rate_hz <= 2.0 * fastest:
        raise DesignError(
            f"{sample_rate_hz:g} Hz is too slow for mode {highest + 1} at {fastest:.4g} Hz, which"
            f" needs more than {2 * fastest:.4g} Hz; sample at {_round_up(COMFORTABLE * fastest):g} Hz"
        )

    def poles(rate: float, delay: float) -> np.ndarray:
        at_rate = sampled(controller, 1.0 / rate)
        loop = sampled_loop(modes, controller.law.actuators, controller.sensors, at_rate, delay)
        return np.asarray(np.linalg.eigvals(loop))

    sampled_poles = poles(sample_rate_hz, computing_delay)
    if not _stable(sampled_poles):
        delay = computing_delay + max(actuator.delay for actuator in controller.law.actuators)
        raise DesignError(_too_slow(lambda rate: _stable(poles(rate, computing_delay)), sample_rate_hz, delay))
    margin = _delay_margin(digital.sample_time, lambda more: _stable(poles(sample_rate_hz, computing_delay + more)))
    return SampledDesign(modes, controller, digital, computing_delay, sampled_poles, margin)


def _stable(poles: np.ndarray) -> bool:
    return bool(np.abs(poles).max() <= 1.0 + ON_CIRCLE)


def _too_slow(stable: Callable[[float], bool], rate: float, delay: float) -> str:
    """The message on a rate at which the loop is unstable, with a rate at which it is stable."""
    fast = 2.0 * rate
    while not stable(fast):
        fast *= 2.0
        if fast > FASTEST * rate or fast * delay > MOST_PAST:
            return (
                f"delays of {1e3 * delay:.4g} ms destabilise the loop at this rate and at faster rates; shorten the"
                " delays, or lower the gains"
            )
    slow = 0.5 * fast
    for _ in range(20):
        middle = 0.5 * (slow + fast)
        slow, fast = (slow, middle) if stable(middle) else (middle, fast)
    least = next(r for r in (_round_up(fast), 1.1 * fast, 2.0 * fast) if stable(r) or r > 1.5 * fast)
    return (
        f"at {rate:g} Hz the loop is unstable, as the zero-order hold adds a delay of half a sample; sample at"
        f" {_round_up(least):g} Hz or more, or lower the gains"
    )


def _round_up(value: float) -> float:
    """The value rounded up to two digits."""
    step = 10.0 ** (np.floor(np.log10(value)) - 1)
    return float(np.ceil(value / step - 1e-9) * step)


def _delay_margin(period: float, stable: Callable[[float], bool]) -> float:
    """The least further delay that destabilises, s."""
    tried = period * np.linspace(0.0, MOST_LATE, TRIES + 1)
    slow = next((i for i, more in enumerate(tried) if not stable(more)), None)
    if slow is None:
        return np.inf
    if slow == 0:
        return 0.0
    low, high = tried[slow - 1], tried[slow]
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return float(low)
