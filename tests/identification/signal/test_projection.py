import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import bartlett, chi2

from workbench.identification.driven import identify_driven
from workbench.identification.free_decay.long_records import identify_long
from workbench.identification.free_decay.order import identify
from workbench.identification.free_decay.refinement import cramer_rao_bound, refine
from workbench.identification.signal import projection
from workbench.identification.signal.projection import (
    _project_by_parts,
    correlation,
    differ,
    independent,
    power_sums,
    project,
    variances,
)
from workbench.identification.signal.synthesis import free_decay
from workbench.records.record import Channel, Record
from workbench.structure.modes import SampledModes

SHAPES = np.random.default_rng(3).standard_normal((3, 3)) + 0.1j
MODES = SampledModes(2 * np.pi * np.array([3.0, 9.0, 9.4]), [0.01, 0.006, 0.012], SHAPES, np.linspace(0, 1, 3))
STRUCK = np.array([[1.0, 0.3j, -0.5], [1.2, -1.0, 0.8j]])
# The second record is louder, and ten times as noisy, but for one sensor.
NOISE = np.array([[0.01, 0.02, 0.01], [0.1, 0.2, 0.01]])
DRAWS = 100


@pytest.fixture(scope="module")
def truth():
    """A mode that dies within a part, one that outlasts the record, two 0.5 % apart, one that does not decay."""
    shapes = np.random.default_rng(0).standard_normal((5, 5)) * np.exp(1j * np.arange(5))
    omega = 2 * np.pi * np.array([0.02, 0.1, 0.1005, 0.21, 0.44])
    return SampledModes(omega, [0.004, 0.002, 0.001, 0.0, 0.02], shapes, np.linspace(0, 1, 5))


@pytest.mark.parametrize("n", [1, 2, 1000, 1023])
def test_sums_of_powers(n):
    w = np.array([0.99 + 0.1j, 1.0, 0.5, np.exp(1e-9j), -0.999, 1.0001j])
    i = np.arange(n)
    for k, found in enumerate(power_sums(w, n)):
        terms = i**k * w[:, None] ** i
        assert np.allclose(found, terms.sum(axis=1), rtol=0, atol=1e-12 * np.abs(terms).sum(axis=1).max())


@pytest.mark.parametrize("n", [7, 150, 3001])
@pytest.mark.parametrize("offset", [True, False])
def test_projection_is_least_squares_of_all_samples(truth, n, offset):
    record = free_decay(truth, sample_time=0.5, n_samples=n, noise_std=0.1)
    poles = truth.poles[1::2] if n > 7 else truth.poles[:0]
    time = 0.5 * np.arange(n)[:, None]
    phi = np.hstack([np.exp(time * poles).real, np.exp(time * poles).imag])
    columns = np.hstack([phi, np.ones((n, int(offset)))])
    c = np.linalg.lstsq(columns, record.outputs.T, rcond=None)[0]
    left = record.outputs.T - columns @ c
    tilt = np.linalg.lstsq(columns, time * phi, rcond=None)[0]
    rest = time * phi - columns @ tilt
    found = project(record, poles, offset)
    expected = {"residual": left, "squares": (left**2).sum(axis=0), "coefficients": c, "tilt": tilt}
    expected |= {"gram": rest.T @ rest, "slopes": (time * phi).T @ left, "spread": np.linalg.inv(columns.T @ columns)}
    for name, exact in expected.items():
        assert np.allclose(getattr(found, name), exact, rtol=0, atol=1e-10 * np.abs(exact).max(initial=1.0)), name


def test_projection_holds_no_table_of_all_samples(truth):
    record = free_decay(truth, sample_time=0.5, n_samples=20_000, noise_std=0.1)
    tracemalloc.start()
    project(record, truth.poles, True)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # Five modes are eleven columns; twice the record is the residual and its making.
    assert peak < 5 * record.outputs.nbytes


@pytest.mark.parametrize("offset", [True, False])
def test_projection_by_parts_is_the_same(truth, monkeypatch, offset):
    record = free_decay(truth, sample_time=0.5, n_samples=3000, noise_std=0.1)
    whole = project(record, truth.poles, offset)
    monkeypatch.setattr(projection, "PROJECTION", replace(projection.PROJECTION, max_factored=1, part_samples=700))
    parts = project(record, truth.poles, offset)
    for name in ("residual", "squares", "coefficients", "gram", "slopes", "spread", "tilt"):
        exact = getattr(whole, name)
        assert np.allclose(getattr(parts, name), exact, rtol=0, atol=1e-10 * np.abs(exact).max()), name


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_refined_by_parts_is_the_same(truth, monkeypatch, noise):
    record = free_decay(truth, sample_time=0.5, n_samples=3000, noise_std=noise)
    start = SampledModes(truth.omega * (1 + 1e-4), truth.zeta + 1e-4, truth.shapes, truth.positions)
    whole = refine(record, start, offset=True)
    monkeypatch.setattr(projection, "PROJECTION", replace(projection.PROJECTION, max_factored=1))
    parts = refine(record, start, offset=True)
    assert whole.converged and parts.converged
    allowed = 0.01 * whole.omega_std + 1e-12
    assert (np.abs(parts.modes.omega - whole.modes.omega) < allowed).all()
    assert (np.abs(parts.modes.zeta - whole.modes.zeta) < 0.01 * whole.zeta_std + 1e-11).all()
    if noise:
        assert np.allclose(parts.covariance, whole.covariance, rtol=0.01, atol=1e-5 * np.abs(whole.covariance).max())


def records(seed, n=(400, 500), noise=NOISE):
    rng, found = np.random.default_rng(seed), []
    for struck, n_samples, std in zip(STRUCK, n, noise, strict=True):
        clean = free_decay(replace(MODES, shapes=SHAPES * struck), sample_time=0.01, n_samples=n_samples)
        found.append(replace(clean, outputs=clean.outputs + std[:, None] * rng.standard_normal(clean.outputs.shape)))
    return found


def least():
    """Standard errors of ω and ζ that none can be below."""
    told = [
        np.linalg.inv(cramer_rao_bound(replace(MODES, shapes=SHAPES * struck), record, noise_std=std).covariance)
        for struck, record, std in zip(STRUCK, records(0), NOISE, strict=True)
    ]
    return np.sqrt(np.diag(np.linalg.inv(sum(told))))


def within(normalised):
    """Whether the squares of normalised errors may be those of unit normals, to one chance in a thousand each way."""
    squares, size = float((normalised**2).sum()), normalised.size
    return chi2.ppf(1e-3, size) < squares < chi2.isf(1e-3, size)


@pytest.mark.slow
def test_errors_are_true_and_at_the_bound_where_one_record_is_ten_times_noisier():
    truth, limit, figures, own, shapes = np.r_[MODES.omega, MODES.zeta], least(), [], [], []
    k, each = np.abs(SHAPES).argmax(axis=0), np.arange(3)
    others = np.arange(3)[:, None] != k
    for seed in range(DRAWS):
        found = refine(records(seed), MODES)
        errors = np.r_[found.modes.omega, found.modes.zeta] - truth
        figures.append(errors / limit)
        own.append(errors / np.sqrt(np.diag(found.covariance)))
        seen = (found.modes.shapes / found.modes.shapes[k, each] - SHAPES / SHAPES[k, each]).real
        shapes.append(seen[others] / found.shape_std[others])
    assert within(np.array(figures)) and within(np.array(own)) and within(np.array(shapes))
    # 600 intervals of 95 %: the share that holds strays by 0.009 (one sigma)
    assert abs((np.abs(own) < 1.96).mean() - 0.95) < 0.03
    assert np.allclose(found.noise, NOISE, rtol=0.15)


def test_modes_are_counted_by_the_quieter_record():
    """Both roads find the third mode, which the noisy record hides, and say the errors that the bound allows."""
    for found in (identify(records(0)).refined, identify_long(records(0), max_modes=20).refined):
        assert found.modes.n_modes == 3
        assert np.allclose(np.sqrt(np.diag(found.covariance)), least(), rtol=0.12)


def test_shapes_are_those_of_the_record_that_shows_them():
    """A blow at a node of the first mode is loud, and says nothing of its shape."""
    loud = free_decay(replace(MODES, shapes=SHAPES * [1e-4, 9.0, 9.0]), sample_time=0.01, n_samples=400)
    quiet = free_decay(replace(MODES, shapes=SHAPES * [1.0, 0.5, 0.5]), sample_time=0.01, n_samples=400)
    rng = np.random.default_rng(0)
    noisy = [replace(r, outputs=r.outputs + 0.02 * rng.standard_normal(r.outputs.shape)) for r in (loud, quiet)]
    found, alone = refine(noisy, MODES), refine(noisy[1], MODES)
    assert np.allclose(found.shape_std[:, 0], alone.shape_std[:, 0], rtol=0.1)
    assert (found.shape_std[:, 1:] <= 0.1 * alone.shape_std[:, 1:]).all()


def test_variances_are_pooled_where_records_may_be_alike():
    squares, free = np.array([[90.0, 90.0], [110.0, 1000.0]]), np.array([100, 100])
    assert np.array_equal(differ(squares, free), [False, True])
    assert np.allclose(variances(squares, free), [[1.0, 0.9], [1.0, 10.0]])
    # Bartlett's statistic against scipy's, of samples
    samples = [np.random.default_rng(k).standard_normal(n) * s for k, (n, s) in enumerate([(20, 1.0), (30, 1.6)])]
    squares = np.array([[((x - x.mean()) ** 2).sum()] for x in samples])
    assert differ(squares, np.array([19, 29]))[0] == (bartlett(*samples).pvalue < 0.05)
    assert differ(squares * [[1.0], [2.0]], np.array([19, 29]))[0]


def driven_records(seed, noise):
    """Two records of a chain of two modes under forces of their own, held between samples."""
    rng, found = np.random.default_rng(seed), []
    for std in noise:
        u = rng.standard_normal((1, 400))
        z = [
            lfilter([0.0, (m - 1.0) / p], [1.0, -m], u[0] + 0j)
            for p, m in zip(POLES, np.exp(0.02 * POLES), strict=True)
        ]
        clean = (SEEN @ np.array(z)).real
        channels = (Channel("a", "velocity"), Channel("b", "velocity"))
        y = clean + std[:, None] * rng.standard_normal(clean.shape)
        found.append(Record(0.02, y, channels, u, (Channel("f", "force"),)))
    return found


POLES = np.array([-0.2 + 12.0j, -0.3 + 31.0j])
SEEN = np.array([[1.0, 0.8 + 0.1j], [0.5, -1.0]])


@pytest.mark.slow
def test_driven_records_count_by_their_noise():
    quiet, noisy = np.array([0.02, 0.01]), np.array([0.2, 0.1])
    own = []
    for seed in range(3):
        pair = driven_records(seed, (noisy, quiet))
        found = identify_driven(pair)
        assert found.modes.n_modes == 2
        errors = np.r_[found.modes.omega, found.modes.zeta] - np.r_[np.abs(POLES), -POLES.real / np.abs(POLES)]
        own.append(errors / np.sqrt(np.diag(found.covariance)))
    assert within(np.array(own))
    assert np.allclose(found.noise, [noisy, quiet], rtol=0.15)
    # The noisy record can add a hundredth to what the quiet one tells, and must not take from it.
    alone = identify_driven(pair[1])
    assert (found.omega_std < 1.02 * alone.omega_std).all() and (found.zeta_std < 1.02 * alone.zeta_std).all()


def test_exponentials_that_round_off_makes_alike_are_refused():
    """One that hardly oscillates within the record is, with its slope, all but a multiple of itself."""
    record = Record(0.002, np.random.default_rng(0).standard_normal((1, 9000)), (Channel("a"),))
    with pytest.raises(np.linalg.LinAlgError):
        _project_by_parts(record, np.array([0.0146 + 1e-5j, -0.8 + 1.7j]), True)


@pytest.mark.parametrize(("m", "n"), [(4, 80), (4, 200), (20, 1000), (60, 3000), (200, 2000)])
def test_independent_noise_is_not_said_to_be_shared(m, n):
    for seed in range(5):
        assert correlation([np.random.default_rng(seed).standard_normal((m, n))]) is None


def test_the_correlation_of_noise_beside_modes_that_are_not_found_yet():
    """These are ten times as loud, within their bands."""
    rng, n = np.random.default_rng(1), 8000
    common, own, time = rng.standard_normal(n), rng.standard_normal((3, n)), np.arange(n)
    modes = 10.0 * rng.standard_normal((3, 4)) @ np.sin(np.outer([0.31, 0.77, 1.4, 2.2], time))
    noise = np.sqrt(0.8) * common + np.sqrt(0.2) * own
    found = correlation([np.array([[1.0], [5.0], [-0.1]]) * (noise + modes)])
    np.testing.assert_allclose(found, np.outer([1, 1, -1], [1, 1, -1]) * (0.8 + 0.2 * np.eye(3)), atol=0.03)


def test_combinations_of_outputs_share_no_noise_and_keep_a_decay():
    rng, n = np.random.default_rng(2), 6000
    noise = np.array([[2.0], [0.3], [1.0]]) * (rng.standard_normal(n) + 0.5 * rng.standard_normal((3, n)))
    decay = np.exp((-0.002 + 0.4j) * np.arange(n)).real * np.array([[1.0], [0.5], [-2.0]])
    record = Record(1.0, noise + decay, tuple(Channel(f"y{i}") for i in range(3)))
    (mixed,), (left,) = independent([record], [noise])
    np.testing.assert_allclose(np.corrcoef(left), np.eye(3), atol=0.05)
    np.testing.assert_allclose(left.std(axis=1), 1.0, atol=0.05)
    seen = mixed.outputs - left  # the decay alone, seen through the same combinations
    assert np.linalg.matrix_rank(seen, tol=1e-6 * np.linalg.norm(seen)) == 1


def test_correlation_of_many_outputs_takes_no_more_room_than_their_lines():
    """The median over bands of what outputs share, entry by entry as it is defined, without all bands at once."""
    rng, m, n = np.random.default_rng(4), 120, 12_800
    left = [np.linalg.cholesky(np.eye(m) + 0.4) @ rng.standard_normal((m, n)) for _ in range(2)]
    lines = [np.fft.rfft(each * np.hanning(n), axis=1)[:, 1:].reshape(m, -1, 32) for each in left]
    bands = np.concatenate([np.moveaxis(each, 1, 0) for each in lines])
    powers = np.real(bands @ bands.conj().swapaxes(1, 2))
    size = np.sqrt(np.diagonal(powers, axis1=1, axis2=2))
    values, vectors = np.linalg.eigh(np.median(powers / (size[:, :, None] * size[:, None, :]), axis=0))
    expected = (vectors * np.maximum(values, 1e-3)) @ vectors.T
    tracemalloc.start()
    found = correlation(left)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_allclose(found, expected / np.sqrt(np.outer(np.diag(expected), np.diag(expected))), atol=1e-12)
    assert np.triu(found, 1).any() and peak < 4 * sum(each.nbytes for each in left)
