"""The fit records as a yardstick: how far a rig's prediction stands from them, in units of the noise."""

from collections import OrderedDict
from dataclasses import dataclass, field, replace
from functools import cached_property
from threading import Lock

import numpy as np

from workbench.gap.effects.structural import known_places
from workbench.gap.missing_force import ForceFilter, force_filter, sampled_model, whiten
from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.rig.simulate import Motion, follow, move, read

REMEMBERED = 24
LOOSE = 0.01  # of the inputs: random forces that hold a rig beside the records


@dataclass(frozen=True, eq=False)
class Follower:
    """What holds a rig beside the records: a steady Kalman filter of its modes, under random forces on all of them.

    Attributes:
        gain: (2, n_modes, n_outputs) of their displacements and velocities.
        whitening: (n_outputs, n_outputs) to errors of unit covariance.
    """

    gain: np.ndarray
    whitening: np.ndarray

    @classmethod
    def of(cls, rig: Rig, noise: np.ndarray, force: float, sample_time: float) -> "Follower":
        """For sensors of that noise (n_outputs,), and forces of that rms, N, at any place."""
        modes, n = rig.modes, rig.modes.n_modes
        places = known_places(rig)
        along = (np.arange(50) + 0.5) / 50 * modes.length if places is None else places
        forces = force * np.sqrt(np.mean(modes.phi(along) ** 2, axis=0))
        found = force_filter(sampled_model(modes, rig.sensors, noise, sample_time), np.eye(n), forces**2, 0.0)
        gain = np.linalg.solve(found.innovation, found.h @ found.covariance[:, : 2 * n]).T
        return cls(gain.reshape(2, n, -1).copy(), np.linalg.inv(np.linalg.cholesky(found.innovation)))


@dataclass(frozen=True, eq=False)
class FitData:
    """Records that a fit may see. Validation records never become part of one.

    Attributes:
        records: measured, all with the rig's inputs and outputs.
        noise: (n_outputs,) standard deviation of each sensor's noise, rounding included.
        substeps: of a sample, for rigs that are not linear.
        lead: samples at the start of each record that are simulated but not counted, while the rig settles from the
            rest that the simulation assumes to the motion it really had.
        whitener: filter of a random force on the structure, through which every residual is seen; None where there is
            none.
        given_way: (n_values, k) orthonormal directions and (k,) shares by which residuals give way along them, for
            believed figures that are fitted along with every candidate to first order; None where none are.
        follower: what holds the rig beside the records, so that its predictions are of one sample ahead; None where
            they are of the whole record.
    """

    records: tuple[Record, ...]
    noise: np.ndarray
    substeps: int = 4
    lead: int = 0
    whitener: ForceFilter | None = None
    given_way: tuple[np.ndarray, np.ndarray] | None = None
    follower: Follower | None = None
    _memory: OrderedDict = field(default_factory=OrderedDict, repr=False, init=False)
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

    def through(self, whitener: ForceFilter) -> "FitData":
        """The same yardstick beside a random force."""
        return replace(self, whitener=whitener)

    def giving_way(self, sensitivity: np.ndarray) -> "FitData":
        """The same yardstick with residuals as small as believed figures make them, to first order.

        Their squares sum to min over δ of |r + S δ|² + |δ|²: that of r times the root of I - S (Sᵀ S + I)⁻¹ Sᵀ.

        Args:
            sensitivity: (n_values, n_figures) S, in units of the belief in each figure.
        """
        directions, sizes, _ = np.linalg.svd(sensitivity, full_matrices=False)
        return replace(self, given_way=(directions, 1.0 - 1.0 / np.sqrt(1.0 + sizes**2)))

    def following(self, rig: Rig) -> "FitData":
        """The same yardstick on predictions one sample ahead, by a rig held beside the records as this one would be."""
        follower = Follower.of(rig, self.noise, LOOSE * self.force_rms, self.records[0].sample_time)
        return replace(self, follower=follower)

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
        key = (id(rig.modes), rig.actuators, rig.elements, rig.stiffness_rate)
        with self._lock:
            if key in self._memory:
                self._memory.move_to_end(key)
                return self._memory[key][1]
        motions = tuple(
            move(rig, record.inputs, sample_time=record.sample_time, substeps=self.substeps).after(self.lead)
            for record in self.records
        )
        with self._lock:
            self._memory[key] = (rig.modes, motions)
            while len(self._memory) > REMEMBERED:
                self._memory.popitem(last=False)
        return motions

    def predictions(self, rig: Rig) -> tuple[np.ndarray, ...]:
        """(n_outputs, n_samples) a record."""
        return tuple(
            read(rig, motion, sample_time=record.sample_time)
            for record, motion in zip(self.counted, self.motions(rig), strict=True)
        )

    def residual(self, rig: Rig) -> np.ndarray:
        """(measured - predicted) / noise, or their innovations of unit variance, all records joined: (n_values,)."""
        if self.follower is not None:
            return np.concatenate([self._ahead(rig, record, self.follower) for record in self.records])
        both = zip(self.counted, self.predictions(rig), strict=True)
        left = [record.outputs - prediction for record, prediction in both]
        if self.whitener is None:
            residual = np.concatenate([(r / self.noise[:, None]).ravel() for r in left])
        else:
            residual = np.concatenate([whiten(self.whitener, r).ravel() for r in left])
        if self.given_way is not None:
            directions, shares = self.given_way
            residual -= directions @ (shares * (directions.T @ residual))
        return residual

    def _ahead(self, rig: Rig, record: Record, follower: Follower) -> np.ndarray:
        errors = follow(
            rig,
            record.inputs,
            record.outputs,
            follower.gain,
            sample_time=record.sample_time,
            substeps=self.substeps,
        )
        return (follower.whitening @ errors[:, self.lead :]).ravel()

    def by_channel(self, residual: np.ndarray) -> np.ndarray:
        """Mean square of a residual by record and channel: (n_records, n_outputs)."""
        rows, start = [], 0
        for record in self.counted:
            size = record.outputs.size
            rows.append((residual[start : start + size].reshape(record.outputs.shape) ** 2).mean(axis=1))
            start += size
        return np.array(rows)
