import numpy as np
from scipy.signal import lfilter

from workbench.identification.input_output.competing_models import in_place_of_clusters, orthonormal_basis
from workbench.identification.input_output.known_inputs import KnownInputs
from workbench.identification.input_output.modal_fit import MANY_ROWS, projected
from workbench.identification.signal.searches import TimeLimit
from workbench.records.record import Channel, Record


def test_the_basis_of_many_rows_has_directions_far_below_the_largest():
    """Products of columns lose singular values below 1e-8 of the largest."""
    rng, sizes = np.random.default_rng(0), np.array([1.0, 1e-3, 1e-7, 1e-8, 1e-11])
    exact, turn = (np.linalg.qr(rng.standard_normal((n, 5)))[0] for n in (MANY_ROWS, 5))
    basis = orthonormal_basis((exact * sizes) @ turn, 1e-9)
    assert basis.shape == (MANY_ROWS, 4)
    np.testing.assert_allclose(basis.T @ basis, np.eye(4), atol=1e-12)
    # rounding of the columns, 1e-16, over the size of each direction
    assert (np.linalg.norm(exact - basis @ (basis.T @ exact), axis=0)[:4] < 1e-14 / sizes[:4]).all()


def test_what_follows_a_changing_mode_is_compared_beside_it():
    """Clusters are compared two at a time; the second again where a mode replaces the first, or not at all."""
    rng, dt, hz = np.random.default_rng(1), 1e-3, np.array([40.0, 40.5, 41.0, 90.0, 90.5])
    u, poles = rng.standard_normal((1, 2000)), 2.0 * np.pi * hz * (-0.01 + 1j)
    sizes = np.array([4.0, 2.0, 1.0, 0.5, 0.2])
    y = sum(
        a * np.imag(lfilter([0.0, 1.0], [1.0, -np.exp(p * dt)], u.astype(complex)))
        for p, a in zip(poles, sizes, strict=True)
    )
    record = Record(dt, y + 1e-3 * rng.standard_normal(y.shape), (Channel("y"),), u, (Channel("u"),))
    data = KnownInputs([record], at_rest=True, hold="zero", feedthrough=True)
    fit = projected(data, poles, np.ones((5, 1), complex))
    beside, compared = data.with_distorted((1j,)), []

    def alternative_of(measured, cluster):
        compared.append((measured, sorted(cluster.tolist())))
        return (beside, poles[cluster[0]] + 1.0) if cluster.size == 2 and 0 in cluster else None

    alike = np.abs(np.subtract.outer(hz, hz)) < 5.0
    found = in_place_of_clusters(data, fit, alike, alternative_of, TimeLimit())
    assert found is not None and found[0] is beside
    strongest_pair = compared[1][1]
    kept = np.delete(np.arange(5), [m for m in strongest_pair if m != 0])
    assert found[1].poles.size == 4 and found[1].poles[kept.tolist().index(0)] == poles[0] + 1.0
    assert [cluster for measured, cluster in compared if measured is data] == [[0, 1, 2], strongest_pair]
    assert [3, 4] in [cluster for measured, cluster in compared if measured is beside]
