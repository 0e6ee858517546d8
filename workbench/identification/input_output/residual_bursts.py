"""Detection of a burst in the residual of a record: lost or wrong samples, or an impact.

Where samples are lost, the state of the structure jumps, and the residual decays as its modes do. The residual of a
nonlinear structure grows with its motion, up to the cube; that is no burst.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from workbench.arrays import Floats
from workbench.identification.signal.data_quality import DATA, dropout_remark
from workbench.records.record import Record


@dataclass(frozen=True)
class BurstSettings:
    """Constants of the search for a burst in the residual."""

    parts: int = 50  # into which a record is divided
    samples: int = 10  # of each part at least
    together: int = 3  # consecutive parts that hold the burst
    share: float = 0.3  # of the residual energy in these at least, where noise has 0.06
    times: float = 2.5  # the share expected from the motion in these, at least


BURSTS = BurstSettings()


def burst_remarks(records: Sequence[Record], residuals: Sequence[Floats], noise: Floats) -> tuple[str, ...]:
    """A remark on each record whose outputs lost samples, or most of whose residual lies within a short part.

    Args:
        records: as measured.
        residuals: of each record, (n_samples, n_outputs), aligned with its last samples.
        noise: (n_outputs,) standard deviations of the residual.
    """
    remarks: list[str] = []
    for record, residual in zip(records, residuals, strict=True):
        dropouts = dropout_remark(record, "Modes and changes are wrong by it; leave it out, or cut the record")
        remarks += dropouts or _burst(record, residual, noise)
    return tuple(remarks)


def _burst(record: Record, residual: Floats, noise: Floats) -> tuple[str, ...]:
    motion = record.outputs[:, -len(residual) :].T
    noise_free = noise < DATA.noise_free * motion.std(axis=0)
    if len(residual) < BURSTS.parts * BURSTS.samples or noise_free.all():
        return ()
    residual = residual / noise
    motion = (motion - motion.mean(axis=0)) / np.maximum(motion.std(axis=0), 1e-300)
    shares, moving = (np.array([np.vdot(p, p) for p in np.array_split(x, BURSTS.parts)]) for x in (residual, motion))
    together = np.ones(BURSTS.together)
    # noise in proportion to the motion, and cubic distortion
    expected = [np.convolve(moving**k / max((moving**k).sum(), 1e-300), together, "valid") for k in (1, 3)]
    shares = np.convolve(shares / max(shares.sum(), 1e-300), together, "valid")
    first = int(np.argmax(shares))
    least = max(BURSTS.share, BURSTS.times * max(each[first] for each in expected))
    if shares[first] < least or expected[0].max() > BURSTS.share:  # after an impact the motion itself is a burst
        return ()
    edges = np.array_split(record.time[-len(residual) :], BURSTS.parts)
    begins, ends = edges[first][0], edges[first + BURSTS.together - 1][-1]
    return (
        f"in record {record.name!r} {100 * shares[first]:.0f} % of the residual energy lies from {begins:.4g} to"
        f" {ends:.4g} s: lost or wrong samples, or an unmeasured impact? It may look like noise of the inputs, or like"
        " modes that change; leave that part out",
    )
