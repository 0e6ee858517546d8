import numpy as np

from workbench.identification.input_output.known_inputs import KnownInputs
from workbench.identification.input_output.model_order import select_modes
from workbench.records.record import Channel, Record


def test_how_a_blow_runs_between_samples_is_no_mode():
    """Three modes ring after a blow of 1.6 samples, which is no force held from sample to sample."""
    dt, n, begins, lasts = 1e-3, 1000, 0.1006, 1.6e-3
    time = dt * np.arange(n)
    force = np.where(np.abs(time - begins - 0.5 * lasts) < 0.5 * lasts, np.sin(np.pi * (time - begins) / lasts) ** 2, 0)
    omega, zeta = 2.0 * np.pi * np.array([18.3, 60.0, 160.0]), np.array([0.006, 0.003, 0.003])
    after = np.maximum(time - begins - 0.5 * lasts, 0.0)[:, None]
    rings = (np.array([0.4, 1.0, 0.5]) * np.exp(-zeta * omega * after) * np.cos(omega * after - [0.0, 0.3, 0.6])).sum(
        axis=1
    )
    moves = np.where(after[:, 0] > 0.0, rings, 0.0) + 1e-3 * np.random.default_rng(0).standard_normal(n)
    record = Record(dt, moves[None], (Channel("v", "velocity"),), force[None], (Channel("f", "force"),))
    found = select_modes(KnownInputs([record], at_rest=True, hold="zero", feedthrough=True), max_modes=6)
    np.testing.assert_allclose(found.fit.poles.imag, omega, rtol=1e-3)
