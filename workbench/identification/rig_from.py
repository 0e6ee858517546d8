"""A rig from the modes that were identified on a bench: known at its inputs and outputs, and nowhere else."""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from workbench.arrays import symmetric_root
from workbench.identification.driven import Driven
from workbench.identification.signal.clocks import are_far, far_from_real, shape_errors
from workbench.identification.signal.modal_estimates import normalised_shapes, set_up_remarks
from workbench.identification.transfer import TransferModes
from workbench.records.record import Channel
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import MEASURED, Sensor
from workbench.structure.domain import NamedPoints, place_array
from workbench.structure.modes import Modes, PointShapes, SampledModes

# of the direct term of accelerations: what modes may leave of it, and standard errors of it, that are no rigid motion
LEFT, SURE = 0.1, 5.0
# of the response at the lowest line: what modes below it may make unsaid, and from what on they are rigid motion. Of a
# free beam it makes 1 there; the first mode of one that is held 0.03, where lines begin at four times its frequency
SLIGHT, MOST = 0.02, 0.5
STEP = 1e-3  # of a standard error: of the differences that its propagation takes


def rig_from(
    identified: Any,
    *,
    inputs: Sequence[Channel | str] | None = None,
    outputs: Sequence[Channel] | None = None,
    driving_point: tuple[str, str] | None = None,
    modal_masses: ArrayLike | None = None,
) -> Rig:
    """The rig of identified modes, each the nearest real one, mass-normalised where the scale is known.

    The residue of output j and input i at the pole λ is A_ji / (2 i ω_d), and A_ji = φ_j φ_i for a real mode: its
    nearest one is the largest singular value of Re A. The product is what a simulation needs. Its parts, to which
    masses and springs answer, follow from a driving point, where φ_i = φ_j, or from modal masses. What the modes leave
    of the direct term of accelerations, D - Σ_r φ_j φ_i, is the motion of a body that no spring holds: a mode at 0 Hz,
    as far as the inputs move it. Of transfer functions it is the residual term of modes below the band.

    Args:
        identified: of `identify_driven` or `identify_transfer`, or of `identify_ambient`, `ring_down` or `identify`,
            which tell no input.
        inputs: channels of the inputs: not needed from `identify_driven`; where no input was measured, the names of
            outputs where forces are to act.
        outputs: channels of the outputs, not needed from `identify_driven`.
        driving_point: an input and the output at its place; those of one name or place unless given.
        modal_masses: (n_modes,) kg, for shapes whose largest entry is 1; where there is no driving point.

    Returns:
        A rig at named points: each input and output is one, by its name. Its modes carry the covariance of frequencies,
        damping and shapes (of output-only modes that of shapes where it is known).

    Raises:
        ValueError: channels that are missing, shapes that nothing scales, a driving point where a mode would have a
            negative mass.

    Warns:
        UserWarning: modes far from real; modes that nothing scales, so that only responses to these inputs are right;
            several rigid modes, likewise; a direct term that is left out, as it is not of modes, or as not all outputs
            are accelerations; modes beyond the band of transfer functions that are left out, or taken as rigid.

    Source: Ewins, Modal Testing, 2nd ed., sections 2.4 and 4.4.
    """
    modes = identified.modes
    out = _channels(identified, "output_channels", outputs, modes.shapes.shape[0])
    measured = [channel.quantity for channel in out]
    for channel in out:
        if channel.quantity not in MEASURED:
            raise ValueError(
                f"output {channel.name!r} measures {channel.quantity or 'an unnamed quantity'}; give outputs= with one"
                f" of {', '.join(MEASURED)}"
            )
    if isinstance(identified, Driven | TransferModes):
        into = _channels(identified, "input_channels", inputs, identified.participation.shape[1])
        shapes = _of_residues(identified, out, into, driving_point, modal_masses)
        delays = identified.delays if isinstance(identified, Driven) else np.zeros(len(into))
        actuators = tuple(
            Actuator(c.name, c.name, kind="moment" if c.quantity == "moment" else "force", delay=float(delay))
            for c, delay in zip(into, delays, strict=True)
        )
    else:
        shapes = _of_shapes(identified, out, modal_masses)
        names = [channel if isinstance(channel, str) else channel.name for channel in inputs or ()]
        shapes.points.locate(names)
        actuators = tuple(Actuator(f"force at {name}", name) for name in names)
    noise = getattr(identified, "noise_std", [channel.noise_std or 0.0 for channel in out])
    late = identified.delays if isinstance(identified, TransferModes) else np.zeros(len(out))
    sensors = tuple(
        Sensor(c.name, c.name, quantity, noise_std=float(std), delay=float(delay))
        for c, quantity, std, delay in zip(out, measured, np.atleast_1d(noise), late, strict=True)
    )
    n = modes.n_modes
    # rigid modes stand behind the others
    omega, zeta = (np.append(figure, np.zeros(shapes.values.shape[1] - n)) for figure in (modes.omega, modes.zeta))
    covariance, known = np.zeros((2 * omega.size,) * 2), np.r_[:n, omega.size : omega.size + n]
    covariance[np.ix_(known, known)] = identified.covariance
    order = np.argsort(omega, kind="stable")
    both = np.r_[order, order + order.size]
    found = Modes(
        omega=omega[order],
        damping=zeta[order],
        shapes=PointShapes(shapes.values[:, order]),
        domain=shapes.points,
        covariance=covariance[np.ix_(both, both)],
        shape_covariance=None if shapes.covariance is None else shapes.covariance[order],
    )
    return Rig(found, actuators, sensors)


def _channels(identified: Any, name: str, given: Sequence[Channel | str] | None, count: int) -> tuple[Channel, ...]:
    records = getattr(identified, "records", ()) or getattr(identified, "correlations", ())
    found = given if given is not None else getattr(identified, name, getattr(next(iter(records), None), name, None))
    side = name.split("_")[0] + "s"
    if found is None:
        raise ValueError(f"{type(identified).__name__} does not keep its {side}; give {side}= with {count} channels")
    channels = tuple(Channel(c) if isinstance(c, str) else c for c in found)
    if len(channels) != count:
        raise ValueError(f"{side}= must name the {count} {side} of the identified modes; got {len(channels)}")
    return channels


@dataclass(frozen=True, eq=False)
class _Shapes:
    """Mass-normalised shapes (n_points, n_modes) and their covariance (n_modes, n_points, n_points), if it is known;
    rigid modes stand behind those identified."""

    values: np.ndarray
    points: NamedPoints
    covariance: np.ndarray | None


@dataclass(frozen=True, eq=False)
class _Below:
    """Σ φ_j φ_i of rigid modes and its standard errors, (n_outputs, n_inputs) each, and what of it is none."""

    left: np.ndarray
    error: np.ndarray
    least: float


def _of_residues(
    identified: Driven | TransferModes,
    out: tuple[Channel, ...],
    into: tuple[Channel, ...],
    driving_point: tuple[str, str] | None,
    modal_masses: ArrayLike | None,
) -> _Shapes:
    """Shapes at inputs and outputs, an input of the name of an output being the same point."""
    modes = identified.modes
    residues = _residues(modes, modes.shapes, identified.participation)
    sizes = np.linalg.svd(residues.real, compute_uv=False)
    cost = np.sqrt(np.maximum(1.0 - sizes[:, 0] ** 2 / np.sum(np.abs(residues) ** 2, axis=(1, 2)), 0.0))
    turned = np.linalg.norm(identified.participation_std, axis=1) / np.linalg.norm(identified.participation, axis=1)
    _warn_of_complex(modes, cost, np.hypot(shape_errors(identified), turned), "residues")
    for remark in set_up_remarks(identified):
        warnings.warn(remark, stacklevel=3)
    pair = _pair(out, into, driving_point)
    masses = None if modal_masses is None else _masses(modal_masses, modes.n_modes)
    at_out, at_in = np.split(_scaled(residues.real, pair, masses), [len(out)], axis=1)
    if pair is not None and not (at_out[:, pair[0]] * at_in[:, pair[1]] > 0).all():
        worst = int(np.argmin(at_out[:, pair[0]] * at_in[:, pair[1]]))
        raise ValueError(
            f"mode {worst + 1} at {modes.frequencies_hz[worst]:.4g} Hz has a negative mass at the driving point"
            f" ({into[pair[1]].name}, {out[pair[0]].name}): is a sensor turned round, or is the mode noise?"
        )
    if pair is None and masses is None:
        warnings.warn(
            "no output stands where an input acts, so the shapes have no scale: responses to these inputs are right,"
            " those to masses, springs or forces elsewhere are not; name an input and the output at its place as the"
            " driving point (driving_point, --driving-point), or give modal_masses",
            stacklevel=3,
        )
    rows = {channel.name: (channel, i) for i, channel in enumerate((*into, *out), start=-len(into))}
    kept = [i % (len(out) + len(into)) for _, i in rows.values()]
    spread = _spread(identified, lambda residues: _scaled(residues.real, pair, masses)[:, kept])
    values = np.hstack([at_out, at_in])[:, kept]
    if isinstance(identified, Driven):
        below = _left_of_direct(identified, out, pair, at_out.T @ at_in)
    else:
        below = _below_the_band(identified, out, pair)
    shape, error = _rigid(below, pair, len(out), len(into))
    values = np.vstack([values, shape[:, kept]])
    spread = np.concatenate([spread, [np.diag(row[kept] ** 2) for row in error]]) if len(error) else spread
    return _Shapes(values.T, _points([channel for channel, _ in rows.values()]), spread)


def _left_of_direct(
    identified: Driven, out: tuple[Channel, ...], pair: tuple[int, int] | None, elastic: np.ndarray
) -> _Below | None:
    """What the modes leave of the direct term of accelerations, where it is rigid motion.

    Args:
        identified: the modes and the direct term.
        out: of the rig.
        pair: indices of an output and the input at its place.
        elastic: (n_outputs, n_inputs) direct term of the accelerations of the other modes.
    """
    falls = np.array([channel.quantity == "acceleration" for channel in out])
    direct, error = identified.feedthrough[falls], identified.feedthrough_std[falls]
    left, least = direct - elastic[falls], max(LEFT * np.linalg.norm(direct), SURE * np.linalg.norm(error))
    if not direct.any() or np.linalg.norm(left) <= least:
        return None
    if falls.all() and (pair is None or left[pair] > 0):
        return _Below(left, error, float(least))
    share = 100.0 * np.linalg.norm(left) / np.linalg.norm(direct)
    why = "is not that of modes" if falls.all() else "may be rigid motion, which outputs of other kinds do not show"
    warnings.warn(
        f"{share:.0f} % of the direct term of accelerations {why}, and is left out of the rig; simulate by"
        " response() of what was identified, or identify from accelerations alone",
        stacklevel=4,
    )
    return None


def _below_the_band(identified: TransferModes, out: tuple[Channel, ...], pair: tuple[int, int] | None) -> _Below | None:
    """The residual term of modes below the band, where it is rigid motion: where it makes most of the lowest line.

    Args:
        identified: the modes and the residual terms.
        out: of the rig.
        pair: indices of an output and the input at its place.
    """
    order, hz = np.array([MEASURED[channel.quantity][1] for channel in out])[:, None], identified.frequencies_hz
    above = identified.upper_residual[:, :, None] * (2.0 * np.pi * hz) ** order[:, :, None]
    if (share := np.linalg.norm(above) / np.linalg.norm(identified.fitted)) > LEFT:
        warnings.warn(
            f"modes above {hz[-1]:.4g} Hz make {100.0 * share:.0f} % of the response, and are left out of the rig;"
            " identify up to a higher line",
            stacklevel=4,
        )
    below, error = identified.lower_residual, identified.lower_residual_std
    least = float(SURE * np.linalg.norm(error))
    share = np.linalg.norm(below * (2.0 * np.pi * hz[0]) ** (order - 2)) / np.linalg.norm(identified.fitted[:, :, 0])
    if np.linalg.norm(below) <= least or share <= SLIGHT:
        return None
    if share > MOST and (pair is None or below[pair] > 0):
        warnings.warn(
            f"what moves below the lowest line, {hz[0]:.4g} Hz, is taken for a body that no spring holds, a mode at"
            " 0 Hz; if the structure is held, identify from a lower line",
            stacklevel=4,
        )
        return _Below(below, error, max(least, LEFT * float(np.linalg.norm(below))))
    warnings.warn(
        f"modes below the lowest line, {hz[0]:.4g} Hz, rigid or elastic, make {100.0 * share:.0f} % of the response"
        " there, and are left out of the rig; identify from a lower line",
        stacklevel=4,
    )
    return None


def _rigid(below: _Below | None, pair: tuple[int, int] | None, m: int, q: int) -> tuple[np.ndarray, np.ndarray]:
    """Shapes of rigid modes, as far as the inputs move them, and standard errors, (n_rigid, n_outputs + n_inputs) each.

    Args:
        below: what they make, if anything.
        pair: indices of an output and the input at its place.
        m, q: number of outputs and of inputs.
    """
    if below is None:
        return np.zeros((0, m + q)), np.zeros((0, m + q))
    u, sizes, v = np.linalg.svd(below.left, full_matrices=False)
    count = next(k for k in range(1, sizes.size + 1) if np.linalg.norm(sizes[k:]) <= below.least)
    if count > 1:
        warnings.warn(
            f"the measurement shows {count} rigid modes: responses to these inputs are right, those to masses, springs"
            " or forces elsewhere are not; for these take the rigid modes from the body's mass and inertia",
            stacklevel=3,
        )
    shape = _scaled(np.einsum("jk,k,ki->kji", u, sizes, v)[:count], pair, None)
    rms = np.sqrt((below.error**2).mean(axis=1)), np.sqrt((below.error**2).mean(axis=0))
    norms = (np.linalg.norm(part, axis=1, keepdims=True) for part in (shape[:, m:], shape[:, :m]))
    return shape, np.hstack([own / norm for own, norm in zip(rms, norms)])


def _residues(modes: SampledModes, shapes: np.ndarray, participation: np.ndarray) -> np.ndarray:
    """A_ji (n_modes, n_outputs, n_inputs) complex, of displacement, whatever the outputs measure."""
    return np.asarray(np.einsum("jr,ri,r->rji", shapes, participation, 2j * modes.poles.imag))


def _scaled(residues: np.ndarray, pair: tuple[int, int] | None, masses: np.ndarray | None) -> np.ndarray:
    """Shapes (n_modes, n_outputs + n_inputs) of the nearest real modes, mass-normalised where the scale is known.

    Args:
        residues: (n_modes, n_outputs, n_inputs) real.
        pair: indices of an output and the input at its place.
        masses: (n_modes,) kg, for shapes whose largest entry is 1.
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


def _spread(identified: Driven | TransferModes, figures: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Covariance (n_modes, n_figures, n_figures) of what `figures` makes of residues, to first order.

    Errors of ω_d are left out: against those of shapes they are nothing.
    """
    modes, errors = identified.modes, identified.vector_covariance
    m, q = modes.shapes.shape[0], identified.participation.shape[1]
    steps = STEP * symmetric_root(errors)
    largest = modes.shapes[np.abs(modes.shapes).argmax(axis=0), np.arange(modes.n_modes)]
    middle = figures(_residues(modes, modes.shapes, identified.participation))
    slopes = []
    for step in np.moveaxis(steps, 2, 0):
        shape, turn = step[:, :m].T * largest, step[:, m : m + q] + 1j * step[:, m + q :]
        both = [
            figures(_residues(modes, modes.shapes + sign * shape, identified.participation + sign * turn))
            for sign in (1.0, -1.0)
        ]
        # a singular vector has no sign of its own
        above, below = (f * np.where(np.sum(f * middle, axis=1, keepdims=True) < 0, -1.0, 1.0) for f in both)
        slopes.append((above - below) / (2.0 * STEP))
    return np.asarray(np.einsum("kri,krj->rij", slopes, slopes))


def _of_shapes(identified: Any, out: tuple[Channel, ...], modal_masses: ArrayLike | None) -> _Shapes:
    modes = identified.modes
    if modal_masses is None:
        raise ValueError(
            "no input was measured, so the shapes have no scale; give modal_masses= for shapes whose largest entry is 1"
        )
    known = hasattr(identified, "shape_covariance")
    _warn_of_complex(modes, far_from_real(modes), shape_errors(identified) if known else np.zeros(1), "shape")
    real = normalised_shapes(modes.shapes).real
    largest = real[np.argmax(np.abs(real), axis=0), np.arange(modes.n_modes)]
    root = np.sqrt(_masses(modal_masses, modes.n_modes))
    relative = getattr(identified, "shape_covariance", None)
    return _Shapes(
        real / largest / root, _points(out), None if relative is None else relative / root[:, None, None] ** 2
    )


def _masses(modal_masses: ArrayLike, n_modes: int) -> np.ndarray:
    masses = np.broadcast_to(np.asarray(modal_masses, float), (n_modes,))
    if not (np.isfinite(masses).all() and (masses > 0).all()):
        raise ValueError(f"modal_masses must be positive, kg, one per mode; got {modal_masses!s}")
    return masses


def _warn_of_complex(modes: SampledModes, cost: np.ndarray, error: np.ndarray, what: str) -> None:
    """Warn of modes of which the nearest real one leaves a share, (n_modes,), that is neither small nor their error."""
    for r in are_far(cost, error):
        warnings.warn(
            f"mode {r + 1} at {modes.frequencies_hz[r]:.4g} Hz is complex: the nearest real mode leaves"
            f" {100 * cost[r]:.0f} % of its {what}",
            stacklevel=4,
        )


def _pair(
    out: tuple[Channel, ...], into: tuple[Channel, ...], driving_point: tuple[str, str] | None
) -> tuple[int, int] | None:
    """Indices of an output and the input at its place."""
    if driving_point is not None:
        acts = [channel.name for channel in into]
        reads = [channel.name for channel in out]
        if driving_point[0] not in acts or driving_point[1] not in reads:
            raise ValueError(f"driving_point is (input, output), of {', '.join(acts)} and {', '.join(reads)}")
        return reads.index(driving_point[1]), acts.index(driving_point[0])
    for j, measured in enumerate(out):
        for i, acting in enumerate(into):
            same_place = measured.at is not None and measured.at == acting.at
            if measured.name == acting.name or same_place:
                return j, i
    return None


def _points(channels: Sequence[Channel]) -> NamedPoints:
    """The channels as named points, with positions where all stand along an interval, or on a plate: it moves in z."""
    names, at = tuple(channel.name for channel in channels), place_array([channel.at for channel in channels])
    if at.dtype == object or not np.isfinite(at).all():
        return NamedPoints(names)
    coordinates = at.reshape(len(names), -1)
    positions = np.hstack([coordinates, np.zeros((len(names), 3 - coordinates.shape[1]))])
    if at.ndim == 1:
        return NamedPoints(names, positions)
    turning = ("slope", "angular velocity", "moment")
    return NamedPoints(names, positions, tuple("" if c.quantity in turning else "z" for c in channels))
