"""How much of a gap is a linear reply to the inputs: what resonators near the structure's own make of it."""

from collections.abc import Sequence

import numpy as np

from workbench.gap.prediction.residuals import FitData
from workbench.records.record import Record
from workbench.rig.linear import held_response, modal_motion, modal_poles, straight_response
from workbench.rig.rig import Rig
from workbench.rig.simulate import participation_of

# A gap of lightly damped modes outlives any segment of a record, so that coherence by averaged spectra would miss most
# of it; a change of a mode's frequency, damping or gain lies nearly in the span of resonators close to the mode.
SPREAD = (0.85, 0.93, 0.97, 0.99, 1.0, 1.01, 1.03, 1.07, 1.15)
MOST_MODES = 6
RIDGES = np.logspace(-9, -1, 9)


def linear_share(rig: Rig, data: FitData, residuals: Sequence[np.ndarray], shares: np.ndarray) -> float:
    """Share of the residuals' power that one linear reply to the inputs explains in all records.

    The reply is learnt on all records but one and judged on that one, each in turn: a narrow-band residual has so few
    degrees of freedom that resonators fitted to it would explain it whatever made it. A lone record is halved.

    Args:
        rig: nominal.
        data: with the records.
        residuals: (n_outputs, n_samples) a record, measured less predicted.
        shares: (n_modes,) of the gap around each mode; the few largest are looked at.
    """
    chosen = [int(r) for r in np.argsort(-shares)[:MOST_MODES] if shares[r] > 0]
    sizes = np.sqrt(np.mean([record.outputs.var(axis=1) for record in data.counted], axis=0))[:, None]
    pieces = []
    for record, residual in zip(data.counted, residuals, strict=True):
        # a record's level is taken from both sides, so that every record counts alike and the reply stays the same
        level = np.sqrt(np.mean((record.outputs / sizes) ** 2))
        pieces.append((_replies(rig, chosen, record) / level, residual / sizes / level))
    if len(pieces) == 1:
        half = pieces[0][0].shape[1] // 2
        pieces = [(x[:, part], y[:, part]) for x, y in pieces for part in (slice(half), slice(half, None))]
    scale = np.sqrt(sum((x**2).sum(axis=1) for x, _ in pieces))
    pieces = [(x[scale > 0] / scale[scale > 0, None], y) for x, y in pieces]
    normal, right = [x @ x.T for x, _ in pieces], [x @ y.T for x, y in pieces]
    left = np.zeros(RIDGES.size)
    for (x, y), own_normal, own_right in zip(pieces, normal, right, strict=True):
        strengths, axes = np.linalg.eigh(sum(normal) - own_normal)
        target, shown = axes.T @ (sum(right) - own_right), axes.T @ x
        for i, ridge in enumerate(RIDGES * strengths[-1]):
            weights = target / (np.maximum(strengths, 0.0) + ridge)[:, None]
            left[i] += min(float(((y - weights.T @ shown) ** 2).sum()), float((y**2).sum()))
    return float(np.clip(1.0 - left.min() / sum(float((y**2).sum()) for _, y in pieces), 0.0, 1.0))


def _replies(rig: Rig, chosen: Sequence[int], record: Record) -> np.ndarray:
    """What each mode may reply with, (n_replies, n_samples).

    A mode under each input by itself, where its participation has changed; resonators beside it under its modal force,
    where its frequency or damping has.
    """
    if not chosen:
        return record.inputs
    slowest = 2.0 * np.pi / (record.n_samples * record.sample_time)
    alone, acting = np.eye(len(rig.actuators)), participation_of(rig)
    omega = np.maximum(rig.modes.omega[chosen], slowest)[:, None] * np.r_[np.ones(len(alone)), SPREAD]
    damping = np.maximum(np.diag(rig.modes.damping)[chosen, None], 1e-3 * omega)
    driven = np.array([row for r in chosen for row in (*alone, *[acting[r]] * len(SPREAD))])
    resonators = modal_poles(omega.ravel(), np.diag(damping.ravel()))
    response_to = held_response if record.input_hold == "zero" else straight_response
    response, _ = response_to(resonators, record.inputs, driven, record.sample_time)
    return np.concatenate([record.inputs, *modal_motion(resonators, response)])
