"""A quantity over a surface: mass per area, bending stiffness, tension, damping per area."""

from collections.abc import Callable
from dataclasses import dataclass
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True, eq=False)
class Field:
    """A scalar quantity over (x, y), smooth between its breaks.

    Attributes:
        function: takes coordinates x and y of one shape, m, and returns values of that shape.
        x_breaks, y_breaks: lines x = const and y = const, m, across which the quantity or its slope jumps;
            quadrature never straddles one.
        is_constant: whether the quantity is the same everywhere.
        multiple_of: (another field, factor) where this is so many times that one; None where it stands by itself.
    """

    function: Callable[[np.ndarray, np.ndarray], ArrayLike]
    x_breaks: tuple[float, ...] = ()
    y_breaks: tuple[float, ...] = ()
    is_constant: bool = False
    multiple_of: "tuple[Field, float] | None" = None

    @classmethod
    def constant(cls, value: float) -> "Field":
        """The same value everywhere."""
        if not np.isfinite(value):
            raise ValueError(f"a constant field must be finite; got {value}")
        return cls(lambda x, y: np.full(x.shape, float(value)), is_constant=True)

    def __call__(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:
        """The values at (x, y), in the shape that x and y have together."""
        x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
        return np.broadcast_to(np.asarray(self.function(x, y), float), x.shape)

    def mapped(self, change: Callable[[np.ndarray], np.ndarray]) -> "Field":
        """A field of changed values, with the same breaks."""
        return Field(lambda x, y: change(self(x, y)), self.x_breaks, self.y_breaks, self.is_constant)

    def scaled(self, factor: float) -> "Field":
        """A field of so many times the values."""
        base, already = self.multiple_of or (self, 1.0)
        whole = already * factor
        values = base.mapped(lambda each: whole * each)
        return Field(values.function, self.x_breaks, self.y_breaks, self.is_constant, (base, whole))


FieldLike = Field | float | Callable[[np.ndarray, np.ndarray], ArrayLike]


def as_field(quantity: FieldLike) -> Field:
    """A `Field` from a number, a callable of (x, y), or a `Field`.

    Raises:
        TypeError: anything else.
    """
    if isinstance(quantity, Field):
        return quantity
    if isinstance(quantity, Real):
        return Field.constant(float(quantity))
    if callable(quantity):
        return Field(quantity)
    raise TypeError(f"a field is a number, a function of (x, y) or a Field; got {type(quantity).__name__}")
