"""What a kind of effect may look at to say where a fit starts; `workbench.gap.localisation.evidence` has it all."""

from collections.abc import Sequence
from typing import Any, Protocol

from workbench.arrays import Floats
from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.rig.simulate import Motion
from workbench.structure.domain import Domain, Where


class Moved(Protocol):
    """The unmodelled force (N) at a place and the motion there, each (n_total,), the records joined end to end."""

    @property
    def at(self) -> Where: ...
    @property
    def force(self) -> Floats: ...
    @property
    def displacement(self) -> Floats: ...
    @property
    def velocity(self) -> Floats: ...
    @property
    def acceleration(self) -> Floats: ...


class Measured(Protocol):
    """The fit records, whole and without the samples at their start (`lead`) that are not counted."""

    @property
    def records(self) -> tuple[Record, ...]: ...
    @property
    def counted(self) -> tuple[Record, ...]: ...
    @property
    def lead(self) -> int: ...


class Evidence(Protocol):
    """A rig, the fit records, its motion on each of them, and what it leaves of each reading."""

    @property
    def rig(self) -> Rig: ...
    @property
    def data(self) -> Measured: ...
    @property
    def motions(self) -> tuple[Motion, ...]: ...
    @property
    def residuals(self) -> tuple[Floats, ...]: ...
    @property
    def domain(self) -> Domain: ...
    @property
    def at_peaks(self) -> Sequence[Moved]: ...
    @property
    def places_to_try(self) -> Sequence[Any]: ...
