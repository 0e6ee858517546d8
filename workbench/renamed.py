"""Former names of attributes, which work for one version more."""

from typing import Any
from warnings import warn


class Renamed:
    """A former name of an attribute or a method, in the body of its class: the new one, with a DeprecationWarning."""

    def __init__(self, new: str) -> None:
        self._new, self._name = new, ""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = f"{owner.__name__}.{name}"

    def __get__(self, instance: object, owner: type | None = None) -> Any:
        if instance is None:
            return self
        warn(f"{self._name} is now {self._new}; the old name goes with the next version", DeprecationWarning, 2)
        return getattr(instance, self._new)
