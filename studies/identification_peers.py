"""How far from the Cramér-Rao bound is each method, the order unknown to all? Fifty random structures, four peers.

3 to 8 modes, two of them 2 to 4 % apart, damping 0.1 to 3 %, 4 to 8 sensors, 1500 samples at 10 kHz, noise 60, 40 and
20 dB below the record; the same record for every method. An error counts in standard errors of the bound; the worst of
a structure is that of frequency or damping of its worst mode. A mode is found where a pole lies within 3 % of its
frequency and nearer than half the way to its neighbour, one to one.

Peers are used as they document themselves, with the settings that did best on structures not in this trial:

  SSI-cov of pyOMA2: 60 block rows, order up to 40, its clustering "hier_avg" choosing the modes;
  ERA of python-control: Hankel matrix of half the record, order from its singular values (Gavish & Donoho 2014);
  LSCF of sdypy-EMA: transfer functions by FFT, order 60, columns of its stability chart (0.1 % in frequency and 5 % in
    damping from order to order, at three orders in ten) handed to `select_closest_poles`;
  two delays, the form of 1981: as many modes as sensors, those with damping between 0 and 0.3 kept.

With --data ruler.mat also on ten measured transfer functions of a steel ruler, decimated by 6.
"""

import contextlib
import importlib.util
import io
import logging
import warnings
from pathlib import Path
from time import perf_counter

import control
import numpy as np
from scipy.optimize import linear_sum_assignment

from workbench.draw.identification import peers_errors
from workbench.identification.free_decay.ibrahim import two_delays
from workbench.identification.free_decay.order import identify
from workbench.identification.free_decay.refinement import cramer_rao_bound
from workbench.identification.signal.projection import project
from workbench.identification.signal.synthesis import free_decay
from workbench.records.frequency_responses import read_frf
from workbench.records.record import Record
from workbench.records.resample import decimate
from workbench.structure.modes import SampledModes

STRUCTURES, FIRST_SEED = 50, 200  # settings were chosen on seeds below 110
LEVELS_DB = (60, 40, 20)
SAMPLE_TIME, SAMPLES = 1e-4, 1500
COUNTS_BELOW, NEAR = 0.01, 0.03
MOST_DAMPED = 0.3
OURS, SSI = "this project", "SSI-cov, pyOMA2"

RULER_HZ = np.array([6.7, 39.4, 108.8, 212.0, 352.6, 517.9, 551.0, 729.0])
RULER_POSITIONS, RULER_DECIMATION, RULER_BAND_HZ = np.linspace(0.003, 0.983, 10), 6, 800.0


def this_project(record: Record):
    modes = identify(record).modes
    return modes.omega, modes.zeta


def two_delays_1981(record: Record):
    modes = two_delays(record, columns=record.n_samples - 2)
    return _ringing(modes.poles)


def era(record: Record):
    impulse = record.outputs[:, None, :]
    rows, columns = 100, record.n_samples // 2
    size = {"m": rows, "n": columns, "dt": record.sample_time}
    values = control.eigensys_realization(impulse, 2, **size)[1]
    # Gavish & Donoho: the threshold for singular values in white noise of unknown level, by a cubic in the aspect
    aspect = min(rows * record.n_outputs, columns) / max(rows * record.n_outputs, columns)
    threshold = np.polyval([0.56, -0.95, 1.82, 1.43], aspect) * np.median(values)
    system = control.eigensys_realization(impulse, max(2, int((values > threshold).sum())), **size)[0]
    return _ringing(np.log(np.linalg.eigvals(system.A).astype(complex)) / record.sample_time)


def ssi_cov(record: Record):
    from pyoma2.algorithms import SSI as Algorithm
    from pyoma2.algorithms.data.run_params import Clustering
    from pyoma2.setup import SingleSetup

    setup = SingleSetup(record.outputs.T.copy(), fs=record.sample_rate_hz)
    algorithm = Algorithm(name="ssi", method="cov", br=60, ordmax=40)
    setup.add_algorithms(algorithm)
    setup.run_all()
    algorithm.add_clustering(Clustering(name="modes", quick="hier_avg"))
    algorithm.run_clustering("modes")
    found = algorithm.result.clustering_results["modes"]
    return 2 * np.pi * np.ravel(found.Fn), np.ravel(found.Xi)


def lscf(record: Record):
    from sdypy import EMA

    transfer = np.fft.rfft(record.outputs, axis=1) * record.sample_time
    hz = np.fft.rfftfreq(record.n_samples, record.sample_time)
    model = EMA.Model(transfer, hz, lower=0.01 * hz[-1], upper=hz[-1], pol_order_high=60, frf_form="receptance")
    model.get_poles(method="lscf", show_progress=False)
    columns = _stable_columns(model.all_poles)
    if not columns:
        return np.zeros(0), np.zeros(0)
    model.select_closest_poles(columns)
    return 2 * np.pi * np.asarray(model.nat_freq), np.asarray(model.nat_xi)


METHODS = {OURS: this_project, SSI: ssi_cov, "ERA, python-control": era, "LSCF, sdypy-EMA": lscf}
METHODS |= {"two delays, 1981": two_delays_1981}
PACKAGES = {SSI: "pyoma2", "LSCF, sdypy-EMA": "sdypy"}


def _ringing(poles: np.ndarray):
    """Frequencies and damping ratios of the underdamped poles."""
    poles = poles[(poles.imag > 0) & (poles.real < 0)]
    omega, zeta = np.abs(poles), -poles.real / np.abs(poles)
    return omega[zeta < MOST_DAMPED], zeta[zeta < MOST_DAMPED]


def _stable_columns(all_poles) -> list[float]:
    """Frequencies, Hz, where poles stay from order to order."""
    orders = [_ringing(np.asarray(poles)) for poles in all_poles]
    stable = [np.zeros(0)]
    for (f0, z0), (f1, z1) in zip(orders, orders[1:]):
        stays = (np.abs(f1[:, None] / f0 - 1) < 1e-3) & (np.abs(z1[:, None] / z0 - 1) < 0.05)
        stable.append(f1[stays.any(axis=1)])
    omega = np.sort(np.concatenate(stable))
    columns = np.split(omega, np.flatnonzero(np.diff(omega) > 3e-3 * omega[:-1]) + 1)
    return [float(np.median(c)) / (2 * np.pi) for c in columns if c.size >= 0.3 * len(orders)]


def random_structure(seed: int) -> SampledModes:
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(3, 9)), int(rng.integers(4, 9))
    while True:
        f = np.sort(np.exp(rng.uniform(np.log(0.02), np.log(0.4), n)))
        pair = int(rng.integers(1, n))
        f[pair] = f[pair - 1] * rng.uniform(1.02, 1.04)
        f = np.sort(f)
        if (np.diff(f) / f[:-1]).min() >= 0.02 and f[-1] < 0.45:
            break
    zeta = np.exp(rng.uniform(np.log(0.001), np.log(0.03), n))
    size = np.exp(rng.uniform(np.log(0.1), 0.0, n)) * np.exp(1j * rng.uniform(0, 2 * np.pi, n))
    shapes = rng.standard_normal((m, n)) * (1.0 + 0.1j * rng.standard_normal((m, n))) * size
    return SampledModes(2 * np.pi * f / SAMPLE_TIME, zeta, shapes, np.linspace(0.0, 1.0, m))


def score(omega: np.ndarray, zeta: np.ndarray, truth: SampledModes, limit) -> dict:
    """The worst error in standard errors of the bound, modes missed and modes that are not there."""
    apart = np.array([np.abs(np.delete(truth.omega, r) - w).min() for r, w in enumerate(truth.omega)])
    away = np.abs(omega[:, None] - truth.omega) / np.minimum(0.5 * apart, NEAR * truth.omega)
    rows, columns = linear_sum_assignment(np.minimum(away, 1.0))
    near = away[rows, columns] < 1.0
    rows, columns = rows[near], columns[near]
    counts = limit.omega_std < COUNTS_BELOW * truth.omega
    error = np.maximum(
        np.abs(omega[rows] - truth.omega[columns]) / limit.omega_std[columns],
        np.abs(zeta[rows] - truth.zeta[columns]) / limit.zeta_std[columns],
    )[counts[columns]]
    missed = int(counts.sum() - counts[columns].sum())
    return {"worst": float(error.max(initial=0.0)), "missed": missed, "false": int(omega.size - rows.size)}


def quiet(method, record: Record):
    """What the method finds and the seconds it takes; its progress bars are not shown."""
    with (
        warnings.catch_warnings(),
        contextlib.redirect_stderr(io.StringIO()),
        contextlib.redirect_stdout(io.StringIO()),
    ):
        warnings.simplefilter("ignore")
        start = perf_counter()
        omega, zeta = method(record)
        return np.asarray(omega), np.asarray(zeta), perf_counter() - start


def trial(methods: dict, seed: int, level: int) -> tuple[dict[str, dict], float]:
    """The score of every method on one structure, and the worst error of a draw from the bound itself."""
    truth, rng = random_structure(seed), np.random.default_rng((seed, level))
    clean = free_decay(truth, sample_time=SAMPLE_TIME, n_samples=SAMPLES)
    noise = float(np.sqrt((clean.outputs**2).mean()) * 10 ** (-level / 20))
    record = free_decay(truth, sample_time=SAMPLE_TIME, n_samples=SAMPLES, noise_std=noise, seed=rng)
    limit = cramer_rao_bound(truth, record, noise_std=noise)
    scores = {}
    for name, method in methods.items():
        omega, zeta, took = quiet(method, record)
        scores[name] = {**score(omega, zeta, truth, limit), "seconds": took}
    counts = np.tile(limit.omega_std < COUNTS_BELOW * truth.omega, 2)
    std = np.sqrt(np.diag(limit.covariance))
    draws = rng.multivariate_normal(np.zeros(counts.sum()), (limit.covariance / np.outer(std, std))[counts][:, counts])
    return scores, float(np.abs(draws).max())


def summary(scores: list[dict], ours: list[dict]) -> dict:
    """Over the structures of one level; a structure with a mode missed has no finite worst mode."""
    worst = np.array([s["worst"] if not s["missed"] else np.inf for s in scores])
    found = np.array([s["worst"] for s in scores])
    return {
        "median": float(np.median(worst)),
        "median_of_found": float(np.median(found)),
        "largest": float(worst.max()),
        "largest_of_found": float(found.max()),
        "missed": sum(s["missed"] for s in scores),
        "false": sum(s["false"] for s in scores),
        "time_over_ours": sum(s["seconds"] for s in scores) / sum(s["seconds"] for s in ours),
    }


def study(outcome, data: Path | None = None) -> None:
    logging.disable(logging.INFO)
    absent = {name: package for name, package in PACKAGES.items() if importlib.util.find_spec(package) is None}
    for name, package in absent.items():
        outcome.say(f"{name}: not tried, {package} is not installed (pip install -e '.[peers]')")
    methods = {name: method for name, method in METHODS.items() if name not in absent}
    seeds = range(FIRST_SEED, FIRST_SEED + STRUCTURES)
    every, efficient = {}, {}
    for level in LEVELS_DB:
        both = [trial(methods, seed, level) for seed in outcome.track(seeds, f"structures at {level} dB")]
        every[level] = {name: [scores[name] for scores, _ in both] for name in methods}
        efficient[level] = float(np.median([worst for _, worst in both]))
    tables = {
        level: {name: summary(scores, by_name[OURS]) for name, scores in by_name.items()}
        for level, by_name in every.items()
    }
    outcome.table("errors_over_bound", tables)
    outcome.table("median_of_an_efficient_method", efficient)
    outcome.table("absent", absent)
    for level, table in tables.items():
        ours, peers = table[OURS], {name: row for name, row in table.items() if name != OURS}
        nearest = min(peers, key=lambda name: peers[name]["median"])
        outcome.say(
            f"{level} dB: worst mode {ours['median']:.2f} standard errors of the bound (an efficient method"
            f" {efficient[level]:.2f}), {ours['missed']} missed, {ours['false']} spurious; next {nearest} with"
            f" {peers[nearest]['median']:.2f}, {peers[nearest]['missed']} missed, {peers[nearest]['false']} spurious"
        )
        outcome.check(
            f"{level} dB: worst mode over that of an efficient method", ours["median"] / efficient[level], 1.1
        )
        for what in ("median", "largest"):
            best = min(row[what] for row in peers.values())
            outcome.check(f"{level} dB: {what} worst mode over the best peer's", ours[what] / best, 1.0)
        if SSI in table:
            outcome.check(f"{level} dB: time over SSI-cov's", 1.0 / table[SSI]["time_over_ours"], 1.0)
    outcome.figure(
        "errors",
        peers_errors(every, efficient),
        "Worst mode of each of fifty structures in standard errors of the Cramér-Rao bound; hollow where modes are"
        " missed. The line is the median of a method that attains the bound.",
    )
    if data is None:
        outcome.say("the ruler: not tried, its file was not given (--data ruler.mat)")
    else:
        on_the_ruler(outcome, methods, data)


def on_the_ruler(outcome, methods: dict, data: Path) -> None:
    """No truth but the eight modes known of it; what each method leaves of the record, amplitudes fitted alike."""
    record = read_frf(data, positions=RULER_POSITIONS, quantity="acceleration")
    record = decimate(record, RULER_DECIMATION)
    rows = {}
    for name, method in methods.items():
        omega, zeta, took = quiet(method, record)
        poles = omega * (-zeta + 1j * np.sqrt(1.0 - zeta**2))
        hz = omega[omega < 2 * np.pi * RULER_BAND_HZ] / (2 * np.pi)
        away = np.abs(hz[:, None] / RULER_HZ - 1.0)
        near, known = linear_sum_assignment(np.minimum(away, NEAR))
        found = int((away[near, known] < NEAR).sum())
        left = np.sum(project(record, poles, True).residual ** 2) / np.sum(record.outputs**2)
        rows[name] = {
            "found": found,
            "others": int(hz.size) - found,
            "left": float(np.sqrt(left)),
            "seconds": took,
        }
    first = rows[OURS]["seconds"]
    for name, row in rows.items():
        row["time_over_ours"] = row.pop("seconds") / first
        outcome.say(
            f"ruler, {name}: {row['found']} of {RULER_HZ.size} known modes below {RULER_BAND_HZ:.0f} Hz and"
            f" {row['others']} others; leaves {100 * row['left']:.0f} % of the record; {row['time_over_ours']:.2g}"
            " times our time"
        )
    outcome.table("ruler", rows)
