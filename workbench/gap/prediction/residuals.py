"""The residual of the fit records: measured minus predicted, in units of the noise."""

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from threading import Lock
from typing import Any

import numpy as np

from workbench.arrays import Floats
from workbench.deadline import NEVER, Deadline
from workbench.gap.prediction.innovations import PROCESS_NOISE, Observer
from workbench.gap.prediction.unmodelled_force import ForceFilter, whiten
from workbench.records.record import Record
from workbench.rig.motion import Motion
from workbench.rig.readings import read
from workbench.rig.rig import Rig
from workbench.rig.simulate import is_stepped, move, steps_exactly
from workbench.structure.modes import Modes

# a record: of 45,000 requests in searches, 4,400 are of the last two, 140 of older ones
CACHED_MOTIONS = 2


def lead_of(record: Record, transient: float) -> int:
    """Number of samples in the first `transient` seconds of a record."""
    return min(round(transient / record.sample_time), record.n_samples - 1)


def scale_of(measured: Floats) -> Floats:
    """Standard deviation (n_outputs, 1) of each sensor's readings (n_outputs, n_samples); 1 where they are constant."""
    scale: Floats = measured.std(axis=1, keepdims=True)
    return np.where(scale > 0, scale, 1.0)


@dataclass(frozen=True, eq=False)
class FitData:
    """Records of a fit, never validation records, and how their residual is formed.

    Attributes:
        records: measured, all with the rig's inputs and outputs.
        noise: (n_outputs,) standard deviation of each sensor's noise, rounding included.
        substeps: of a sample, for nonlinear rigs.
        transient: seconds at the start of each record that are simulated but not counted, since the simulation starts
            from rest and the rig did not.
        whiteners: by record, the filter that whitens the response to random forces; empty for none. With an observer,
            nonlinear laws then act on the measured motion, since the simulated one lacks these forces.
        nuisance: (n_values, k) W: a residual r becomes r - W Wᵀ r, for nuisance parameters that are re-estimated with
            every candidate to first order; None for none.
        observer: estimates the rig's state from the records, for one-step-ahead predictions; None for simulations of
            whole records.
        guessed: names of the sensors without a stated noise.
        temperature: mean square of the residual that counts as noise (tempered likelihood); 1 for the stated noise.
        deadline: of the search; fits end with the best that they have when it is past.
    """

    records: tuple[Record, ...]
    noise: np.ndarray
    substeps: int = 4
    transient: float = 0.0
    whiteners: Mapping[str, ForceFilter] = field(default_factory=dict)
    nuisance: Floats | None = None
    observer: Observer | None = None
    guessed: frozenset[str] = frozenset()
    temperature: float = 1.0
    deadline: Deadline = NEVER
    _memory: OrderedDict[Any, tuple[Modes, Motion]] = field(default_factory=OrderedDict, repr=False, init=False)
    _lock: Lock = field(default_factory=Lock, repr=False, init=False)

    @property
    def n_values(self) -> int:
        return sum(record.outputs.size for record in self.counted)

    @property
    def sample_times(self) -> tuple[float, ...]:
        """Those of the records, s, each once."""
        return tuple(dict.fromkeys(record.sample_time for record in self.records))

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

    def tempered(self, temperature: float) -> "FitData":
        """The same residual over the root of a mean square that counts as noise."""
        return replace(self, temperature=temperature)

    def through(self, whitener: ForceFilter, observer: Observer) -> "FitData":
        """The same residual, whitened for a random force."""
        return replace(self, whiteners={record.name: whitener for record in self.records}, observer=observer)

    def with_input_noise(self, whiteners: Mapping[str, ForceFilter]) -> "FitData":
        """The same residual, whitened for input noise."""
        return replace(self, whiteners=whiteners)

    def with_nuisance(self, sensitivity: np.ndarray) -> "FitData":
        """The same residual, minimised over nuisance parameters with normal priors to first order.

        Its sum of squares is min over δ of |r + S δ|² + |δ|²: the new residual is (I - S (Sᵀ S + I)⁻¹ Sᵀ)^½ r, with
        the sensitivity S (n_values, n_parameters), each column times the prior standard deviation of its parameter.
        """
        if not sensitivity.size:
            return replace(self, nuisance=None)
        _, sizes, vectors = np.linalg.svd(_triangle(sensitivity))
        root = np.sqrt(1.0 + sizes**2)
        return replace(self, nuisance=sensitivity @ (vectors[: root.size].T / np.sqrt(root * (root + 1.0))))

    def one_step_ahead(self, rig: Rig, process_noise: float = PROCESS_NOISE) -> "FitData":
        """The residual of one-step-ahead predictions, with a steady-state Kalman filter of this rig.

        process_noise: rms of process noise forces, as a share of the inputs: the less, the lower the observer gain.
        """
        if self.observer is not None:  # innovations with a random force are one-step-ahead errors already
            return replace(self, nuisance=None)
        observer = Observer.of(rig, self.noise, self.force_rms, self.sample_times, process_noise=process_noise)
        return replace(self, observer=observer, whiteners={}, nuisance=None)

    @cached_property
    def force_rms(self) -> float:
        """Root mean square of the nonzero inputs, N."""
        squares = [row[row != 0] ** 2 for record in self.counted for row in record.inputs if np.any(row)]
        return float(np.sqrt(np.mean(np.concatenate(squares)))) if squares else 1.0

    @cached_property
    def counted(self) -> tuple[Record, ...]:
        """The records without the samples of `transient` at their start."""
        if self.transient == 0:
            return self.records
        return tuple(record.between(record.time[lead_of(record, self.transient)]) for record in self.records)

    def motions(self, rig: Rig) -> tuple[Motion, ...]:
        """The rig's motion on each record; the last few are cached, since a sensor's fault does not change it."""
        return tuple(self._motion(rig.in_record(record.name), record) for record in self.records)

    def _motion(self, rig: Rig, record: Record) -> Motion:
        key = (id(record), id(rig.modes), rig.actuators, rig.elements, rig.stiffness_rate)
        with self._lock:
            if key in self._memory:
                self._memory.move_to_end(key)
                return self._memory[key][1]
        sample_time, hold = record.sample_time, record.input_hold
        whole = move(rig, record.inputs, sample_time=sample_time, substeps=self.substeps, input_hold=hold)
        motion = whole.after(lead_of(record, self.transient))
        with self._lock:
            self._memory[key] = (rig.modes, motion)
            while len(self._memory) > CACHED_MOTIONS * len(self.records):
                self._memory.popitem(last=False)
        return motion

    def predictions(self, rig: Rig) -> tuple[np.ndarray, ...]:
        """Predicted outputs (n_outputs, n_samples) of each record."""
        each = zip(self.counted, self.motions(rig), strict=True)
        return tuple(read(rig.in_record(record.name), motion) for record, motion in each)

    def residual(self, rig: Rig) -> np.ndarray:
        """(measured - predicted) / noise, or innovations of unit variance, of all records end to end: (n_values,)."""
        residual = self._residual(rig)
        self.project_out(residual)
        return residual if self.temperature == 1.0 else residual / np.sqrt(self.temperature)

    def project_out(self, residuals: np.ndarray) -> None:
        """Minimise residuals (..., n_values) of `unprojected` over the nuisance parameters, in place."""
        if self.nuisance is not None:
            residuals -= (residuals @ self.nuisance) @ self.nuisance.T

    @cached_property
    def unprojected(self) -> "FitData":
        """The same residual without nuisance parameters."""
        return self if self.nuisance is None else replace(self, nuisance=None)

    def _residual(self, rig: Rig) -> np.ndarray:
        """The residual (n_values,) before projection and tempering."""
        observer = self.observer
        if self.whiteners:
            each = zip(self.records, self.residual_on_measured_motion(rig, observer), strict=True)
            return np.concatenate([whiten(self.whiteners[record.name], left).ravel() for record, left in each])
        if observer is None:
            return np.concatenate([(r / self.noise[:, None]).ravel() for r in self.differences(rig)])
        on_samples = all(record.input_hold != "band-limited" for record in self.records)
        if is_stepped(rig) or (on_samples and steps_exactly(rig)):
            substeps, first = self.substeps if is_stepped(rig) else 1, self._from_the_first_sample
            rigs = [(rig.in_record(record.name), record) for record in self.records]
            # a sensor's fault does not change the motion, which may be cached
            ahead = [observer.innovations(r, record, substeps, partial(first._motion, r, record)) for r, record in rigs]
        else:
            whole = zip(self.records, self._from_the_first_sample.differences(rig), strict=True)
            by_record = [(rig.in_record(record.name), left, record.sample_time) for record, left in whole]
            ahead = [observer.innovations_of_linear(*each, self.substeps) for each in by_record]
        each_ahead = zip(self.records, ahead, strict=True)
        return np.concatenate([errors[:, lead_of(record, self.transient) :].ravel() for record, errors in each_ahead])

    @property
    def _from_the_first_sample(self) -> "FitData":
        return self._with_its_lead if self.transient else self  # cached, a reference to itself would outlive the search

    @cached_property
    def _with_its_lead(self) -> "FitData":
        return replace(self, transient=0.0)

    @property
    def mixes_sensors(self) -> bool:
        """Whether a value of the residual depends on several sensors."""
        return bool(self.whiteners) or self.observer is not None or self.nuisance is not None

    @cached_property
    def sources(self) -> np.ndarray:
        """Index of the sensor of each value of the residual, (n_values,)."""
        return np.concatenate([np.repeat(np.arange(len(r.outputs)), r.n_samples) for r in self.counted])

    def residual_on_measured_motion(self, rig: Rig, observer: Observer | None) -> list[np.ndarray]:
        """Measured minus predicted (n_outputs, n_samples) of each record, in the sensors' units.

        With an observer, nonlinear laws act on the measured motion.
        """
        if observer is None or not is_stepped(rig) or rig.stiffness_rate:
            return self.differences(rig)
        each = [(rig.in_record(record.name), record) for record in self.records]
        whole = [observer.residual_on_measured_motion(own, record, self.substeps) for own, record in each]
        return [left[:, lead_of(r, self.transient) :] for left, r in zip(whole, self.records, strict=True)]

    def differences(self, rig: Rig) -> list[np.ndarray]:
        """Measured minus simulated outputs (n_outputs, n_samples) of each record, in the sensors' units."""
        both = zip(self.counted, self.predictions(rig), strict=True)
        return [record.outputs - prediction for record, prediction in both]

    def by_channel(self, residual: np.ndarray) -> np.ndarray:
        """Mean square of a residual by record and channel: (n_records, n_outputs)."""
        ends = np.cumsum([record.outputs.size for record in self.counted])[:-1]
        each = zip(np.split(residual, ends), self.counted, strict=True)
        with np.errstate(over="ignore"):  # the simulation may diverge
            return np.array([(own.reshape(record.outputs.shape) ** 2).mean(axis=1) for own, record in each])


def _triangle(matrix: Floats) -> Floats:
    """R (n_columns, n_columns) of a tall matrix = Q R, by blocks of rows that fit a processor's cache."""
    n_columns = matrix.shape[1]
    n_rows = 4 * n_columns
    whole = len(matrix) // n_rows * n_rows
    blocks: Any = np.linalg.qr(matrix[:whole].reshape(-1, n_rows, n_columns), mode="r")
    triangle: Any = np.linalg.qr(np.concatenate([*blocks, matrix[whole:]]), mode="r")
    return np.asarray(triangle)
