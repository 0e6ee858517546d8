"""The report of `workbench identify`: identified modes as a table, remarks and JSON."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from workbench.identification.ambient import AmbientModes, identify_ambient
from workbench.identification.driven import DrivenModes, identify_driven
from workbench.identification.free_decay.assumptions import AmplitudeDependence, ProportionalFit
from workbench.identification.frf import FrfModes, identify_frf
from workbench.identification.ring_down import RingDown, by_remark, ring_down
from workbench.identification.signal.data_quality import check_data_quality
from workbench.identification.signal.harmonics import MAINS_HZ
from workbench.identification.signal.modal_estimates import ModalEstimates, rounded, rows_of
from workbench.identification.signal.searches import SECONDS, STOPPED, Progress
from workbench.records.frequency_responses import FrequencyResponses
from workbench.records.record import Channel, Record
from workbench.structure.printed import counted

TURN = 2.0 * np.pi
UNLIKELY, MOST_MODES = 0.01, 40
IMPLAUSIBLE_DAMPING = 0.1  # damping ratio above which a mode of FRFs is doubtful
SURE = 3.0
LINES = 2049  # of the FRFs of a model, besides those about its modes
COLLINEAR = 0.8  # modal phase collinearity below which a shape counts as complex


@dataclass(frozen=True)
class IdentificationReport:
    """The report of an identification.

    Attributes:
        heading: describes the data.
        rows: one per mode, under `HEADINGS`; numbers to the second digit of their standard errors.
        lines: remarks.
        content: for JSON.
        decays: the free decays, or the correlation functions, that were fitted; empty for other data.
        fitted: FRFs of the model, at the fitted lines, or of driven records up to half the sample rate;
            None for other data.
    """

    heading: str
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[str, ...]
    content: dict[str, Any]
    decays: tuple[Record, ...] = ()
    fitted: FrequencyResponses | None = None


def identification_report(
    measured: Sequence[Record | FrequencyResponses],
    *,
    start: float | None = None,
    n_modes: int | None = None,
    ambient: bool = False,
    band_hz: tuple[float, float] | None = None,
    seconds: float = SECONDS,
    progress: Progress | None = None,
) -> IdentificationReport:
    """The report of the modes of FRFs or records.

    Records with inputs other than zero are driven; others are ambient with `ambient`, else free decays.

    Args:
        measured: records of the same sensors at one sample rate, or one set of FRFs.
        start: time from which records are used, s.
        n_modes: number of modes; the largest number for driven records and FRFs.
        ambient: whether unknown broadband forces drive the whole record.
        band_hz: lowest and highest line to fit, of FRFs.
        seconds: limit of processor time, after which the best result so far is reported.
        progress: as in `identify_driven`.

    Raises:
        ValueError: as `ring_down`, `identify_driven`, `identify_ambient`, `identify_frf`; two ambient records, or
            one with inputs; options of the other kind of data.
    """
    on: dict[str, Any] = {"seconds": seconds, "progress": progress}
    most = MOST_MODES if n_modes is None else n_modes
    frf = next((one for one in measured if isinstance(one, FrequencyResponses)), None)
    if frf is not None:
        if len(measured) > 1:
            raise ValueError(f"FRFs are identified from one file; got {len(measured)} files")
        if start is not None or ambient:
            raise ValueError("FRFs have no time: leave --start and --ambient out; --band-hz sets a band")
        on |= {"channels": frf.output_channels, "band_hz": band_hz, "max_modes": most}
        return of_frfs(identify_frf(frf.values, frf.frequencies_hz, **on), frf)
    if band_hz is not None:
        raise ValueError("--band-hz is for FRFs; for a record, resample it or identify all its modes")
    records = [one for one in measured if isinstance(one, Record)]
    if not ambient and not any(record.inputs.any() for record in records):
        return of_ring_down(ring_down(records, start=start, n_modes=n_modes, **on))
    if start is not None:
        records = [record.between(start) for record in records]
    for record in records:
        check_data_quality(record)
    if not ambient:
        return of_driven(identify_driven(records, max_modes=most, **on), records)
    if len(records) > 1 or records[0].n_inputs:
        remedy = "give one file" if len(records) > 1 else "leave --ambient out, to identify from the inputs"
        raise ValueError(
            f"ambient identification needs one record without inputs; got {counted(len(records), 'record')} with"
            f" {counted(records[0].n_inputs, 'input')}: {remedy}"
        )
    return of_ambient(identify_ambient(records[0], n_modes=n_modes, **on), records[0])


def of_ring_down(decay: RingDown) -> IdentificationReport:
    """The report of free decays."""
    found = decay.refined
    lines = [*by_remark(decay.remarks), *decay.notes, *_proportional(decay.proportional), *decay.by_amplitude.remarks]
    if decay.noise_modes.n_modes:
        rejected = ", ".join(f"{f:.4g}" for f in decay.noise_modes.frequencies_hz)
        lines.append(f"rejected as noise or as part of another mode: {rejected} Hz")
    lines += _on_convergence(found.converged, lines, "try other --modes, or a later --start")
    damping = decay.proportional
    content = {
        **_content(decay.records[0].output_channels, found),
        "start": [record.start_time for record in decay.records],
        "remarks": decay.remarks,
        "depends_on_amplitude": _by_amplitude(decay.by_amplitude),
        "proportional_damping": None if damping is None else {
            "g1": damping.damping.stiffness,
            "g2": damping.damping.mass,
            "standard_errors": damping.standard_errors,
            "standardised_residuals": damping.standardised_residuals,
            "probability": damping.probability,
        },
        "noise_modes_hz": decay.noise_modes.frequencies_hz,
        "noise_std": found.noise_std,
        "notes": decay.notes,
        "converged": found.converged,
    }  # fmt: skip
    return _report(decay.records, found, lines, content, decay.records)


def of_driven(found: DrivenModes, records: Sequence[Record]) -> IdentificationReport:
    """The report of driven records."""
    lines = [*found.remarks, *_on_convergence(found.converged, found.remarks, "try other --modes")]
    a, b, c, d = (getattr(found.state_space, name) for name in "ABCD")
    content = {
        **_content(records[0].output_channels, found),
        "inputs": [channel.name for channel in found.input_channels],
        "delays": found.delays,
        "state_space": {"A": a, "B": b, "C": c, "D": d},
        "noise_std": found.noise_std,
        "converged": found.converged,
    }
    return replace(_report(records, found, lines, content), fitted=_model_of(found))


def _model_of(found: DrivenModes) -> FrequencyResponses:
    """The FRFs of the model as those of records are: with the hold of the inputs, and their delays."""
    dt, hertz = found.sample_time, found.modes.frequencies_hz
    nyquist, width = 0.5 / dt, found.modes.zeta * hertz
    # as close about a peak as it is narrow
    about = (hertz[:, None] + width[:, None] * np.linspace(-4.0, 4.0, 33)).ravel()
    lines = np.unique(np.r_[np.linspace(0.0, nyquist, LINES), about])
    lines = lines[(lines > 0.0) & (lines < nyquist)]
    s = 1j * TURN * lines
    hold = {"zero": "zoh", "first": "foh"}.get(found.input_hold)
    model, at = (found.state_space, s) if hold is None else (found.state_space.sample(dt, hold), np.exp(s * dt))
    late = np.exp(-s * found.delays[:, None])
    names = tuple(channel.name for channel in found.input_channels)
    return FrequencyResponses(model(at, squeeze=False) * late, lines, found.output_channels, names)


def _on_convergence(converged: bool, remarks: Sequence[str], remedy: str) -> list[str]:
    """A line if a search did not converge; none if it reached its time limit, which has a remark of its own."""
    stopped = any(remark.startswith(STOPPED) for remark in remarks)
    return [] if converged or stopped else [f"the search did not converge: {remedy}"]


def of_ambient(found: AmbientModes, record: Record) -> IdentificationReport:
    """The report of a record under unknown broadband forces."""
    lines = ["poles by canonical variate analysis, standard errors by jackknife over parts of the record"]
    lines += found.remarks
    return _report([record], found, lines, _content(record.output_channels, found), found.correlations)


def of_frfs(found: FrfModes, measured: FrequencyResponses) -> IdentificationReport:
    """The report of FRFs."""
    remedy = "try other --modes, or a narrower --band-hz"
    lines = [*found.remarks, *_on_convergence(found.converged, found.remarks, remedy)]
    broad = np.flatnonzero(found.modes.zeta > IMPLAUSIBLE_DAMPING)
    if broad.size:
        which = ", ".join(str(r + 1) for r in broad)
        lines.append(f"modes {which}: implausibly damped; they may fit the residual, not the structure")
    at, complex_shape = found.modes.frequencies_hz, found.modes.phase_collinearity < COLLINEAR
    doubtful = np.zeros(at.size, bool)
    for low, high in found.order_limited_hz:
        here = (at >= low) & (at <= high)
        doubtful |= here & complex_shape
        lines.append(
            f"between {low:.6g} and {high:.6g} Hz the search reached its limit on the number of modes with the"
            f" residual above the noise: {(here & complex_shape).sum()} of the {here.sum()} modes there are not"
            " reported, as their shapes are complex (low phase collinearity). Roving sensors or hammers, or a structure"
            " that changes, make the data inconsistent: exclude the band by --band-hz, or allow more --modes"
        )
    for r, parts in enumerate(found.cluster_hz):
        if parts:
            others = ", ".join(f"{f:.4g}" for f in parts)
            lines.append(
                f"mode {r + 1} is a cluster, with other members at {others} Hz: data of roving sensors or hammers are"
                " inconsistent there, or the mode drifts or depends on amplitude; closer modes are not resolved"
            )
    doubt = SURE * found.omega_std / TURN + float(np.diff(found.frequencies_hz).min())
    hums = np.zeros(at.size, bool)
    for mains in MAINS_HZ:
        near = np.abs(at - mains * np.round(at / mains)) < np.minimum(doubt, 0.02 * mains)
        hum = complex_shape & (at > 0.5 * mains) & near
        lines += [f"mode {r + 1}: a multiple of {mains:g} Hz: mains hum?" for r in np.flatnonzero(hum)]
        hums |= hum
    unexplained = np.flatnonzero(complex_shape & ~doubtful & ~hums)
    if unexplained.size:
        lines.append(
            f"modes {', '.join(str(r + 1) for r in unexplained)}: complex shapes (low phase collinearity); either"
            " damping couples close modes, or data of roving sensors or hammers are inconsistent, and several of these"
            " modes are the same"
        )
    band, channels = found.frequencies_hz, counted(found.modes.n_outputs, "output")
    heading = f"FRFs of {channels} and {counted(len(measured.references), 'input')}"
    heading += f", {band.size} lines from {band[0]:.6g} to {band[-1]:.6g} Hz"
    content = {
        **_content(measured.output_channels, found),
        "references": measured.references,
        "participation_real": found.participation.real,
        "participation_imag": found.participation.imag,
        "misfit": found.misfit,
        "doubtful": doubtful,
        "cluster_hz": found.cluster_hz,
        "order_limited_hz": found.order_limited_hz,
        "converged": found.converged,
    }
    rows = [row for row, doubt in zip(rows_of(found), doubtful) if not doubt]
    fitted = replace(measured, values=found.fitted, frequencies_hz=band)
    return IdentificationReport(heading, tuple(rows), tuple(lines), content, fitted=fitted)


def _report(
    records: Sequence[Record],
    found: ModalEstimates,
    lines: Sequence[str],
    content: dict[str, Any],
    decays: tuple[Record, ...] = (),
) -> IdentificationReport:
    first, samples = records[0], sum(record.n_samples for record in records)
    of = f" in {len(records)} records" if len(records) > 1 else ""
    since = f" from {first.start_time:.6g} s on" if len(records) == 1 else ""
    heading = f"{counted(first.n_outputs, 'sensor')}, {samples} samples{of} at {first.sample_rate_hz:.6g} Hz{since}"
    return IdentificationReport(heading, tuple(rows_of(found)), tuple(lines), content, decays)


def _content(channels: Sequence[Channel], found: ModalEstimates) -> dict[str, Any]:
    modes = found.modes
    return {
        "sensors": [channel.name for channel in channels],
        "positions": [channel.at for channel in channels],
        "frequencies_hz": modes.frequencies_hz,
        "frequencies_std_hz": found.omega_std / TURN,
        "damping_ratios": modes.zeta,
        "damping_std": found.zeta_std,
        "shapes_real": modes.shapes.real,
        "shapes_imag": modes.shapes.imag,
        "phase_collinearity": modes.phase_collinearity,
    }


def _proportional(fit: ProportionalFit | None) -> list[str]:
    if fit is None or fit.standardised_residuals.size < 3:
        return []
    if fit.probability < UNLIKELY:
        worst = float(np.abs(fit.standardised_residuals).max())
        return [f"damping is not Rayleigh damping: ζ deviates from (α/ω + β ω)/2 by up to {worst:.0f} standard errors"]
    values = fit.damping.stiffness, fit.damping.mass
    (beta, beta_std), (alpha, alpha_std) = map(rounded, values, fit.standard_errors)
    return [f"damping may be Rayleigh damping: α = {alpha} ± {alpha_std} 1/s, β = {beta} ± {beta_std} s"]


def _by_amplitude(segments: AmplitudeDependence) -> dict[str, Any]:
    """Estimates by segment of the modes that depend on amplitude, for JSON, by number of the mode."""
    content = {}
    for r in np.flatnonzero(segments.depends):
        seen = np.flatnonzero(np.isfinite(segments.omega[:, r]))
        content[str(r + 1)] = {
            "record": segments.record[seen],
            "amplitude": segments.amplitude[seen, r],
            "frequencies_hz": segments.omega[seen, r] / TURN,
            "frequencies_std_hz": segments.omega_std[seen, r] / TURN,
            "damping_ratios": segments.zeta[seen, r],
            "damping_std": segments.zeta_std[seen, r],
        }
    return content
