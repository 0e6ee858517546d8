"""A quantity along a structure or over a surface: mass, stiffness, tension, damping per length or area."""

from collections.abc import Callable
from dataclasses import dataclass
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike

from workbench.arrays import Floats


@dataclass(frozen=True, eq=False)
class Profile:
    """A scalar quantity along x, smooth between its breaks.

    Attributes:
        function: takes positions (n_points,) in m, returns values (n_points,).
        breaks: positions in m where the quantity or its slope jumps; quadrature is split there.
    """

    function: Callable[[np.ndarray], np.ndarray]
    breaks: tuple[float, ...] = ()

    @classmethod
    def constant(cls, value: float) -> "Profile":
        """The same value everywhere."""
        if not np.isfinite(value):
            raise ValueError(f"a constant profile must be finite; got {value}")
        return cls(lambda x: np.full(np.shape(x), float(value)))

    @classmethod
    def points(cls, x: ArrayLike, value: ArrayLike) -> "Profile":
        """Linear between the points (x_i, value_i), and refused beyond them; the same x twice in a row is a jump.

        Args:
            x: (n_points,) positions in m, not decreasing.
            value: (n_points,) values there.

        Raises:
            ValueError: unequal lengths, fewer than two points, non-finite numbers, x that goes back.
        """
        x, value = np.asarray(x, float), np.asarray(value, float)
        if x.ndim != 1 or x.shape != value.shape or x.size < 2:
            raise ValueError(
                f"a profile needs as many x as value, at least two; got shapes {x.shape} and {value.shape}"
            )
        if not (np.isfinite(x).all() and np.isfinite(value).all()):
            raise ValueError("the points of a profile must be finite numbers")
        steps = np.diff(x)
        if (steps < 0).any():
            i = int(np.argmax(steps < 0))
            raise ValueError(f"profile points must not go back: x[{i + 1}] = {x[i + 1]} after {x[i]}; sort them")
        if (steps[1:] + steps[:-1] == 0).any():
            raise ValueError("more than two profile points have the same x; two make a jump")
        pieces = [i for i in range(x.size - 1) if x[i + 1] > x[i]]
        starts = x[pieces]
        slack = 1e-9 * (x[-1] - x[0])

        def piecewise_linear(at: Floats) -> Floats:
            outside = (at < x[0] - slack) | (at > x[-1] + slack)
            if outside.any():
                raise ValueError(
                    f"a profile is given at points from x = {x[0]:g} to {x[-1]:g}, and not at {at[outside][0]:g}; give"
                    " its values at both ends of the structure too"
                )
            piece = np.asarray(pieces)[np.clip(np.searchsorted(starts, at, side="right") - 1, 0, None)]
            share = (at - x[piece]) / (x[piece + 1] - x[piece])
            return np.asarray(value[piece] + share * (value[piece + 1] - value[piece]))

        return cls(piecewise_linear, tuple(np.unique(x)))

    def __call__(self, x: ArrayLike) -> Floats:
        """The values at positions x, in the shape of x."""
        x = np.asarray(x, float)
        values = np.asarray(self.function(np.atleast_1d(x)), float)
        return values if values.shape == x.shape else np.broadcast_to(values, np.atleast_1d(x).shape).reshape(x.shape)

    def scaled(self, factor: float, start: float | None = None, stop: float | None = None) -> "Profile":
        """The same quantity times `factor`, from `start` to `stop` (m), or to the end where one is not given."""
        ends = [float(end) for end in (start, stop) if end is not None]
        if not ends:
            return Profile(lambda x: factor * self.function(x), self.breaks)
        low, high = -np.inf if start is None else start, np.inf if stop is None else stop

        def changed(x: Floats) -> Floats:
            factors: Floats = np.where((x > low) & (x < high), factor, 1.0)
            return factors * self(x)

        return Profile(changed, tuple(sorted({*self.breaks, *ends})))


ProfileLike = Profile | float | Callable[[np.ndarray], np.ndarray] | tuple[ArrayLike, ArrayLike]


def as_profile(quantity: ProfileLike) -> Profile:
    """A `Profile` from a number, a callable of x, a pair (x, values), or a `Profile`."""
    if isinstance(quantity, Profile):
        return quantity
    if isinstance(quantity, Real):
        return Profile.constant(float(quantity))
    if callable(quantity):
        return Profile(quantity)
    if isinstance(quantity, tuple | list) and len(quantity) == 2:
        return Profile.points(*quantity)
    raise TypeError(
        f"a profile is a number, a function of x, a pair (x, values) or a Profile; got {type(quantity).__name__}"
    )


@dataclass(frozen=True, eq=False)
class Field:
    """A scalar quantity over (x, y), smooth between its breaks.

    Attributes:
        function: takes coordinates x and y of one shape, m, and returns values of that shape.
        x_breaks, y_breaks: lines x = const and y = const, m, across which the quantity or its slope jumps;
            quadrature is split there.
        is_constant: whether the quantity is the same everywhere.
        multiple_of: (another field, factor) of which this is a multiple; None for others.
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
        """The values at (x, y), in the broadcast shape of x and y."""
        x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
        return np.broadcast_to(np.asarray(self.function(x, y), float), x.shape)

    def mapped(self, change: Callable[[np.ndarray], np.ndarray]) -> "Field":
        """The field change(values), with the same breaks."""
        return Field(lambda x, y: change(self(x, y)), self.x_breaks, self.y_breaks, self.is_constant)

    def scaled(self, factor: float) -> "Field":
        """The field times a factor."""
        base, own = self.multiple_of or (self, 1.0)
        total = own * factor
        values = base.mapped(lambda each: total * each)
        return Field(values.function, self.x_breaks, self.y_breaks, self.is_constant, (base, total))


FieldLike = Field | float | Callable[[np.ndarray, np.ndarray], ArrayLike]


def as_field(quantity: FieldLike) -> Field:
    """A `Field` from a number, a callable of (x, y), or a `Field`."""
    if isinstance(quantity, Field):
        return quantity
    if isinstance(quantity, Real):
        return Field.constant(float(quantity))
    if callable(quantity):
        return Field(quantity)
    raise TypeError(f"a field is a number, a function of (x, y) or a Field; got {type(quantity).__name__}")
