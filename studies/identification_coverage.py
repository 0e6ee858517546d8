"""Are the standard errors true? Intervals and bands against the truth in five hundred draws of noise.

Two structures, struck or let go, noise 40 and 30 dB below the record, ITD then refinement: a hinged beam of five modes
seen by twelve sensors, whose eigenfunctions are known everywhere, and five sensors on four modes, two of them 3 %
apart and all with complex shapes. Errors are over the Cramér-Rao bound of the true modes, not over their own estimate.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.special import ndtri

from workbench.draw.identification import plot_bands
from workbench.identification.free_decay.ibrahim import stacked_delays
from workbench.identification.free_decay.refinement import cramer_rao_bound, refine
from workbench.identification.shapes.bands import eigenfunction_bands
from workbench.identification.shapes.eigenfunctions import BoundaryConditions
from workbench.identification.signal.modal_estimates import RefinedModes
from workbench.identification.signal.synthesis import free_decay, impulse_response_modes
from workbench.structure.member import Beam
from workbench.structure.modes import SampledModes

DRAWS, LEVEL = 500, 0.95
WIDTH = float(ndtri(0.5 + 0.5 * LEVEL))
LENGTH, SENSORS = 10.0, np.linspace(0.4, 9.6, 12)
X = np.linspace(0.0, LENGTH, 101)


def hinged_beam():
    beam = Beam(length=LENGTH, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged").modes(5)
    return replace(beam, damping=np.array([0.004, 0.003, 0.005, 0.004, 0.006]))


def close_pair() -> SampledModes:
    rng = np.random.default_rng(3)
    shapes = rng.standard_normal((5, 4)) * np.exp(1j * rng.uniform(0, 2, 4)) + 0.1j * rng.standard_normal((5, 4))
    omega = 2 * np.pi * np.array([3.0, 9.0, 9.27, 20.0])
    return SampledModes(omega, [0.01, 0.006, 0.012, 0.02], shapes, np.linspace(0, 1, 5))


def drawn(truth: SampledModes, *, sample_time: float, n_samples: int, level_db: float, seed: int):
    """A noisy record's refined modes, and the bound of the true ones."""
    clean = free_decay(truth, sample_time=sample_time, n_samples=n_samples)
    noise = float(np.sqrt((clean.outputs**2).mean()) * 10 ** (-level_db / 20))
    noisy = clean.outputs + noise * np.random.default_rng(seed).standard_normal(clean.outputs.shape)
    record = replace(clean, outputs=noisy)
    refined = refine(record, stacked_delays(record, n_modes=truth.n_modes, delays=60))
    return refined, cramer_rao_bound(truth, clean, noise_std=noise)


def errors(refined: RefinedModes, limit: RefinedModes) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Errors of frequency, damping and shape over their own standard error, and over the bound's."""
    truth, modes = limit.modes, refined.modes
    columns, k = np.arange(truth.n_modes), np.abs(modes.shapes).argmax(axis=0)
    shape = (modes.shapes / modes.shapes[k, columns] - truth.shapes / truth.shapes[k, columns]).real
    # The bound is of shapes relative to their largest entry, which has none; where that is another, alike by symmetry
    # or nearly, only the own error counts.
    same = limit.shape_std[k, columns] == 0.0
    ends = (np.arange(truth.shapes.shape[0])[:, None] != k) & same
    omega, zeta = modes.omega - truth.omega, modes.zeta - truth.zeta
    return {
        "frequency": (omega / refined.omega_std, omega / limit.omega_std),
        "damping": (zeta / refined.zeta_std, zeta / limit.zeta_std),
        "shape": (shape[ends] / refined.shape_std[ends], shape[ends] / limit.shape_std[ends]),
    }


def study(outcome, data: Path | None = None) -> None:
    beam = hinged_beam()
    decay = impulse_response_modes(beam, at=3.7, positions=SENSORS)
    setups = {
        "beam": (decay, {"sample_time": 0.2, "n_samples": 1000, "level_db": 40.0}),
        "close pair": (close_pair(), {"sample_time": 0.01, "n_samples": 500, "level_db": 30.0}),
    }
    ends = BoundaryConditions.of("beam", length=LENGTH, left="hinged", right="hinged")
    inside = {"point": [], "curve": []}
    for name, (truth, how) in setups.items():
        every: dict[str, list] = {"frequency": [], "damping": [], "shape": []}
        for seed in outcome.track(range(DRAWS), f"draws of {name}"):
            refined, limit = drawn(truth, seed=seed, **how)
            for what, pair in errors(refined, limit).items():
                every[what].append(pair)
            if name == "beam":
                bands = eigenfunction_bands(refined, X, length=LENGTH, mass_per_length=1.0, ends=ends, level=LEVEL)
                exact = beam.phi(X)
                off = np.abs(np.sign((bands.phi * exact).sum(axis=0)) * bands.phi - exact)[1:-1] / bands.std[1:-1]
                inside["point"].append(off < WIDTH)
                inside["curve"].append((off < bands.width).all(axis=0))
                if seed == 0:
                    outcome.figure(
                        "bands",
                        plot_bands(bands, beam, SENSORS),
                        "Eigenfunctions of a hinged beam from twelve sensors, noise 40 dB below the record: confidence"
                        " bands, and the exact curve.",
                    )
        report(outcome, name, every)
    shares = {"point": np.mean(inside["point"]), "curve": np.mean(inside["curve"])}
    outcome.table("bands", {what: float(share) for what, share in shares.items()})
    for what, share in shares.items():
        _within(outcome, f"bands of eigenfunctions, each {what}", float(share))
    outcome.say(
        f"bands of eigenfunctions hold {100 * shares['point']:.1f} % of the points and {100 * shares['curve']:.1f} % of"
        " the whole curves"
    )


def report(outcome, name: str, every: dict[str, list]) -> None:
    table = {}
    for what, pairs in every.items():
        own, over = np.concatenate([p[0] for p in pairs]), [p[1] for p in pairs]
        covered = float((np.abs(own) < WIDTH).mean())
        rms = np.sqrt(np.mean(np.concatenate(over) ** 2))
        table[what] = {"covered": covered, "error_over_bound": float(rms)}
        if what != "shape":
            table[what]["error_over_bound_by_mode"] = np.sqrt(np.mean(np.array(over) ** 2, axis=0))
            worst = float(table[what]["error_over_bound_by_mode"].max())
            outcome.check(f"{name}: rms error of {what} over the bound, worst mode", worst, 1.1)
        else:
            outcome.check(f"{name}: rms error of shapes over the bound", float(rms), 1.1)
        _within(outcome, f"{name}: intervals of {what}", covered)
    outcome.table(name, table)
    outcome.say(
        f"{name}: 95 % intervals hold "
        + ", ".join(f"{what} in {100 * row['covered']:.1f} %" for what, row in table.items())
        + f" of {DRAWS} draws; rms errors over the bound "
        + ", ".join(f"{row['error_over_bound']:.3f}" for row in table.values())
    )


def _within(outcome, name: str, share: float) -> None:
    outcome.check(f"{name}: share held, from below", share, 0.93, at_least=True)
    outcome.check(f"{name}: share held, from above", share, 0.97)
