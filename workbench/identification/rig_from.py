"""A rig from identified modes, known at the measured inputs and outputs only."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from workbench.arrays import symmetric_root
from workbench.identification.driven import DrivenModes
from workbench.identification.frf import FrfModes
from workbench.identification.signal.clocks import are_far, far_from_real, shape_errors
from workbench.identification.signal.modal_estimates import normalised_shapes, set_up_remarks
from workbench.records.record import Channel
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import MEASURED, Sensor
from workbench.structure.domain import NamedPoints, place_array
from workbench.structure.modes import Modes, PointShapes, SampledModes

# A residual of the direct term of accelerations above this share of it, and above so many standard errors, may be
# rigid-body motion.
RIGID_SHARE, RIGID_ERRORS = 0.1, 5.0
# Share of the response at the lowest line due to modes below it: neglected up to the first value; taken for rigid-body
# modes above the second. It is 1 for a free beam, and 0.03 for the first mode of a supported beam where lines begin at
# four times its frequency.
NEGLIGIBLE, DOMINANT = 0.02, 0.5
STEP = 1e-3  # of the finite differences in the propagation of errors, in standard errors
# Points; mass-normalised shapes there (n_points, n_modes), identified first, then rigid ones; and their covariance
# (n_modes, n_points, n_points), None where it is unknown.
Shapes = tuple[NamedPoints, np.ndarray, np.ndarray | None]
# The sum Σ φ_j φ_i of rigid modes, its standard errors, (n_outputs, n_inputs) each, and the norm up to which a part of
# it is insignificant.
RigidTerm = tuple[np.ndarray, np.ndarray, float]


def rig_from(
    identified: Any,
    *,
    inputs: Sequence[Channel | str] | None = None,
    outputs: Sequence[Channel] | None = None,
    driving_point: tuple[str, str] | None = None,
    modal_masses: ArrayLike | None = None,
) -> Rig:
    """The rig of identified modes, each replaced by the nearest real one, mass-normalised where the scale is known.

    The residue of output j and input i at the pole λ is A_ji / (2 i ω_d), and A_ji = φ_j φ_i for a real mode: the
    nearest real mode is the largest singular value of Re A with its vectors. The product φ_j φ_i suffices to simulate
    responses to the inputs. The shapes themselves, needed to attach masses and springs, follow from a driving point,
    where φ_i = φ_j, or from modal masses. The residual of the direct term of accelerations, D - Σ_r φ_j φ_i, is
    rigid-body motion: modes at 0 Hz, as far as the inputs excite them. For FRFs it is the residual term
    of modes below the band.

    Args:
        identified: from `identify_driven` or `identify_frf`, or from `identify_ambient`, `ring_down` or
            `identify`, which know no inputs.
        inputs: channels of the inputs: not needed from `identify_driven`; where no input was measured, the names of
            outputs where forces are to act.
        outputs: channels of the outputs, not needed from `identify_driven`.
        driving_point: an input and the output at its place; those of one name or place unless given.
        modal_masses: (n_modes,) kg, for shapes whose largest entry is 1; where there is no driving point.

    Returns:
        A rig at named points: each input and output is one, by its name. Its modes carry the covariance of frequencies,
        damping and shapes (of output-only modes that of shapes where it is known).

    Raises:
        ValueError: missing channels, shapes of unknown scale without any input, a driving point where a mode would have
            a negative mass.

    Warns:
        UserWarning: complex modes; shapes of unknown scale, so that only responses to these inputs are right; several
            rigid modes, likewise; a direct term that is left out, as it is not one of modes, or as not all outputs are
            accelerations; modes outside the band of FRFs that are left out, or taken as rigid.

    Source: Ewins, Modal Testing, 2nd ed., sections 2.4 and 4.4.
    """
    modes = identified.modes
    out_channels = _channels(identified, "output_channels", outputs, modes.shapes.shape[0])
    for channel in out_channels:
        if channel.quantity not in MEASURED:
            raise ValueError(
                f"output {channel.name!r} measures {channel.quantity or 'an unnamed quantity'}; give outputs= with one"
                f" of {', '.join(MEASURED)}"
            )
    if isinstance(identified, DrivenModes | FrfModes):
        in_channels = _channels(identified, "input_channels", inputs, identified.participation.shape[1])
        points, shapes, shape_covariance = _shapes_of_residues(
            identified, out_channels, in_channels, driving_point, modal_masses
        )
        delays = identified.delays if isinstance(identified, DrivenModes) else np.zeros(len(in_channels))
        actuators = tuple(
            Actuator(c.name, c.name, quantity="moment" if c.quantity == "moment" else "force", delay=float(delay))
            for c, delay in zip(in_channels, delays, strict=True)
        )
    else:
        points, shapes, shape_covariance = _shapes_of_outputs(identified, out_channels, modal_masses)
        names = [channel if isinstance(channel, str) else channel.name for channel in inputs or ()]
        points.locate(names)
        actuators = tuple(Actuator(f"force at {name}", name) for name in names)
    noise = getattr(identified, "noise_std", [channel.noise_std or 0.0 for channel in out_channels])
    late = identified.delays if isinstance(identified, FrfModes) else np.zeros(len(out_channels))
    sensors = tuple(
        Sensor(c.name, c.name, c.quantity, noise_std=float(std), delay=float(delay))
        for c, std, delay in zip(out_channels, np.atleast_1d(noise), late, strict=True)
    )
    n = modes.n_modes
    # rigid modes come last in `shapes`
    omega, zeta = (np.append(figure, np.zeros(shapes.shape[1] - n)) for figure in (modes.omega, modes.zeta))
    covariance, known = np.zeros((2 * omega.size,) * 2), np.r_[:n, omega.size : omega.size + n]
    covariance[np.ix_(known, known)] = identified.covariance
    order = np.argsort(omega, kind="stable")
    both = np.r_[order, order + order.size]
    modes_found = Modes(
        omega=omega[order],
        damping=zeta[order],
        shapes=PointShapes(shapes[:, order]),
        domain=points,
        covariance=covariance[np.ix_(both, both)],
        shape_covariance=None if shape_covariance is None else shape_covariance[order],
    )
    return Rig(modes_found, actuators, sensors)


def _channels(identified: Any, name: str, given: Sequence[Channel | str] | None, count: int) -> tuple[Channel, ...]:
    """The channels of inputs or outputs, given or as kept by the identification as `name`, `count` of them."""
    records = getattr(identified, "records", ()) or getattr(identified, "correlations", ())
    chosen = given if given is not None else getattr(identified, name, getattr(next(iter(records), None), name, None))
    side = name.split("_")[0] + "s"
    if chosen is None:
        raise ValueError(f"{type(identified).__name__} does not keep its {side}; give {side}= with {count} channels")
    channels = tuple(Channel(c) if isinstance(c, str) else c for c in chosen)
    if len(channels) != count:
        raise ValueError(f"{side}= must name the {count} {side} of the identified modes; got {len(channels)}")
    return channels


def _shapes_of_residues(
    identified: DrivenModes | FrfModes,
    out: tuple[Channel, ...],
    into: tuple[Channel, ...],
    driving_point: tuple[str, str] | None,
    modal_masses: ArrayLike | None,
) -> Shapes:
    """Shapes at inputs and outputs from residues; an input and an output of the same name are the same point."""
    modes = identified.modes
    residues = _residues(modes, modes.shapes, identified.participation)
    sizes = np.linalg.svd(residues.real, compute_uv=False)
    complexity = np.sqrt(np.maximum(1.0 - sizes[:, 0] ** 2 / np.sum(np.abs(residues) ** 2, axis=(1, 2)), 0.0))
    norms = (np.linalg.norm(x, axis=1) for x in (identified.participation_std, identified.participation))
    participation_error = np.divide(*norms)
    _warn_of_complex(modes, complexity, np.hypot(shape_errors(identified), participation_error), "residues")
    for remark in set_up_remarks(identified):
        warnings.warn(remark, stacklevel=3)
    pair = _driving_point(out, into, driving_point)
    masses = None if modal_masses is None else _masses(modal_masses, modes.n_modes)
    at_out, at_in = np.split(_mass_normalised(residues.real, pair, masses), [len(out)], axis=1)
    if pair is not None and not (at_out[:, pair[0]] * at_in[:, pair[1]] > 0).all():
        worst = int(np.argmin(at_out[:, pair[0]] * at_in[:, pair[1]]))
        raise ValueError(
            f"mode {worst + 1} at {modes.frequencies_hz[worst]:.4g} Hz has a negative mass at the driving point"
            f" ({into[pair[1]].name}, {out[pair[0]].name}): is a sensor of reversed polarity, or the mode spurious?"
        )
    if pair is None and masses is None:
        warnings.warn(
            "no output is at the place of an input, so the shapes have no scale: responses to these inputs are right,"
            " those to masses, springs or forces elsewhere are not; name an input and the output at its place as the"
            " driving point (driving_point, --driving-point), or give modal_masses",
            stacklevel=3,
        )
    rows = {channel.name: (channel, i) for i, channel in enumerate((*into, *out), start=-len(into))}
    kept = [i % (len(out) + len(into)) for _, i in rows.values()]
    covariance = _propagated(identified, lambda residues: _mass_normalised(residues.real, pair, masses)[:, kept])
    values = np.hstack([at_out, at_in])[:, kept]
    if isinstance(identified, DrivenModes):
        rigid_term = _rigid_of_direct_term(identified, out, pair, at_out.T @ at_in)
    else:
        rigid_term = _rigid_of_residual_term(identified, out, pair)
    if rigid_term is not None:
        shape, error = _rigid_modes(rigid_term, pair)
        values = np.vstack([values, shape[:, kept]])
        covariance = np.concatenate([covariance, [np.diag(row[kept] ** 2) for row in error]])
    return _points([channel for channel, _ in rows.values()]), values.T, covariance


def _rigid_of_direct_term(
    identified: DrivenModes, out: tuple[Channel, ...], pair: tuple[int, int] | None, elastic: np.ndarray
) -> RigidTerm | None:
    """The residual of the direct term of accelerations, where it is rigid-body motion; None where it is not.

    `pair` is an output and the input at its place, `elastic` (n_outputs, n_inputs) the direct term of the other modes.
    """
    accelerations = np.array([channel.quantity == "acceleration" for channel in out])
    direct, error = identified.feedthrough[accelerations], identified.feedthrough_std[accelerations]
    residual = direct - elastic[accelerations]
    least = max(RIGID_SHARE * np.linalg.norm(direct), RIGID_ERRORS * np.linalg.norm(error))
    if not direct.any() or np.linalg.norm(residual) <= least:
        return None
    only = accelerations.all()
    if only and (pair is None or residual[pair] > 0):
        return residual, error, float(least)
    share = 100.0 * np.linalg.norm(residual) / np.linalg.norm(direct)
    why = "is not that of modes" if only else "may be rigid-body motion, which outputs of other quantities do not show"
    warnings.warn(
        f"{share:.0f} % of the direct term of accelerations {why}, and is left out of the rig; simulate by"
        " response() of the identified modes, or identify from accelerations alone",
        stacklevel=4,
    )
    return None


def _rigid_of_residual_term(
    identified: FrfModes, out: tuple[Channel, ...], pair: tuple[int, int] | None
) -> RigidTerm | None:
    """The residual term of modes below the band, where it is rigid-body motion: where it dominates the lowest line."""
    order, hz = np.array([MEASURED[channel.quantity][1] for channel in out])[:, None], identified.frequencies_hz
    above = identified.upper_residual[:, :, None] * (2.0 * np.pi * hz) ** order[:, :, None]
    if (share := np.linalg.norm(above) / np.linalg.norm(identified.fitted)) > RIGID_SHARE:
        warnings.warn(
            f"modes above {hz[-1]:.4g} Hz contribute {100.0 * share:.0f} % of the response, and are left out of the"
            " rig; identify up to a higher line",
            stacklevel=4,
        )
    below, error = identified.lower_residual, identified.lower_residual_std
    least = float(RIGID_ERRORS * np.linalg.norm(error))
    share = np.linalg.norm(below * (2.0 * np.pi * hz[0]) ** (order - 2)) / np.linalg.norm(identified.fitted[:, :, 0])
    if np.linalg.norm(below) <= least or share <= NEGLIGIBLE:
        return None
    if share > DOMINANT and (pair is None or below[pair] > 0):
        warnings.warn(
            f"the motion below the lowest line, {hz[0]:.4g} Hz, is taken for rigid-body modes at 0 Hz; if the structure"
            " is supported, identify from a lower line",
            stacklevel=4,
        )
        return below, error, max(least, RIGID_SHARE * float(np.linalg.norm(below)))
    warnings.warn(
        f"modes below the lowest line, {hz[0]:.4g} Hz, rigid or elastic, contribute {100.0 * share:.0f} % of the"
        " response there, and are left out of the rig; identify from a lower line",
        stacklevel=4,
    )
    return None


def _rigid_modes(rigid_term: RigidTerm, pair: tuple[int, int] | None) -> tuple[np.ndarray, np.ndarray]:
    """Shapes of the rigid modes that the inputs excite, and standard errors, (n_rigid, n_outputs + n_inputs) each."""
    term, error, least = rigid_term
    u, sizes, v = np.linalg.svd(term, full_matrices=False)
    count = next(k for k in range(1, sizes.size + 1) if np.linalg.norm(sizes[k:]) <= least)
    if count > 1:
        warnings.warn(
            f"the measurement shows {count} rigid modes: responses to these inputs are right, those to masses, springs"
            " or forces elsewhere are not; for these take the rigid modes from the body's mass and inertia",
            stacklevel=4,
        )
    shape = _mass_normalised(np.einsum("jk,k,ki->kji", u, sizes, v)[:count], pair, None)
    rms = np.sqrt((error**2).mean(axis=1)), np.sqrt((error**2).mean(axis=0))
    norms = (np.linalg.norm(part, axis=1, keepdims=True) for part in (shape[:, len(term) :], shape[:, : len(term)]))
    return shape, np.hstack([own / norm for own, norm in zip(rms, norms)])


def _residues(modes: SampledModes, shapes: np.ndarray, participation: np.ndarray) -> np.ndarray:
    """Residues A_ji (n_modes, n_outputs, n_inputs) complex of displacement, for outputs of any quantity."""
    return np.asarray(np.einsum("jr,ri,r->rji", shapes, participation, 2j * modes.poles.imag))


def _mass_normalised(residues: np.ndarray, pair: tuple[int, int] | None, masses: np.ndarray | None) -> np.ndarray:
    """Shapes (n_modes, n_outputs + n_inputs) of the nearest real modes, mass-normalised where the scale is known.

    From real residues (n_modes, n_outputs, n_inputs), and `masses` (n_modes,) kg of shapes whose largest entry is 1.
    """
    left, sizes, right = np.linalg.svd(residues)
    root = np.sqrt(sizes[:, :1])
    at_out, at_in = left[:, :, 0] * root, right[:, 0] * root
    if pair is not None:
        ratio = np.abs(at_in[:, pair[1]] / np.where(at_out[:, pair[0]] == 0, np.nan, at_out[:, pair[0]]))
    elif masses is not None:
        ratio = 1.0 / (masses * np.abs(at_out).max(axis=1) ** 2)
    else:
        ratio = np.ones(len(residues))
    return np.hstack([at_out * np.sqrt(ratio)[:, None], at_in / np.sqrt(ratio)[:, None]])


def _propagated(identified: DrivenModes | FrfModes, values: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Covariance (n_modes, n_values, n_values) of values (n_modes, n_values) of the residues, to first order.

    Errors of ω_d are neglected, which are small against those of the shapes.
    """
    modes, errors = identified.modes, identified.vector_covariance
    m, q = modes.shapes.shape[0], identified.participation.shape[1]
    steps = STEP * symmetric_root(errors)
    largest = modes.shapes[np.abs(modes.shapes).argmax(axis=0), np.arange(modes.n_modes)]
    nominal = values(_residues(modes, modes.shapes, identified.participation))
    slopes = []
    for step in np.moveaxis(steps, 2, 0):
        shape, participation_step = step[:, :m].T * largest, step[:, m : m + q] + 1j * step[:, m + q :]
        changed = ((modes.shapes + sign * shape, identified.participation + sign * participation_step)
                   for sign in (1.0, -1.0))  # fmt: skip
        both = [values(_residues(modes, *each)) for each in changed]
        # the sign of a singular vector is arbitrary
        above, below = (f * np.where(np.sum(f * nominal, axis=1, keepdims=True) < 0, -1.0, 1.0) for f in both)
        slopes.append((above - below) / (2.0 * STEP))
    return np.asarray(np.einsum("kri,krj->rij", slopes, slopes))


def _shapes_of_outputs(identified: Any, out: tuple[Channel, ...], modal_masses: ArrayLike | None) -> Shapes:
    """Shapes at the outputs from output-only modes, scaled by modal masses."""
    modes = identified.modes
    if modal_masses is None:
        raise ValueError(
            "no input was measured, so the shapes have no scale; give modal_masses= for shapes whose largest entry is 1"
        )
    covariance = getattr(identified, "shape_covariance", None)
    error = np.zeros(1) if covariance is None else shape_errors(identified)
    _warn_of_complex(modes, far_from_real(modes), error, "shape")
    real = normalised_shapes(modes.shapes).real
    largest = real[np.argmax(np.abs(real), axis=0), np.arange(modes.n_modes)]
    root = np.sqrt(_masses(modal_masses, modes.n_modes))
    return _points(out), real / largest / root, None if covariance is None else covariance / root[:, None, None] ** 2


def _masses(modal_masses: ArrayLike, n_modes: int) -> np.ndarray:
    masses = np.broadcast_to(np.asarray(modal_masses, float), (n_modes,))
    if not (np.isfinite(masses).all() and (masses > 0).all()):
        raise ValueError(f"modal_masses must be positive, kg, one per mode; got {modal_masses!s}")
    return masses


def _warn_of_complex(modes: SampledModes, distance: np.ndarray, error: np.ndarray, what: str) -> None:
    """Warn of modes whose relative distance (n_modes,) from the nearest real mode is beyond its standard error."""
    for r in are_far(distance, error):
        warnings.warn(
            f"mode {r + 1} at {modes.frequencies_hz[r]:.4g} Hz is complex: the nearest real mode differs from its"
            f" {what} by {100 * distance[r]:.0f} %",
            stacklevel=4,
        )


def _driving_point(
    out: tuple[Channel, ...], into: tuple[Channel, ...], driving_point: tuple[str, str] | None
) -> tuple[int, int] | None:
    """Indices of an output and the input at its place; None where there is no driving point."""
    if driving_point is not None:
        input_names, output_names = ([channel.name for channel in side] for side in (into, out))
        if driving_point[0] not in input_names or driving_point[1] not in output_names:
            names = f"{', '.join(input_names)} and {', '.join(output_names)}"
            raise ValueError(f"driving_point is (input, output), of {names}")
        return output_names.index(driving_point[1]), input_names.index(driving_point[0])
    pairs = ((j, i) for j, measured in enumerate(out) for i, acting in enumerate(into)
             if measured.name == acting.name or (measured.at is not None and measured.at == acting.at))  # fmt: skip
    return next(pairs, None)


def _points(channels: Sequence[Channel]) -> NamedPoints:
    """The channels as named points, with positions where all have coordinates; motion is transverse, z on a plate."""
    names, at = tuple(channel.name for channel in channels), place_array([channel.at for channel in channels])
    if at.dtype == object or not np.isfinite(at).all():
        return NamedPoints(names)
    coordinates = at.reshape(len(names), -1)
    positions = np.hstack([coordinates, np.zeros((len(names), 3 - coordinates.shape[1]))])
    if at.ndim == 1:
        return NamedPoints(names, positions)
    turning = ("slope", "angular velocity", "moment")
    return NamedPoints(names, positions, tuple("" if c.quantity in turning else "z" for c in channels))
