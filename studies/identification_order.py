"""Does the identification find the modes that are there and no others? A hundred random structures, no order given.

3 to 12 modes, damping 0.1 to 5 %, one neighbour in four only 2 to 4 % away, 4 to 16 sensors with complex shapes, noise
10 to 60 dB below the record. A mode counts where the Cramér-Rao bound of its frequency, from the true modes and noise,
is below 1 %. It is found where an identified mode lies within five standard errors of that bound, one to one.
"""

from pathlib import Path
from time import perf_counter

import numpy as np
from matplotlib.ticker import MaxNLocator
from scipy.optimize import linear_sum_assignment

from workbench.draw.style import COLOURS, new_figure
from workbench.identification.free_decay.order import identify
from workbench.identification.free_decay.refinement import cramer_rao_bound
from workbench.identification.signal.synthesis import free_decay
from workbench.structure.modes import SampledModes

# The method was developed on seeds below 1000.
STRUCTURES, FIRST_SEED = 100, 5000
COUNTS_BELOW, WITHIN = 0.01, 5.0


def random_structure(seed: int):
    """True modes, a noisy record of a sample a second, and the noise."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(3, 13)), int(rng.integers(4, 17))
    while True:
        f = np.sort(np.exp(rng.uniform(np.log(0.01), np.log(0.4), n)))
        for i in range(1, n):
            if rng.random() < 0.25:
                f[i] = f[i - 1] * rng.uniform(1.02, 1.04)
        f = np.sort(f)
        if (np.diff(f) / f[:-1]).min() >= 0.02 and f[-1] < 0.45:
            break
    zeta = np.exp(rng.uniform(np.log(0.001), np.log(0.05), n))
    size = np.exp(rng.uniform(np.log(0.1), 0.0, n)) * np.exp(1j * rng.uniform(0, 2 * np.pi, n))
    shapes = rng.standard_normal((m, n)) * (1.0 + 0.1j * rng.standard_normal((m, n))) * size
    truth = SampledModes(2 * np.pi * f, zeta, shapes, np.linspace(0.0, 1.0, m))
    n_samples, level = int(rng.integers(1000, 4000)), rng.uniform(10.0, 60.0)
    clean = free_decay(truth, sample_time=1.0, n_samples=n_samples)
    noise = float(np.sqrt((clean.outputs**2).mean()) * 10 ** (-level / 20))
    record = free_decay(truth, sample_time=1.0, n_samples=n_samples, noise_std=noise, seed=rng)
    return truth, record, noise, level


def compared(seed: int) -> dict:
    """How many modes count, are found, are reported, and are reported without being there."""
    truth, record, noise, level = random_structure(seed)
    std = cramer_rao_bound(truth, record, noise_std=noise).omega_std
    counts = std < COUNTS_BELOW * truth.omega
    start = perf_counter()
    modes = identify(record).modes
    took = perf_counter() - start
    away = np.abs(modes.omega[:, None] - truth.omega) / std
    rows, columns = linear_sum_assignment(np.minimum(away, WITHIN))
    hit = columns[away[rows, columns] < WITHIN]
    return {
        "seed": seed,
        "level_db": level,
        "modes": truth.n_modes,
        "count": int(counts.sum()),
        "found": int(counts[hit].sum()),
        "reported": modes.n_modes,
        "false": modes.n_modes - hit.size,
        "seconds": took,
    }


def order_found(rows):
    """Modes identified, missed and spurious over the signal-to-noise ratio; rows as `identification_order`."""
    figure, ax = new_figure(width=8, height=4.2)
    level = np.array([row["level_db"] for row in rows])
    kinds = (
        ([row["found"] for row in rows], "identified", "o", COLOURS[0]),
        ([row["count"] - row["found"] for row in rows], "missed", "x", COLOURS[1]),
        ([row["false"] for row in rows], "spurious", "+", COLOURS[3]),
    )
    totals = []
    for values, label, marker, colour in kinds:
        shown = np.array(values) != 0
        totals.append(f"{sum(values)} {label}")
        if shown.any():
            ax.plot(level[shown], np.array(values)[shown], marker, color=colour, label=label)
    ax.set(xlabel="signal-to-noise ratio [dB]", ylabel="number of modes of a structure [-]")
    ax.set_title(f"modes of {len(rows)} structures: {', '.join(totals)}")
    ax.yaxis.set_major_locator(MaxNLocator(integer=True))
    if len(ax.lines) > 1:
        ax.legend(ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0))
    return figure


def study(outcome, data: Path | None = None) -> None:
    rows = [compared(seed) for seed in outcome.track(range(FIRST_SEED, FIRST_SEED + STRUCTURES), "structures")]
    total = {name: sum(row[name] for row in rows) for name in ("count", "found", "reported", "false")}
    recall, precision = total["found"] / total["count"], 1.0 - total["false"] / total["reported"]
    outcome.table("total", total)
    outcome.table("imperfect", [
        {k: row[k] for k in row if k != "seconds"} for row in rows if row["found"] < row["count"] or row["false"]
    ])  # fmt: skip
    outcome.check("recall", recall, 0.98, at_least=True)
    outcome.check("precision", precision, 0.98, at_least=True)
    outcome.say(
        f"{total['found']} of {total['count']} detectable modes are identified; {total['false']} of {total['reported']}"
        f" reported are spurious: recall {recall:.4f}, precision {precision:.4f}"
    )
    outcome.figure(
        "found",
        order_found(rows),
        "Modes missed and spurious modes, of each of the hundred structures.",
    )
