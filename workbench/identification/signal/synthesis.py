"""Synthesis of free decays from modes."""

from collections.abc import Sequence

import numpy as np

from workbench.records.record import Channel, Record
from workbench.rig.sensors import MEASURED
from workbench.structure.domain import Place, listed, place_array, same_place
from workbench.structure.modes import Modes, SampledModes


def impulse_response_modes(modes: Modes, *, at: Place, positions: Sequence[Place]) -> SampledModes:
    """The free decay after a unit impulse, as sampled modes whose shapes include amplitude and phase.

    An impulse of 1 N s at x0 gives q_r'(0) = φ_r(x0), so w(x, t) = Re Σ_r s_r(x) e^{λ_r t} with
    s_r(x) = -i φ_r(x) φ_r(x0) / ω_dr.

    Args:
        modes: with proportional damping below critical.
        at: x0, m, or another place of the domain.
        positions: (n_outputs,) places of the sensors.

    Raises:
        ValueError: rigid-body, overdamped or coupled modes, which have no such form.
    """
    if not modes.proportional or (modes.omega == 0).any() or (modes.zeta >= 1).any():
        raise ValueError(
            "a free decay has separate modes only if each is elastic and underdamped;"
            " select such modes, or simulate the rig"
        )
    omega_d = modes.omega * np.sqrt(1.0 - modes.zeta**2)
    shapes = -1j * modes.phi(list(positions)) * modes.phi(at)[0] / omega_d
    return SampledModes(modes.omega, modes.zeta, shapes, place_array([same_place(x) for x in positions]))


def free_decay(
    modes: SampledModes,
    *,
    sample_time: float,
    n_samples: int,
    quantity: str = "displacement",
    start_time: float = 0.0,
    noise_std: float = 0.0,
    seed: int | np.random.Generator = 0,
    aliases: bool = False,
) -> Record:
    """The record y_j(t) = d^k/dt^k Re Σ_r s_jr e^{λ_r t}, k = 0, 1, 2 for displacement, velocity, acceleration.

    Args:
        modes: shapes s_jr (n_outputs, n_modes) carry the amplitude and phase at t = 0.
        sample_time: s.
        n_samples: number of samples.
        quantity: of every sensor.
        start_time: time of the first sample, s.
        noise_std: standard deviation of white noise added, in the unit of the quantity.
        seed: of that noise.
        aliases: whether modes beyond half the sample rate are allowed, and alias, as without an anti-alias filter.

    Raises:
        ValueError: a quantity that is not a motion of a point, or a mode beyond half the sample rate.
    """
    half_rate = 0.5 / sample_time
    beyond = np.flatnonzero(modes.frequencies_hz > half_rate)
    if beyond.size and not aliases:
        raise ValueError(
            f"mode {beyond[0] + 1} at {modes.frequencies_hz[beyond[0]]:g} Hz lies beyond half the sample rate,"
            f" {half_rate:g} Hz; sample faster, leave it out, or ask for aliases"
        )
    if quantity not in MEASURED:
        raise ValueError(f"a free decay is of {', '.join(MEASURED)}; got {quantity!r}")
    time = start_time + sample_time * np.arange(n_samples)
    amplitudes = modes.shapes * modes.poles ** MEASURED[quantity][1]
    outputs = (amplitudes @ np.exp(modes.poles[:, None] * time)).real
    if noise_std:
        outputs = outputs + noise_std * np.random.default_rng(seed).standard_normal(outputs.shape)
    channels = tuple(
        Channel(f"y{j + 1}", quantity, at=None if unknown else at)
        for j, (at, unknown) in enumerate(zip(listed(modes.positions), modes.without_position))
    )
    return Record(sample_time, outputs, channels, start_time=start_time, name="free decay")
