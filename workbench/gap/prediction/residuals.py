"""The residual of the fit records: measured less predicted, in units of the noise."""

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from threading import Lock
from typing import Any

import numpy as np

from workbench.arrays import Floats
from workbench.deadline import NEVER, Deadline
from workbench.gap.prediction.innovations import LOOSE, Observer
from workbench.gap.prediction.unmodelled_force import ForceFilter, whiten
from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.rig.simulate import Motion, is_stepped, move, read, steps_exactly
from workbench.structure.modes import Modes

REMEMBERED = 2  # motions of a record: of 45,000 that searches ask for, 4,400 are the last or the one before, 140 older


def lead_of(record: Record, settle: float) -> int:
    """Samples at the start of a record that last so many seconds."""
    return min(round(settle / record.sample_time), record.n_samples - 1)


@dataclass(frozen=True, eq=False)
class FitData:
    """Records that a fit may see. Validation records never become part of one.

    Attributes:
        records: measured, all with the rig's inputs and outputs.
        noise: (n_outputs,) standard deviation of each sensor's noise, rounding included.
        substeps: of a sample, for rigs that are not linear.
        settle: seconds at the start of each record that are simulated but not counted, while the rig settles from the
            rest that the simulation assumes to the motion it really had.
        whiteners: filter of random forces on the structure, by record, through which its residual is seen; none where
            there are none. With an observer, laws then act on the motion that was measured: that of the rig has no such
            force.
        given_way: (n_values, k) W: a residual r becomes r - W Wᵀ r, for uncertain parameters that are re-estimated
            with every candidate to first order; None where none are.
        observer: of the rig's state by the records, so that its predictions are of one sample ahead; None where
            they are of the whole record.
        guessed: names of the sensors whose noise nobody stated.
        heat: mean square of a residual that counts as noise, for now.
        deadline: of the search that these records are for; fits end with the best that they have when it is past.
    """

    records: tuple[Record, ...]
    noise: np.ndarray
    substeps: int = 4
    settle: float = 0.0
    whiteners: Mapping[str, ForceFilter] = field(default_factory=dict)
    given_way: Floats | None = None
    observer: Observer | None = None
    guessed: frozenset[str] = frozenset()
    heat: float = 1.0
    deadline: Deadline = NEVER
    _memory: OrderedDict[Any, tuple[Modes, Motion]] = field(default_factory=OrderedDict, repr=False, init=False)
    _lock: Lock = field(default_factory=Lock, repr=False, init=False)

    @property
    def n_values(self) -> int:
        """Number of measured values."""
        return sum(record.outputs.size for record in self.counted)

    def only(self, names: tuple[str, ...]) -> "FitData":
        """The same residual on some of the records."""
        return replace(self, records=tuple(r for r in self.records if r.name in names))

    def of_outputs(self, names: tuple[str, ...]) -> "FitData":
        """The same residual on some of the outputs."""
        kept = [self.records[0].output_names.index(name) for name in names]
        return replace(self, records=tuple(r.select_outputs(names) for r in self.records), noise=self.noise[kept])

    def stepped(self, substeps: int) -> "FitData":
        """The same residual with other substeps."""
        return replace(self, substeps=substeps)

    def finely(self, substeps: int) -> "FitData":
        """The same residual with at least so many substeps."""
        return self.stepped(max(substeps, self.substeps))

    def with_noise(self, noise: np.ndarray) -> "FitData":
        """The same residual with other standard deviations of the sensors' noise (n_outputs,)."""
        return replace(self, noise=noise)

    def tempered(self, heat: float) -> "FitData":
        """The same residual with that mean square as noise."""
        return replace(self, heat=heat)

    def through(self, whitener: ForceFilter, observer: Observer) -> "FitData":
        """The same residual beside a random force."""
        return replace(self, whiteners={record.name: whitener for record in self.records}, observer=observer)

    def beside_inputs(self, whiteners: Mapping[str, ForceFilter]) -> "FitData":
        """The same residual beside noise of the logged inputs."""
        return replace(self, whiteners=whiteners)

    def giving_way(self, sensitivity: np.ndarray) -> "FitData":
        """The same measure with residuals as small as uncertain parameters make them, to first order.

        Their squares sum to min over δ of |r + S δ|² + |δ|²: that of r times the root of I - S (Sᵀ S + I)⁻¹ Sᵀ.

        Args:
            sensitivity: (n_values, n_parameters) S, in prior standard deviations of each.
        """
        if not sensitivity.size:
            return replace(self, given_way=None)
        _, sizes, turned = np.linalg.svd(_triangle(sensitivity))
        root = np.sqrt(1.0 + sizes**2)
        return replace(self, given_way=sensitivity @ (turned[: root.size].T / np.sqrt(root * (root + 1.0))))

    def one_step_ahead(self, rig: Rig, loose: float = LOOSE) -> "FitData":
        """The same residual on predictions one sample ahead, by the observer gain of this rig.

        Args:
            loose: random forces on it, as a share of the inputs: the less, the more it goes its own way.
        """
        if self.observer is not None:  # innovations beside a random force are errors one sample ahead as they are
            return replace(self, given_way=None)
        observer = Observer.of(rig, self.noise, self.force_rms, self.records[0].sample_time, loose=loose)
        return replace(self, observer=observer, whiteners={}, given_way=None)

    @cached_property
    def force_rms(self) -> float:
        """Root mean square of the inputs that are not at rest, N."""
        squares = [row[row != 0] ** 2 for record in self.counted for row in record.inputs if np.any(row)]
        return float(np.sqrt(np.mean(np.concatenate(squares)))) if squares else 1.0

    @cached_property
    def counted(self) -> tuple[Record, ...]:
        """The records without their lead."""
        if self.settle == 0:
            return self.records
        return tuple(record.between(record.time[lead_of(record, self.settle)]) for record in self.records)

    def motions(self, rig: Rig) -> tuple[Motion, ...]:
        """The rig's motion on each record; the last few are remembered, since a sensor's fault does not change it."""
        return tuple(self._motion(rig.in_record(record.name), record) for record in self.records)

    def _motion(self, rig: Rig, record: Record) -> Motion:
        key = (id(record), id(rig.modes), rig.actuators, rig.elements, rig.stiffness_rate)
        with self._lock:
            if key in self._memory:
                self._memory.move_to_end(key)
                return self._memory[key][1]
        motion = move(
            rig,
            record.inputs,
            sample_time=record.sample_time,
            substeps=self.substeps,
            input_hold=record.input_hold,
        ).after(lead_of(record, self.settle))
        with self._lock:
            self._memory[key] = (rig.modes, motion)
            while len(self._memory) > REMEMBERED * len(self.records):
                self._memory.popitem(last=False)
        return motion

    def predictions(self, rig: Rig) -> tuple[np.ndarray, ...]:
        """(n_outputs, n_samples) a record."""
        return tuple(
            read(rig.in_record(record.name), motion, sample_time=record.sample_time)
            for record, motion in zip(self.counted, self.motions(rig), strict=True)
        )

    def residual(self, rig: Rig) -> np.ndarray:
        """(measured - predicted) / noise, or their innovations of unit variance, all records joined: (n_values,)."""
        residual = self._left(rig)
        self.give_way(residual)
        return residual if self.heat == 1.0 else residual / np.sqrt(self.heat)

    def give_way(self, residuals: np.ndarray) -> None:
        """Let residuals (..., n_values) of `standing` become as small as uncertain parameters make them, in place."""
        if self.given_way is not None:
            residuals -= (residuals @ self.given_way) @ self.given_way.T

    @cached_property
    def standing(self) -> "FitData":
        """The same residual without uncertain parameters."""
        return self if self.given_way is None else replace(self, given_way=None)

    def _left(self, rig: Rig) -> np.ndarray:
        observer = self.observer
        if self.whiteners:
            each = zip(self.records, self.left_beside(rig, observer), strict=True)
            return np.concatenate([whiten(self.whiteners[record.name], left).ravel() for record, left in each])
        if observer is None:
            return np.concatenate([(r / self.noise[:, None]).ravel() for r in self.differences(rig)])
        on_samples = all(record.input_hold != "band-limited" for record in self.records)
        if is_stepped(rig) or (on_samples and steps_exactly(rig)):
            substeps, first = self.substeps if is_stepped(rig) else 1, self._from_the_first_sample
            rigs = [(rig.in_record(record.name), record) for record in self.records]
            # a sensor's fault does not change the motion, which may be known
            ahead = [observer.errors(r, record, substeps, partial(first._motion, r, record)) for r, record in rigs]
        else:
            whole = zip(self.records, self._from_the_first_sample.differences(rig), strict=True)
            ahead = [
                observer.errors_of_linear(rig.in_record(record.name), left, record.sample_time, self.substeps)
                for record, left in whole
            ]
        each_ahead = zip(self.records, ahead, strict=True)
        return np.concatenate([errors[:, lead_of(record, self.settle) :].ravel() for record, errors in each_ahead])

    @property
    def _from_the_first_sample(self) -> "FitData":
        return self._with_its_lead if self.settle else self

    @cached_property
    def _with_its_lead(self) -> "FitData":
        return replace(self, settle=0.0)

    @property
    def mixes_sensors(self) -> bool:
        """Whether values of the residual are of several sensors at once."""
        return bool(self.whiteners) or self.observer is not None or self.given_way is not None

    @cached_property
    def sources(self) -> np.ndarray:
        """The number of the sensor that each value of the residual is of, (n_values,)."""
        return np.concatenate([np.repeat(np.arange(len(r.outputs)), r.n_samples) for r in self.counted])

    def left_beside(self, rig: Rig, observer: Observer | None) -> list[np.ndarray]:
        """Measured less predicted (n_outputs, n_samples) a record; by laws on the measured motion with an observer."""
        if observer is None or not is_stepped(rig) or rig.stiffness_rate:
            return self.differences(rig)
        return [
            observer.left(rig.in_record(record.name), record, self.substeps)[:, lead_of(record, self.settle) :]
            for record in self.records
        ]

    def differences(self, rig: Rig) -> list[np.ndarray]:
        """Measured less predicted on whole records (n_outputs, n_samples), one per record, in the sensors' units."""
        both = zip(self.counted, self.predictions(rig), strict=True)
        return [record.outputs - prediction for record, prediction in both]

    def by_channel(self, residual: np.ndarray) -> np.ndarray:
        """Mean square of a residual by record and channel: (n_records, n_outputs)."""
        rows, start = [], 0
        for record in self.counted:
            size = record.outputs.size
            with np.errstate(over="ignore"):  # of a motion that runs away
                rows.append((residual[start : start + size].reshape(record.outputs.shape) ** 2).mean(axis=1))
            start += size
        return np.array(rows)


def _triangle(matrix: Floats) -> Floats:
    """R of a tall matrix = Q R, by blocks of rows that stay in a processor's cache."""
    n_columns = matrix.shape[1]
    n_rows = 4 * n_columns
    whole = len(matrix) // n_rows * n_rows
    blocks: Any = np.linalg.qr(matrix[:whole].reshape(-1, n_rows, n_columns), mode="r")
    triangle: Any = np.linalg.qr(np.concatenate([*blocks, matrix[whole:]]), mode="r")
    return np.asarray(triangle)
