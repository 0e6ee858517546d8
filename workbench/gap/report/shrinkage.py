"""How far the gap shrinks on records kept out of the fit: the only place that opens validation records."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.rig.simulate import predict

DRAWS = 400


@dataclass(frozen=True, eq=False)
class Shrinkage:
    """The gap of validation records before and after a correction.

    Attributes:
        before, after, floor: by record name; the gap of the case format.
        share: of the closable gap closed, by record name: 1 - sqrt(after² - floor²) / sqrt(before² - floor²).
        overall: the same over all records together.
        ci95: its 95 % interval by block bootstrap.
    """

    before: dict[str, float]
    after: dict[str, float]
    floor: dict[str, float]
    share: dict[str, float]
    overall: float
    ci95: tuple[float, float]


def measure(nominal: Rig, corrected: Rig, records: Sequence[Record], *, settle: float = 0.0) -> Shrinkage | None:
    """Gaps of both rigs on validation records, with the interval from resampled blocks; None without records.

    Blocks are three decay times of the slowest elastic mode long, or a twentieth of a record where that is shorter
    than a tenth of it, so that what is resampled is nearly independent.
    """
    if not records:
        return None
    before, after, floor, blocks = {}, {}, {}, []
    for record in records:
        lead = round(settle / record.sample_time)
        measured = record.outputs[:, lead:]
        scale = scale_of(measured)
        predicted = [predict(rig, record)[:, lead:] for rig in (nominal, corrected)]
        errors = [((measured - prediction) / scale) ** 2 for prediction in predicted]
        noise = np.array([s.noise_std for s in nominal.sensors])[:, None] / scale
        before[record.name], after[record.name] = (float(np.sqrt(e.mean())) for e in errors)
        floor[record.name] = float(np.sqrt((noise**2).mean()))
        length = _block_length(nominal, record)
        for start in range(0, measured.shape[1], length):
            piece = slice(start, start + length)
            blocks.append([errors[0][:, piece].mean(), errors[1][:, piece].mean(), (noise**2).mean()])
    table = np.array(blocks)
    rng = np.random.default_rng(0)
    draws = [_closed(*table[rng.integers(0, len(table), len(table))].mean(axis=0)) for _ in range(DRAWS)]
    return Shrinkage(
        before=before,
        after=after,
        floor=floor,
        share={n: _closed(before[n] ** 2, after[n] ** 2, floor[n] ** 2) for n in before},
        overall=_closed(*table.mean(axis=0)),
        ci95=(float(np.quantile(draws, 0.025)), float(np.quantile(draws, 0.975))),
    )


def _closed(before: float, after: float, floor: float) -> float:
    if before <= floor * 1.01:
        return 0.0
    return float(1.0 - np.sqrt(max(after - floor, 0.0) / (before - floor)))


def _block_length(rig: Rig, record: Record) -> int:
    rates = (rig.modes.zeta * rig.modes.omega)[rig.modes.omega > 0]
    memory = 3.0 / max(rates.min(), 1e-12) / record.sample_time if rates.size else record.n_samples
    return int(np.clip(memory, record.n_samples // 20, max(record.n_samples // 8, 1)))


def scale_of(measured: np.ndarray) -> np.ndarray:
    """What each sensor's readings (n_outputs, n_samples) count by: their standard deviation; 1 at rest."""
    scale = measured.std(axis=1, keepdims=True)
    return np.where(scale > 0, scale, 1.0)
