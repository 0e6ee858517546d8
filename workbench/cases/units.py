"""The names of a case's units."""

import re
from dataclasses import dataclass

SI_NAME = re.compile(r"\b(m|kg|s|N|Hz)\b")


@dataclass(frozen=True)
class Units:
    """Names of a consistent set of units, in which results are stated; numbers are never converted.

    Attributes:
        length, mass, time, force: such as "mm", "t", "s", "N"; force is that of mass · length / time².
    """

    length: str = "m"
    mass: str = "kg"
    time: str = "s"
    force: str = "N"

    def named(self, unit: str) -> str:
        """A unit by its SI names, such as N s^2/m^2, by those of this set."""
        hertz = "Hz" if self.time == "s" else f"1/{self.time}"
        own = {"m": self.length, "kg": self.mass, "s": self.time, "N": self.force, "Hz": hertz}
        return SI_NAME.sub(lambda name: own[name[0]], unit)


SI = Units()
