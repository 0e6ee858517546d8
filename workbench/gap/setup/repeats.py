"""Checks for repeated names, records and channels, which need no model."""

from collections.abc import Sequence
from functools import partial
from itertools import combinations

import numpy as np

from workbench.gap.setup.comparison import predicted_by
from workbench.gap.setup.corrections import SetupFault, without_output, without_record
from workbench.records.record import Record
from workbench.rig.rig import Rig


def check_names(records: Sequence[Record]) -> None:
    """Refuse records with the same name, since results are stated by it.

    Raises:
        ValueError: for the first such name.
    """
    names = [record.name for record in records]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(
                f"{names.count(name)} records are called {name!r}, and results are by record: give each a name of its"
                " own, such as replace(record, name=...)"
            )


def check_disjoint(records: Sequence[Record], validation: Sequence[Record]) -> None:
    """Refuse validation records that repeat a record to be fitted.

    Raises:
        ValueError: for the first such pair.
    """
    for held_out in validation:
        for record in records:
            if _same(held_out, record):
                raise ValueError(
                    f"validation record {held_out.name!r} repeats the fit record {record.name!r}, so it validates"
                    " nothing; keep another record for validation, or none"
                )


def repeated(records: Sequence[Record]) -> list[SetupFault]:
    """Faults of records that hold the same samples as another; the later one is left out."""
    faults, repeats = [], set()
    for i, j in combinations(range(len(records)), 2):
        if j not in repeats and i not in repeats and _same(records[i], records[j]):
            repeats.add(j)
            first, second = records[i].name, records[j].name
            faults.append(
                SetupFault(
                    "repeated record",
                    f"The records {first} and {second} hold the same samples: leave {second} out.",
                    np.nan,
                    partial(without_record, second),
                )
            )
    return faults


def copied(rig: Rig, records: Sequence[Record]) -> list[SetupFault]:
    """Faults of outputs that copy another: the noise of two sensors differs, so equal samples are of one.

    The output that agrees less with the model is the copy.
    """
    faults: list[SetupFault] = []
    copies: set[int] = set()
    for i, j in combinations(range(len(rig.sensors)), 2):
        one, other = rig.sensors[i], rig.sensors[j]
        may_agree = (one.at, one.quantity) == (other.at, other.quantity) and not one.noise_std + other.noise_std
        same = all(np.array_equal(r.outputs[i], r.outputs[j]) for r in records)
        if not same or may_agree or {i, j} & copies or not any(np.ptp(r.outputs[i]) for r in records):
            continue
        errors = [np.zeros(2)]
        for record in records:
            predicted = predicted_by(rig, record)
            errors.append(np.array([((record.outputs[k] - predicted[k]) ** 2).mean() for k in (i, j)]))
        error_i, error_j = np.sum(errors, axis=0)
        copy = j if error_i <= error_j else i
        copies.add(copy)
        kept = i + j - copy
        faults.append(
            SetupFault(
                "copied channel",
                f"The outputs {one.name} and {other.name} hold the same samples, and the model agrees better with"
                f" {rig.sensors[kept].name}: measure {rig.sensors[copy].name} again, or leave it out.",
                np.nan,
                partial(without_output, rig.sensors[copy].name),
            )
        )
    return faults


def _same(one: Record, other: Record) -> bool:
    """Whether one record repeats the other, or the beginning of it."""
    n = min(one.n_samples, other.n_samples)
    if n < 2 or one.outputs.shape[0] != other.outputs.shape[0] or one.n_inputs != other.n_inputs:
        return False
    moves = bool(np.ptp(one.outputs[:, :n], axis=1).any())
    return moves and all(
        np.array_equal(getattr(one, part)[:, :n], getattr(other, part)[:, :n]) for part in ("outputs", "inputs")
    )
