"""Modes of a finite-element model or a modal test, from files of other programs."""

from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import ArrayLike

from workbench.arrays import Floats
from workbench.records import hdf5_file, mat_file, npz_file, uff_modes
from workbench.records.limits import RecordFileError, check_file, reading
from workbench.structure.domain import NamedPoints
from workbench.structure.modes import Modes

FORMATS: dict[str, ModuleType] = {
    **dict.fromkeys((".uff", ".unv"), uff_modes),
    ".npz": npz_file,
    ".mat": mat_file,
    **dict.fromkeys((".h5", ".hdf5"), hdf5_file),
}
SCALES = ("mass_matrix", "modal_mass")  # arrays that determine the scale of the shapes
ORTHOGONAL = 1e-3  # of unit modal mass: tolerated rounding of products of different modes
NO_OP2 = (
    "Nastran's OP2 is not read: pyNastran 1.4 needs NumPy below 2. Export the modes as a universal file (data set"
    " 2414), or read the OP2 where pyNastran runs and save its arrays as an NPZ"
)


def read_modes(
    path: str | Path, *, modal_mass: ArrayLike | None = None, damping_ratios: ArrayLike | None = None
) -> Modes:
    """The mass-normalised modes of a file, at named points.

    Universal files (.uff, .unv): displacements of data sets 55 or 2414 at nodes, with coordinates of 15 or 2411, in the
    units of 164; m, N and kg where it is missing. NPZ, MAT and HDF5:
    `shapes` (n_points, n_modes), `frequencies_hz` or `omega` (n_modes,), and where known `damping_ratios` (n_modes,),
    `modal_mass` (n_modes,), `names`, `nodes` and `directions` (n_points,), `positions` (n_points, 3) in m, and
    `mass_matrix` (n_points, n_points), by which the shapes are then scaled and checked. Without `mass_matrix` and
    `modal_mass` the shapes count as mass-normalised.

    Args:
        path: of the file.
        modal_mass: (n_modes,) or one number, kg, φᵀ M φ of the file's shapes; overrides the file.
        damping_ratios: (n_modes,) or one number; overrides the file.

    Raises:
        RecordFileError: no modal mass, or another one than the mass matrix gives, modes that are not orthogonal, shapes
            and frequencies of different numbers, complex shapes, numbers that are not finite, damping in per cent,
            frequencies given twice, an array with a name similar to a modal mass or a mass matrix.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending == ".op2":
        raise RecordFileError(f"{path}: {NO_OP2}")
    if ending not in FORMATS:
        raise RecordFileError(
            f"{path}: the ending {ending!r} names no format of modes; use one of {', '.join(FORMATS)}"
        )
    check_file(path)
    with reading(path):
        arrays = FORMATS[ending].arrays(path)
    given = {"modal_mass": modal_mass, "damping_ratios": damping_ratios}
    try:
        return _modes_of(path, {**arrays, **{k: np.asarray(v, float) for k, v in given.items() if v is not None}})
    except RecordFileError:
        raise
    except ValueError as error:  # refused by `Modes` or `NamedPoints`, or text instead of numbers
        raise RecordFileError(f"{path}: {error}") from error


def _modes_of(path: Path, arrays: Mapping[str, np.ndarray]) -> Modes:
    for name in arrays:  # other arrays are ignored, but not a misspelt scale of the shapes
        if name not in SCALES and (name.lower() in ("m", "mass", "masses") or get_close_matches(name.lower(), SCALES)):
            likely = get_close_matches(name.lower(), SCALES, n=1) or SCALES
            raise RecordFileError(
                f"{path}: an array {name!r} is not known; name it {' or '.join(likely)} if it is that, or leave it out"
            )
    stated = {"frequencies_hz", "omega"} & set(arrays)
    if "shapes" not in arrays or not stated:
        raise RecordFileError(
            f"{path} needs `shapes` (n_points, n_modes) and `frequencies_hz` or `omega`; it holds"
            f" {', '.join(sorted(arrays)) or 'nothing'}"
        )
    if len(stated) == 2:
        raise RecordFileError(f"{path} holds both `frequencies_hz` and `omega`; leave one of them out")
    (given,) = stated
    frequencies = np.ravel(arrays[given]).astype(float)
    if (r := _first(~np.isfinite(frequencies) | (frequencies < 0))) is not None:
        raise RecordFileError(
            f"{path}: {given} must be finite and not negative; of mode {r + 1} it is {frequencies[r]:.6g};"
            " leave out modes that are unstable"
        )
    omega = frequencies if given == "omega" else 2.0 * np.pi * frequencies
    shapes = np.asarray(arrays["shapes"])
    if np.iscomplexobj(shapes) and shapes.imag.any():  # some programs write real shapes as complex numbers
        raise RecordFileError(f"{path}: its shapes are complex; give the real normal modes")
    if shapes.ndim != 2 or shapes.shape[1] != omega.size:
        raise RecordFileError(
            f"{path}: shapes must have shape (n_points, n_modes) with {omega.size} modes; it is {shapes.shape}"
        )
    shapes = shapes.real.astype(float)
    if not np.isfinite(shapes).all():
        i, r = np.argwhere(~np.isfinite(shapes))[0]
        raise RecordFileError(f"{path}: shapes must be finite; of mode {r + 1} row {i + 1} is {shapes[i, r]}")
    zeta = _one_a_mode(path, "damping_ratios", arrays.get("damping_ratios", 0.0), omega.size)
    if (r := _first(~(np.abs(zeta) < 1))) is not None:
        raise RecordFileError(
            f"{path}: damping_ratios must be finite and below 1; of mode {r + 1} it is {zeta[r]:.6g}: give ratios, not"
            " per cent"
        )
    order = np.argsort(omega, kind="stable")
    shapes = np.array(_scaled(path, shapes, arrays)[:, order])
    shapes.flags.writeable = False
    return Modes(
        omega=omega[order],
        damping=zeta[order],
        shapes=lambda index, _: shapes[index],
        domain=_points(path, shapes.shape[0], arrays),
    )


def _scaled(path: Path, shapes: np.ndarray, arrays: Mapping[str, np.ndarray]) -> np.ndarray:
    """Shapes of unit modal mass."""
    n_points, n_modes = shapes.shape
    if "mass_matrix" in arrays:
        matrix = np.asarray(arrays["mass_matrix"], float)
        if matrix.shape != (n_points, n_points) or not np.isfinite(matrix).all():
            raise RecordFileError(
                f"{path}: the mass matrix of {n_points} points must be finite, ({n_points}, {n_points}); it is"
                f" {matrix.shape if np.isfinite(matrix).all() else 'not finite'}"
            )
        products = shapes.T @ matrix @ shapes
        masses = np.diag(products)
        if not (masses > 0).all():
            r = int(np.argmin(masses))
            raise RecordFileError(
                f"{path}: its mass matrix is not positive definite: mode {r + 1} has a modal mass of {masses[r]:.3g} kg"
            )
        between = np.abs(products - np.diag(masses)) / np.sqrt(np.outer(masses, masses))
        if between.max(initial=0.0) > ORTHOGONAL:
            r, s = divmod(int(between.argmax()), n_modes)
            raise RecordFileError(
                f"{path}: modes {r + 1} and {s + 1} are not orthogonal with its mass matrix, by {between.max():.2g} of"
                " their modal masses; are shapes and matrix of one model, in one order of points?"
            )
        stated = _one_a_mode(path, "modal_mass", arrays.get("modal_mass", masses), n_modes)
        wrong = np.abs(masses / np.where(stated > 0, stated, masses) - 1.0)
        if wrong.max() > ORTHOGONAL:
            r = int(wrong.argmax())
            raise RecordFileError(
                f"{path}: mode {r + 1} has a modal mass φᵀ M φ of {masses[r]:.4g} kg by its mass matrix, and"
                f" {stated[r]:.4g} kg is stated: its shape is {np.sqrt(masses[r] / stated[r]):.4g} times too large;"
                " leave out modal_mass, or correct the matrix"
            )
    elif "modal_mass" in arrays:
        masses = _one_a_mode(path, "modal_mass", arrays["modal_mass"], n_modes)
    else:
        return shapes
    if (negative := _first(masses < 0)) is not None:
        which = f"of mode {negative + 1} it is {masses[negative]:.6g}"
        raise RecordFileError(f"{path}: modal_mass must be positive, kg; {which}")
    if (unstated := _first(~(masses > 0))) is not None:
        raise RecordFileError(
            f"{path} states no modal mass of mode {unstated + 1}, so its shape has no scale; give"
            " read_modes(path, modal_mass=...), 1.0 where the shapes are mass-normalised"
        )
    return shapes / np.sqrt(masses)


def _first(wrong: np.ndarray) -> int | None:
    """The first mode of which something is wrong, from 0."""
    return int(np.argmax(wrong)) if wrong.any() else None


def _one_a_mode(path: Path, name: str, values: ArrayLike, n_modes: int) -> Floats:
    """Values (n_modes,) from one number for all modes, or one per mode."""
    given = np.ravel(np.asarray(values, float))
    if given.size not in (1, n_modes):
        raise RecordFileError(
            f"{path}: {name} is one number, or one per mode: {n_modes} modes need as many; got {given.size}"
        )
    return np.broadcast_to(given, (n_modes,))


def _points(path: Path, n: int, arrays: Mapping[str, np.ndarray]) -> NamedPoints:
    names, nodes, directions = (
        tuple(str(v).strip() for v in np.ravel(arrays.get(key, ()))) for key in ("names", "nodes", "directions")
    )
    if "names" not in arrays and nodes:
        apart = "." if any(node[-1:].isalpha() for node in nodes) else ""
        names = tuple(node + apart + d for node, d in zip(nodes, directions or ("",) * len(nodes)))
    elif "names" not in arrays:
        names = tuple(f"{i + 1}" for i in range(n))
    if len(names) != n:
        raise RecordFileError(f"{path}: {n} rows of shapes need as many points; it names {len(names)}")
    return NamedPoints(names, arrays.get("positions"), directions, nodes)
