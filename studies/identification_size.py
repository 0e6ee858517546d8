"""Two hundred sensors, a hundred thousand samples, a hundred modes, no order given: all found, and at what cost?

Damping 0.05 to 1 %, frequencies at random over nine tenths of the band, neighbours as close as a third of a half-width
(and of 1/T), complex shapes, amplitudes over a decade. First twenty structures of thirty modes, 8 to 60 sensors and
12,000 samples at three levels of noise, modes counted as in `identification_order`. Then the full size, and parts of
the same record, for how the cost grows. Processor seconds are those of this process, and beside them those of one
transform of every output; the peak of memory has the making of the record in it.
"""

import os
import resource
from pathlib import Path
from time import perf_counter, process_time

import numpy as np
from scipy.fft import rfft
from scipy.optimize import linear_sum_assignment

from workbench.draw.style import COLOURS, GREY, new_figure
from workbench.identification.free_decay.order import identify
from workbench.identification.free_decay.refinement import cramer_rao_bound
from workbench.identification.signal.synthesis import free_decay
from workbench.records.record import Record
from workbench.structure.modes import SampledModes

STRUCTURES, LEVELS_DB, MODES, SAMPLES = 20, (20, 40, 60), 30, 12_000
FULL_SENSORS, FULL_MODES, FULL_SAMPLES, FULL_DB = 200, 100, 100_000, 40
PARTS = (8, 4, 2, 1)
FIRST_SEED = 7000
CLOSEST = 1 / 3  # of a half-width of resonance and 1/T together
COUNTS_BELOW, WITHIN = 0.01, 5.0


def random_structure(seed: int, n_modes: int, n_sensors: int, n_samples: int) -> SampledModes:
    """True modes of a sample a second."""
    rng = np.random.default_rng(seed)
    while True:
        f = np.sort(rng.uniform(0.005, 0.45, n_modes))
        zeta = np.exp(rng.uniform(np.log(0.0005), np.log(0.01), n_modes))
        half_width = zeta * f + 1.0 / n_samples
        if (np.diff(f) > CLOSEST * np.minimum(half_width[1:], half_width[:-1])).all():
            break
    size = np.exp(rng.uniform(np.log(0.1), 0.0, n_modes)) * np.exp(2j * np.pi * rng.uniform(size=n_modes))
    shapes = rng.standard_normal((n_sensors, n_modes)) * (1.0 + 0.1j * rng.standard_normal((n_sensors, n_modes))) * size
    return SampledModes(2 * np.pi * f, zeta, shapes, np.linspace(0.0, 1.0, n_sensors))


def noisy(truth: SampledModes, n_samples: int, level_db: float, seed: int) -> tuple[Record, float]:
    clean = free_decay(truth, sample_time=1.0, n_samples=n_samples)
    noise = float(np.sqrt((clean.outputs**2).mean()) * 10 ** (-level_db / 20))
    return free_decay(truth, sample_time=1.0, n_samples=n_samples, noise_std=noise, seed=seed), noise


def compared(truth: SampledModes, record: Record, noise: float) -> tuple[dict, np.ndarray]:
    """Modes that count, found, not there, what it cost; errors (2, n_found) of ω and ζ over the bound."""
    start, own = perf_counter(), process_time()
    found = identify(record)
    took, own = perf_counter() - start, process_time() - own
    limit = cramer_rao_bound(truth, record, noise_std=noise)
    counts = limit.omega_std < COUNTS_BELOW * truth.omega
    away = np.abs(found.modes.omega[:, None] - truth.omega) / limit.omega_std
    rows, columns = linear_sum_assignment(np.minimum(away, WITHIN))
    hits = away[rows, columns] < WITHIN
    rows, columns = rows[hits], columns[hits]
    errors = np.array([
        (found.modes.omega[rows] - truth.omega[columns]) / limit.omega_std[columns],
        (found.modes.zeta[rows] - truth.zeta[columns]) / limit.zeta_std[columns],
    ])  # fmt: skip
    row = {
        "sensors": record.n_outputs,
        "samples": record.n_samples,
        "count": int(counts.sum()),
        "found": int(counts[columns].sum()),
        "reported": found.modes.n_modes,
        "false": found.modes.n_modes - rows.size,
        "settled": found.refined.converged,
        "seconds": took,
        "processor_seconds": own,
    }
    return row, errors


def transforms(record: Record) -> float:
    """Processor seconds of one transform of every output."""
    start = process_time()
    for output in record.outputs:
        rfft(output)
    return process_time() - start


def many_structures(outcome) -> None:
    rows, errors = [], []
    cases = [(level, seed) for level in LEVELS_DB for seed in range(FIRST_SEED, FIRST_SEED + STRUCTURES)]
    for level, seed in outcome.track(cases, "structures"):
        sensors = int(np.random.default_rng(seed).integers(8, 61))
        truth = random_structure(seed, MODES, sensors, SAMPLES)
        row, error = compared(truth, *noisy(truth, SAMPLES, level, seed))
        rows.append({"level_db": level, "seed": seed, **row})
        errors.append(error)
    total = {name: sum(row[name] for row in rows) for name in ("count", "found", "reported", "false")}
    recall, precision = total["found"] / total["count"], 1.0 - total["false"] / total["reported"]
    rms = np.sqrt((np.hstack(errors) ** 2).mean(axis=1))
    outcome.table("structures", total | {"rms_omega_over_bound": rms[0], "rms_zeta_over_bound": rms[1]})
    outcome.table("imperfect", [r for r in rows if r["found"] < r["count"] or r["false"] or not r["settled"]])
    outcome.check("recall of sixty records", recall, 0.99, at_least=True)
    outcome.check("precision of sixty records", precision, 0.99, at_least=True)
    outcome.check("error over the bound of sixty records", rms.max(), 1.1)
    outcome.say(
        f"sixty records of thirty modes: {total['found']} of {total['count']} detectable modes are identified,"
        f" {total['false']} of {total['reported']} reported are spurious; rms error {rms[0]:.3f} (frequency) and"
        f" {rms[1]:.3f} (damping) of the bound"
    )


def size_and_errors(rows, errors):
    """What a record costs to identify by its length, and errors (2, n_modes) of ω and ζ of the longest over the bound.

    Args:
        rows: with samples, processor_seconds, seconds, found, count, as `identification_size`.
        errors: in standard errors of the Cramér-Rao bound.
    """
    figure, (left, right) = new_figure(1, 2, width=10.5, height=4.2)
    samples = np.array([row["samples"] for row in rows])
    spent = np.array([row["processor_seconds"] for row in rows])
    left.loglog(samples, spent, "o-", label="processor time, both cores together")
    left.loglog(samples, spent[-1] * samples / samples[-1], "--", color=GREY, label="in proportion to the samples")
    left.axhline(30.0, color=COLOURS[1], lw=1.2)
    left.annotate("limit at full size: 30 s", (samples[0], 30.0), (0, 4), textcoords="offset points", color=COLOURS[1])
    for row in rows:
        text, at = f"{row['found']} of {row['count']}\nmodes", (row["samples"], row["processor_seconds"])
        left.annotate(text, at, (0, -8), textcoords="offset points", ha="center", va="top", fontsize=8.5)
    left.set_xticks(samples, [f"{n:,}" for n in samples])
    left.set_yticks([1, 3, 10, 30], ["1", "3", "10", "30"])
    left.minorticks_off()
    left.set(xlim=(0.3 * samples.min(), 1.4 * samples.max()), ylim=(0.25 * spent.min(), 60.0))
    left.set(xlabel=f"samples of {rows[-1]['sensors']} sensors", ylabel="time to identify [s]")
    left.legend(loc="lower right")
    edges, x = np.linspace(-4.0, 4.0, 17), np.linspace(-4.0, 4.0, 201)
    right.hist(errors.T, edges, density=True, label=("frequency", "damping"), color=COLOURS[:2], alpha=0.8)
    normal = np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi)
    right.plot(x, normal, color=GREY, lw=3, alpha=0.7, label="a method that attains the bound")
    right.set(xlabel="error of a mode / Cramér-Rao standard deviation [-]", ylabel="density")
    right.set_ylim(top=1.35 * right.get_ylim()[1])  # room for the legend
    right.legend(loc="upper left")
    return figure


def study(outcome, data: Path | None = None) -> None:
    many_structures(outcome)
    truth = random_structure(FIRST_SEED, FULL_MODES, FULL_SENSORS, FULL_SAMPLES)
    rows = []
    for part in outcome.track(PARTS, "lengths"):
        record, noise = noisy(truth, FULL_SAMPLES // part, FULL_DB, FIRST_SEED)
        row, errors = compared(truth, record, noise)
        row["processor_seconds_over_transforms"] = row["processor_seconds"] / transforms(record)
        rows.append(row)
        outcome.say(
            f"{row['sensors']} sensors, {row['samples']} samples: {row['found']} of {row['count']} detectable modes are"
            f" identified, {row['false']} spurious, in {row['processor_seconds']:.1f} s of processor time"
            f" ({row['seconds']:.1f} s by the clock), {row['processor_seconds_over_transforms']:.0f} times that of one"
            " transform of every output"
        )
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    full, rms = rows[-1], np.sqrt((errors**2).mean(axis=1))
    cost = np.array([row["processor_seconds"] for row in rows])
    slope = float(np.polyfit(np.log([row["samples"] for row in rows]), np.log(cost), 1)[0])
    outcome.table("processors", os.cpu_count())
    outcome.table("lengths", rows)
    outcome.table("full_size", {
        "peak_gigabytes": peak, "slope_of_cost": slope, "rms_omega_over_bound": rms[0], "rms_zeta_over_bound": rms[1],
    })  # fmt: skip
    outcome.say(
        f"rms error at full size {rms[0]:.3f} (frequency) and {rms[1]:.3f} (damping) of the bound; peak of memory"
        f" {peak:.2f} GB; the cost grows with the power {slope:.2f} of the samples"
    )
    outcome.check("modes missed at full size", full["count"] - full["found"], 0)
    outcome.check("spurious modes at full size", full["false"], 0)
    outcome.check("error over the bound at full size", rms.max(), 1.2)
    outcome.check("processor seconds at full size", full["processor_seconds"], 30.0)
    outcome.check("peak of memory, GB", peak, 3.0)
    outcome.check("power of the samples with which the cost grows", slope, 1.1)
    outcome.figure(
        "cost",
        size_and_errors(rows, errors),
        "Processor time over the length of the record, and what the hundred modes found at full size are wrong by.",
    )
