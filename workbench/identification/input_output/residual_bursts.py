"""Whether what modes leave of a record lies within a short part of it: lost or wrong samples, or a knock.

At the seam of what was lost the structure is in another state, which dies away as its modes do. A structure that is not
linear leaves more where it moves more, up to the cube of its motion; that is none.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from workbench.arrays import Floats
from workbench.identification.signal.data_quality import DATA, dropout_remark
from workbench.records.record import Record


@dataclass(frozen=True)
class BurstSettings:
    """Constants of the search for a burst in what modes leave."""

    parts: int = 50  # of a record
    samples: int = 10  # of each part at least
    together: int = 3  # parts, which hold
    share: float = 0.3  # of the energy of what is left at least, where noise has 0.06
    times: float = 2.5  # what they would hold by the motion there, at least


BURSTS = BurstSettings()


def burst_remarks(records: Sequence[Record], left: Sequence[Floats], noise: Floats) -> tuple[str, ...]:
    """A remark on each record in which outputs lost samples, or most of the residual lies within a short part.

    Args:
        records: as measured.
        left: of each, (n_samples, n_outputs), its last samples.
        noise: (n_outputs,) standard deviations of what is left.
    """
    found: list[str] = []
    for record, residual in zip(records, left, strict=True):
        lost = dropout_remark(record, "Modes, and what changes, are wrong by it; leave it out, or cut the record")
        found += lost or _burst(record, residual, noise)
    return tuple(found)


def _burst(record: Record, residual: Floats, noise: Floats) -> tuple[str, ...]:
    motion = record.outputs[:, -len(residual) :].T
    exact = noise < DATA.noise_free * motion.std(axis=0)
    if len(residual) < BURSTS.parts * BURSTS.samples or exact.all():
        return ()
    residual = residual / noise
    motion = (motion - motion.mean(axis=0)) / np.maximum(motion.std(axis=0), 1e-300)
    shares, moving = (np.array([np.vdot(p, p) for p in np.array_split(x, BURSTS.parts)]) for x in (residual, motion))
    together = np.ones(BURSTS.together)
    # noise of size in proportion to the motion, and what is not linear
    by_motion = [np.convolve(moving**k / max((moving**k).sum(), 1e-300), together, "valid") for k in (1, 3)]
    shares = np.convolve(shares / max(shares.sum(), 1e-300), together, "valid")
    at = int(np.argmax(shares))
    least = max(BURSTS.share, BURSTS.times * max(each[at] for each in by_motion))
    if shares[at] < least or by_motion[0].max() > BURSTS.share:  # after a blow the motion itself is one
        return ()
    edges = np.array_split(record.time[-len(residual) :], BURSTS.parts)
    begins, ends = edges[at][0], edges[at + BURSTS.together - 1][-1]
    return (
        f"in record {record.name!r} {100 * shares[at]:.0f} % of what the modes leave lies from {begins:.4g} to"
        f" {ends:.4g} s: lost or wrong samples, or a knock? It may look like noise of the inputs, or like"
        " modes that change; leave that part out",
    )
