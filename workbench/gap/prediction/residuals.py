"""The fit records as a yardstick: how far a rig's prediction stands from them, in units of the noise.

The noise of each sensor is found from what a fitted model leaves of several records.
"""

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from threading import Lock
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from workbench.arrays import Floats
from workbench.gap.prediction.innovations import LOOSE, Follower
from workbench.gap.prediction.unmodelled_force import ForceFilter, whiten
from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.rig.simulate import Motion, is_stepped, move, read, steps_exactly
from workbench.structure.modes import Modes

REMEMBERED = 24
# Of the noise:
LINES = 20  # of the periodogram in a band, so that its mean scatters by a quarter
REACH, QUIET = 5, 0.25  # bands to either side, and their quantile: modes leave a quarter of them free of peaks
LOWER = 0.67  # deviations by which that quantile lies below the mean
ALIKE, SAME = 1.3, 1.1  # times the power of the quietest record; what differs from it by chance alone
LOUD = 0.5  # of the mean square: peaks that hold less are not worth leaving out


@dataclass(frozen=True, eq=False)
class FitData:
    """Records that a fit may see. Validation records never become part of one.

    Attributes:
        records: measured, all with the rig's inputs and outputs.
        noise: (n_outputs,) standard deviation of each sensor's noise, rounding included.
        substeps: of a sample, for rigs that are not linear.
        lead: samples at the start of each record that are simulated but not counted, while the rig settles from the
            rest that the simulation assumes to the motion it really had.
        whiteners: filter of random forces on the structure, by record, through which its residual is seen; none where
            there are none. With a follower, laws then act on the motion that was measured: that of the rig has no such
            force.
        given_way: (n_values, k) orthonormal directions and (k,) shares by which residuals give way along them, for
            uncertain parameters that are re-estimated with every candidate to first order; None where none are.
        follower: what holds the rig beside the records, so that its predictions are of one sample ahead; None where
            they are of the whole record.
        heat: mean square of a residual that counts as noise, for now.
    """

    records: tuple[Record, ...]
    noise: np.ndarray
    substeps: int = 4
    lead: int = 0
    whiteners: Mapping[str, ForceFilter] = field(default_factory=dict)
    given_way: tuple[np.ndarray, np.ndarray] | None = None
    follower: Follower | None = None
    heat: float = 1.0
    _memory: OrderedDict[Any, tuple[Modes, Motion]] = field(default_factory=OrderedDict, repr=False, init=False)
    _lock: Lock = field(default_factory=Lock, repr=False, init=False)

    @property
    def n_values(self) -> int:
        """Number of measured values."""
        return sum(record.outputs.size for record in self.counted)

    def only(self, names: tuple[str, ...]) -> "FitData":
        """The same yardstick on some of the records."""
        return replace(self, records=tuple(r for r in self.records if r.name in names))

    def of_outputs(self, names: tuple[str, ...]) -> "FitData":
        """The same yardstick on some of the outputs."""
        kept = [self.records[0].output_names.index(name) for name in names]
        return replace(self, records=tuple(r.only(names) for r in self.records), noise=self.noise[kept])

    def stepped(self, substeps: int) -> "FitData":
        """The same yardstick with other substeps."""
        return replace(self, substeps=substeps)

    def with_noise(self, noise: np.ndarray) -> "FitData":
        """The same yardstick with other standard deviations of the sensors' noise (n_outputs,)."""
        return replace(self, noise=noise)

    def tempered(self, heat: float) -> "FitData":
        """The same yardstick with that mean square as noise."""
        return replace(self, heat=heat)

    def through(self, whitener: ForceFilter, follower: Follower) -> "FitData":
        """The same yardstick beside a random force."""
        return replace(self, whiteners={record.name: whitener for record in self.records}, follower=follower)

    def beside_inputs(self, whiteners: Mapping[str, ForceFilter]) -> "FitData":
        """The same yardstick beside noise of the logged inputs."""
        return replace(self, whiteners=whiteners)

    def giving_way(self, sensitivity: np.ndarray) -> "FitData":
        """The same measure with residuals as small as uncertain parameters make them, to first order.

        Their squares sum to min over δ of |r + S δ|² + |δ|²: that of r times the root of I - S (Sᵀ S + I)⁻¹ Sᵀ.

        Args:
            sensitivity: (n_values, n_parameters) S, in prior standard deviations of each.
        """
        directions, sizes, _ = np.linalg.svd(sensitivity, full_matrices=False)
        return replace(self, given_way=(directions, 1.0 - 1.0 / np.sqrt(1.0 + sizes**2)))

    def following(self, rig: Rig, loose: float = LOOSE) -> "FitData":
        """The same yardstick on predictions one sample ahead, by a rig held beside the records as this one would be.

        Args:
            loose: random forces on it, as a share of the inputs: the less, the more it goes its own way.
        """
        if self.follower is not None:  # innovations beside a random force are errors one sample ahead as they are
            return replace(self, given_way=None)
        follower = Follower.of(rig, self.noise, self.force_rms, self.records[0].sample_time, loose=loose)
        return replace(self, follower=follower, whiteners={}, given_way=None)

    @cached_property
    def force_rms(self) -> float:
        """Root mean square of the inputs that are not at rest, N."""
        squares = [row[row != 0] ** 2 for record in self.counted for row in record.inputs if np.any(row)]
        return float(np.sqrt(np.mean(np.concatenate(squares)))) if squares else 1.0

    @cached_property
    def counted(self) -> tuple[Record, ...]:
        """The records without their lead."""
        if self.lead == 0:
            return self.records
        return tuple(record.between(record.time[min(self.lead, record.n_samples - 1)]) for record in self.records)

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
        ).after(self.lead)
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
        if self.given_way is not None:
            directions, shares = self.given_way
            residual -= directions @ (shares * (directions.T @ residual))
        return residual if self.heat == 1.0 else residual / np.sqrt(self.heat)

    def _left(self, rig: Rig) -> np.ndarray:
        follower = self.follower
        if self.whiteners:
            each = zip(self.records, self.left_beside(rig, follower), strict=True)
            return np.concatenate([whiten(self.whiteners[record.name], left).ravel() for record, left in each])
        if follower is None:
            return np.concatenate([(r / self.noise[:, None]).ravel() for r in self.differences(rig)])
        if is_stepped(rig) or steps_exactly(rig):
            substeps = self.substeps if is_stepped(rig) else 1
            ahead = [follower.errors(rig.in_record(record.name), record, substeps) for record in self.records]
        else:
            whole = zip(self.records, self._from_the_first_sample.differences(rig), strict=True)
            ahead = [
                follower.errors_of_linear(rig.in_record(record.name), left, record.sample_time, self.substeps)
                for record, left in whole
            ]
        return np.concatenate([errors[:, self.lead :].ravel() for errors in ahead])

    @cached_property
    def _from_the_first_sample(self) -> "FitData":
        return replace(self, lead=0) if self.lead else self

    def left_beside(self, rig: Rig, follower: Follower | None) -> list[np.ndarray]:
        """Measured less predicted (n_outputs, n_samples) a record; by laws on the measured motion with a follower."""
        if follower is None or not is_stepped(rig) or rig.stiffness_rate:
            return self.differences(rig)
        return [
            follower.left(rig.in_record(record.name), record, self.substeps)[:, self.lead :] for record in self.records
        ]

    def differences(self, rig: Rig) -> list[np.ndarray]:
        """Measured less predicted on whole records (n_outputs, n_samples), one a record, in the sensors' units."""
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


def noise_found(residuals: Sequence[np.ndarray]) -> np.ndarray:
    """Standard deviation of each sensor's noise (n_outputs,), in the sensors' units.

    Noise is as strong in every record, while what a model lacks goes with the level; so the noise is at most the least
    of all records; and errors of a model make peaks about its modes, so the noise is at most what lies under them in
    a spectrum that is smooth otherwise, white or coloured.

    Args:
        residuals: (n_outputs, n_samples) measured less predicted, one a record.
    """
    whole = np.sort([(residual**2).mean(axis=1) for residual in residuals], axis=0)
    under = np.min([_under_peaks(residual) for residual in residuals], axis=0)
    # what is as strong in two records of unequal level is noise, of whatever colour
    alike = whole[1] < ALIKE * whole[0] if len(residuals) > 1 else np.zeros(under.size, bool)
    same = whole < SAME * whole[0]
    noise = np.where(same, whole, 0.0).sum(axis=0) / same.sum(axis=0)
    power: Floats = np.where(alike | (under > LOUD * whole[0]), noise, under)
    return np.sqrt(power)


def _under_peaks(residual: Floats) -> Floats:
    """Mean square (n_outputs,) under the peaks of the spectrum."""
    n_outputs, n_samples = residual.shape
    window = np.hanning(n_samples)
    spectrum = np.abs(np.fft.rfft(residual * window, axis=1)[:, 1:]) ** 2 / (n_samples * np.mean(window**2))
    bands = max(spectrum.shape[1] // LINES, 1)
    means = spectrum[:, : bands * (spectrum.shape[1] // bands)].reshape(n_outputs, bands, -1).mean(axis=2)
    reach = min(REACH, (bands - 1) // 2)
    around = sliding_window_view(np.pad(means, ((0, 0), (reach, reach)), mode="reflect"), 2 * reach + 1, axis=1)
    floor = np.quantile(around, QUIET, axis=2) * (1.0 + LOWER / np.sqrt(LINES))
    under: Floats = np.minimum(means, floor).mean(axis=1)
    return under
