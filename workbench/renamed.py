"""Former names of attributes and arguments, which work for one version more."""

from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar
from warnings import warn

P = ParamSpec("P")
R = TypeVar("R")
C = TypeVar("C", bound=type)


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


def former_arguments(**new_names: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """A function, or a constructor, that takes former names of its arguments too, with a DeprecationWarning."""

    def taking(function: Callable[P, R]) -> Callable[P, R]:
        name = function.__qualname__.removesuffix(".__init__")

        @wraps(function)
        def with_former(*args: P.args, **kwargs: P.kwargs) -> R:
            for old in new_names.keys() & kwargs.keys():
                new = new_names[old]
                now = f"{name}({old}=...) is now {name}({new}=...); the old name goes with the next version"
                warn(now, DeprecationWarning, 2)
                kwargs[new] = kwargs.pop(old)
            return function(*args, **kwargs)

        return with_former

    return taking


def former_fields(**new_names: str) -> Callable[[C], C]:
    """A dataclass whose fields have former names too, in its constructor and as attributes.

    Args:
        new_names: by former name.
    """

    def taking(owner: C) -> C:
        owner.__init__ = former_arguments(**new_names)(owner.__init__)  # type: ignore[misc]
        for old, new in new_names.items():
            attribute = Renamed(new)
            attribute.__set_name__(owner, old)
            setattr(owner, old, attribute)
        return owner

    return taking
