"""The report page of a study that has run, of a case folder, or of a JSON file that the command wrote."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from workbench.cases.case import read_case
from workbench.design.loop.closed_loop import DRIFTS, stability
from workbench.draw.design import plot_poles, plot_work_linear
from workbench.draw.gap import plot_gaps, plot_responses, units_of_inputs
from workbench.draw.identification import plot_deviations, plot_mac, stabilisation_diagram
from workbench.draw.motion import mode_motion
from workbench.draw.placement import plot_places
from workbench.draw.signals import frequency_response, plot_coherence, plot_frf_matrix, plot_spectra
from workbench.identification.free_decay.ibrahim import stabilise, stable_modes
from workbench.records.frequency_responses import FrequencyResponses
from workbench.records.record import Record
from workbench.records.units import Units
from workbench.structure.domain import place_array, same_place
from workbench.structure.modes import SampledModes, mac
from workbench.structure.printed import command_headings, counted, joined_in_words, places_text
from workbench.study.catalogue import find_study, output_root
from workbench.study.pages.identification_report import IdentificationReport
from workbench.study.pages.inputs_at_once import responses_to_inputs
from workbench.study.pages.page import (
    FORMAT,
    PageContent,
    Table,
    block,
    checks_of,
    page_content_of,
    short,
    tables_of,
    to_its_error,
)
from workbench.study.pages.verdict_page import STANDING_OF, case_inputs, moving_modes, verdict_tables
from workbench.study.runs.cases import StudyError

TURN = 2.0 * np.pi
MOST_BYTES = 200_000_000
MOST_SAMPLES = 4096  # of each decay, in the stabilisation diagram
EXTRA_ORDERS = 8  # highest model order of the diagram, above the number of modes
SAMPLES_PER_ORDER = 8  # at least
MOST_SENSORS = 6  # whose frequency responses are drawn
INVISIBLE = 0.005  # standard error over the range of the values, below which its bar is shorter than a dot
ROBUSTNESS = "share of perturbed models stable"
STABLE = (
    "Stabilisation diagram: the poles of models of each order. Dots, on the bands of stable modes, agree with them in"
    " frequency and shape; crosses do not."
)


def page_content_about(what: str) -> tuple[str, PageContent]:
    """The name and the page content of a JSON file, a case folder, or a study by name.

    Raises:
        StudyError: none of these, a study that has not run here, or a file with other content.
    """
    path = Path(what)
    if path.is_dir():
        return path.resolve().name, case_page_content(path)
    if path.suffix == ".json":
        return path.name.removesuffix(".json").removesuffix(".page"), page_content_in(path)
    study = find_study(what)
    kept = output_root(study) / "out" / f"{study.name}.page.json"
    if not kept.is_file():
        raise StudyError(f"study {study.name} has no page here yet; run it: workbench study {what}")
    return study.name, page_content_in(kept)


def case_page_content(folder: Path) -> PageContent:
    """The page of a case before any diagnosis: the nominal modes, and the records beside the nominal responses."""
    case = read_case(folder)
    rig, records = case.rig, (*case.fit, *case.validation)
    caption = "Measured beside the nominal model, at the sensor and in the segment where they differ most."
    rows = [
        (r.name, "fit" if r in case.fit else "validate", r.n_samples, r.sample_rate_hz, float(r.inputs.std()))
        for r in records
    ]
    level = f"input rms [{units_of_inputs(rig.actuators, case.units)}]"
    modes = list(zip(range(1, rig.modes.n_modes + 1), rig.modes.frequencies_hz.tolist(), rig.modes.zeta.tolist()))
    responses = plot_responses({"nominal": rig}, records, time_unit=case.units.time)
    rate, frequency = map(case.units.named, ("sample rate [Hz]", "frequency [Hz]"))
    return PageContent(
        title=f"Case {case.name}, before any diagnosis",
        lines=(f"{len(rig.actuators)} inputs, {len(rig.sensors)} sensors, {len(records)} records.",),
        blocks=[*moving_modes(rig, {"nominal": rig.modes}, units=case.units), block(responses, caption)],
        tables=[
            ("Records", ("record", "use", "samples", rate, level), rows),
            ("Nominal modes", ("mode", frequency, "damping ratio"), modes),
        ],
        inputs=case_inputs(folder),
        made_by=f"workbench report {folder}",
    )


def page_content_in(path: Path) -> PageContent:
    """The page content stored in a JSON file, or made from its results.

    Raises:
        StudyError: the file does not exist, is not JSON, or has other content.
    """
    if not path.is_file():
        raise StudyError(f"{path}: there is no such file")
    if path.stat().st_size > MOST_BYTES:
        raise StudyError(f"{path} has {path.stat().st_size} bytes; a report reads at most {MOST_BYTES}")
    try:
        content = json.loads(path.read_text(encoding="utf-8"), parse_constant=_finite, parse_float=_finite)
    except (ValueError, RecursionError) as error:
        raise StudyError(f"{path} cannot be read as JSON: {error}") from error
    if isinstance(content, list):
        content = {path.stem: content}
    if not isinstance(content, dict):
        raise StudyError(f"{path} holds a {type(content).__name__}; a report needs an object or a list of rows")
    if "format" in content:
        if content["format"] != FORMAT:
            raise StudyError(f"{path} has the format {content['format']!r:.60}; this workbench reads {FORMAT!r}")
        return page_content_of(content)
    write = next((write for key, write in KINDS.items() if key in content), _anything)
    try:
        parts = write(content)
    except (KeyError, TypeError, AttributeError, ValueError, IndexError, ArithmeticError) as error:
        looks = (write.__doc__ or "").rstrip(".")
        raise StudyError(f"{path} looks like {looks[:1].lower()}{looks[1:]}, but is damaged: {error!r:.120}") from error
    page_content = {"title": path.stem.replace("_", " "), "tables": _tables(content), **parts}
    return PageContent(made_by=f"workbench report {path.name}", **page_content)


def _finite(digits: str) -> float:
    value = float(digits)
    if not np.isfinite(value):
        raise ValueError(f"{digits} is not a JSON number")
    return value


def _tables(content: Mapping[str, Any]) -> list[Table]:
    single = [[name, value] for name, value in content.items() if isinstance(value, str | int | float | bool)]
    return [*([("Figures", ("name", "value"), single)] if single else []), *tables_of(content)]


def _words(lines: list[str]) -> list[str]:
    if not isinstance(lines, list) or not all(isinstance(line, str) for line in lines):
        raise TypeError(f"{lines!r:.60} is not a list of texts")
    return lines


def _verdict(content: dict[str, Any]) -> dict[str, Any]:
    """A verdict."""
    gap = {name: dict(values) for name, values in content["gap"].items()}
    return {
        "title": f"Diagnosis of {content['case']}",
        "lead": _words([content["sentence"]])[0],
        "standing": STANDING_OF.get(content.get("outcome", ""), ""),
        "lines": _words([*content.get("notes", []), *filter(None, [content.get("next_experiment")])]),
        "blocks": [block(plot_gaps(gap), "The gap before and after, over the noise floor.")] if gap["before"] else [],
        "tables": verdict_tables(content),
    }


def identified(content: dict[str, Any]) -> dict[str, Any]:
    """The modes of a record."""
    shapes = np.array(content["shapes_real"], float) + 1j * np.array(content["shapes_imag"], float)
    hertz = np.array(content["frequencies_hz"], float)
    if not (np.isfinite(shapes).all() and np.isfinite(hertz).all()):
        raise ValueError("a shape or frequency is not finite")
    given = content.get("positions") or [None] * len(shapes)
    places = place_array([None if at is None else same_place(at) for at in given])
    modes = SampledModes(TURN * hertz, np.array(content["damping_ratios"], float), shapes, places)
    hertz_std, zeta_std = (np.array(content[n], float) for n in ("frequencies_std_hz", "damping_std"))
    names = [f"mode {r + 1}" for r in range(hertz.size)]
    damping = plot_deviations(names, 100.0 * modes.zeta, 100.0 * zeta_std, "damping [%]")
    heads = ("mode", "frequency [Hz]", "std [Hz]", "damping [%]", "std [%]")
    blocks = [block(damping, f"Damping of each mode, ± 2 standard errors.{_short_bars(modes.zeta, zeta_std)}")]
    if len(shapes) > 1:  # one sensor gives no shape
        moving = mode_motion({"identified": modes}, std={"identified": (hertz_std, zeta_std)})
        numbered = "" if modes.on_interval or modes.on_plate else ", numbered as in the record"
        blocks.insert(0, block(moving, f"The identified shapes at the sensors{numbered}, with phase."))
    if len(shapes) > 1 and hertz.size > 1:
        criterion = plot_mac(mac(modes.shapes, modes.shapes))
        blocks.append(block(criterion, "Modal assurance criterion of each pair of modes."))
    rows = [
        [r + 1, *to_its_error(float(f), float(f_std)), *to_its_error(float(100.0 * zeta), float(100.0 * error))]
        for r, (f, f_std, zeta, error) in enumerate(zip(hertz, hertz_std, modes.zeta, zeta_std, strict=True))
    ]
    return {
        "lead": "; ".join([_band(hertz), *filter(None, _words([content.get("heading", "")]))]),
        "lines": _words(content.get("lines", [])),
        "blocks": blocks,
        "tables": [("Modes", heads, rows)],
    }


def _short_bars(values: np.ndarray, std: np.ndarray) -> str:
    """A sentence where bars of ± 2 standard errors are too short to be seen beside the differences of the values."""
    if not (values.size > 1 and (values != 0.0).all() and std.max() < INVISIBLE * np.ptp(values)):
        return ""
    largest = 100.0 * float((std / np.abs(values)).max())
    return f" The bars are shorter than the dots: no standard error is above {largest:.2g} % of its value."


def _band(hertz: np.ndarray) -> str:
    """How many modes, and between which frequencies, such as: 6 modes from 4.995 to 124.1 Hz."""
    if hertz.size < 2:
        return f"1 mode at {hertz[0]:.4g} Hz" if hertz.size else "no mode"
    return f"{counted(hertz.size, 'mode')} from {hertz.min():.4g} to {hertz.max():.4g} Hz"


def _designed(content: dict[str, Any]) -> dict[str, Any]:
    """A comparison of control laws."""
    laws, units = content["laws"], _units_of(content)
    controlled = content.get("controlled", ())
    first = 0 if 0 in controlled else 1  # files of earlier versions count modes from zero
    works, poles, rows = {}, {}, []
    for law in laws:
        name = law["law"]
        works[name] = np.array([w for r, w in enumerate(law["work"], first) if r not in controlled], float)
        poles[name] = _poles_of(law)
        figures = [*(law[key] for key in ("cost", "effort", "peak_force")), works[name].sum()]
        rows.append([name, *map(short, figures), law.get("stability", stability(poles[name]))])
    through = [one for one in content.get("through_sensors", ()) if "stable" in one]
    sensed = [
        [
            one["design"],
            short(one["decay_rate"] if "decay_rate" in one else one["margin"]),  # margin: files of earlier versions
            _stability_of(one),
            *_words([one.get("limited_by", ""), one.get("path", "")]),
            "" if one.get("robustness") is None else one["robustness"],
        ]
        for one in through
    ]
    rate = units.named("decay rate, -max Re λ [1/s]")
    heads = ("controller", rate, "loop", "limiting residual mode, Re λ", "path", ROBUSTNESS)
    filled = [i for i in range(len(heads)) if i < 3 or any(row[i] != "" for row in sensed)]
    sensed = [[row[i] for i in filled] for row in sensed]
    seen = {one["design"]: _poles_of(one) for one in through if "poles_real" in one}
    loops = [(str(row[0]), str(row[-1])) for row in rows] + [(str(row[0]), str(row[2])) for row in sensed]
    unstable = [name for name, found in loops if found.startswith("unstable")]
    work = plot_work_linear(works, first=len(controlled), units=units)
    blocks = [
        block(work, "Spillover work of each law in each residual mode."),
        block(plot_poles(poles), "Closed-loop poles, every modal coordinate known."),
    ]
    if seen:
        blocks.append(block(plot_poles(seen), "Closed-loop poles with sensors, including those of the estimators."))
    headings = map(units.named, (*command_headings(str(content.get("command_unit", "N"))), "W_R [J]"))
    tables: list[Table] = [("Laws", ("law", "cost", *headings, "loop"), rows)]
    if sensed:
        tables.append(("With sensors", tuple(heads[i] for i in filled), sensed))
    return {
        "title": "Control design",
        "lead": "" if not sensed else _stability(loops),
        "standing": "" if not sensed else "bad" if len(unstable) == len(loops) else "part" if unstable else "good",
        "blocks": blocks,
        "tables": tables,
    }


def _poles_of(row: Mapping[str, Any]) -> np.ndarray:
    return np.array(row["poles_real"], float) + 1j * np.array(row["poles_imag"], float)


def _stability_of(loop: Mapping[str, Any]) -> str:
    """The stability of a loop with sensors, in words; files of earlier versions have its poles at most."""
    by_poles = stability(_poles_of(loop)) if "poles_real" in loop else "stable" if loop["stable"] else "unstable"
    return str(loop.get("stability", by_poles))


def _stability(loops: Sequence[tuple[str, str]]) -> str:
    """The sentence on the stability of loops, (name, stability) each."""
    unstable = [name for name, found in loops if found.startswith("unstable")]
    rest = len(loops) - len(unstable)
    stable = sum(found == "stable" for _, found in loops)
    undamped = "has no pole right of the imaginary axis; undamped modes leave poles on it"
    if not unstable:
        return "Every closed loop is stable on the full plant." if stable == rest else f"Every closed loop {undamped}."
    if not rest:
        drifts = all(found == DRIFTS for _, found in loops)
        return f"Every closed loop is unstable on the full plant{': a rigid-body mode drifts' if drifts else ''}."
    others = "are stable" if stable == rest else "have no pole right of the imaginary axis"
    return f"Unstable on the full plant: {', '.join(unstable)}. The other {rest} loops {others}."


def _placed(content: dict[str, Any]) -> dict[str, Any]:
    """Actuator placements."""
    placements, units = content["placements"], _units_of(content)
    names = ["best found", *(str(one["status"]) for one in placements[1:])]
    places = {name: np.array(one["positions"]) for name, one in zip(names, placements, strict=True)}
    are_points = next(iter(places.values())).dtype.kind == "U"
    works = {n: np.array(one["by_mode"], float) for n, one in zip(names, placements, strict=True)}
    figures = ("residual_work", "effort", "peak_force", "condition")
    rows = [
        [name, *(short(one[key]) for key in figures), places_text(places[name])]
        for name, one in zip(names, placements, strict=True)
    ]
    first, bound = placements[0]["residual_work"], content.get("lower_bound")
    energy, found = units.named("J"), joined_in_words([_place_words(at, units) for at in placements[0]["positions"]])
    proof = "" if bound is None else f" No placement within the limits has W_R below {float(bound):.4g} {energy}."
    lead = f"Actuators at {found} leave spillover work W_R = {float(first):.4g} {energy}.{proof}"
    impulse_at, zones = content.get("impulse_at"), content.get("limits", {}).get("forbidden", ())
    lines = [f"The search: {placements[0]['status']}."]
    if impulse_at is not None:
        lines.insert(0, f"Unit impulse at {_place_words(impulse_at, units)}.")
    if zones:
        ends = [" to ".join(_place_words(end, units) for end in zone) for zone in zones]
        lines.insert(-1, f"Forbidden zone{'s' * (len(ends) > 1)}: {joined_in_words(ends)}.")
    work = plot_work_linear(works, first=len(content.get("controlled", ())), units=units)
    blocks = [block(work, "Spillover work of each placement in each residual mode.")]
    if not are_points:
        where = plot_places(places, content.get("length"), forbidden=zones, impulse_at=impulse_at, units=units)
        drawn = ["Positions of the actuators", *["the place of the impulse"] * (impulse_at is not None)]
        drawn += ["the forbidden zones, grey"] * bool(zones)
        blocks.insert(0, block(where, f"{joined_in_words(drawn)}."))
    numbers = ("W_R [J]", *command_headings(str(content.get("command_unit", "N"))), "condition number of B")
    headings = ("placement", *map(units.named, (*numbers, "points" if are_points else "positions [m]")))
    return {
        "title": "Actuator placement",
        "lead": lead,
        "standing": "good" if content.get("certified", bound is not None) else "",
        "lines": lines,
        "blocks": blocks,
        "tables": [("Placements", headings, rows)],
    }


def _place_words(at: Any, units: Units) -> str:
    """A place in words: a name, "0.34 m" or "(0.34, 0.5) m"."""
    if isinstance(at, str):
        return at
    numbers = ", ".join(f"{float(x):.3g}" for x in np.atleast_1d(at))
    return f"({numbers}) {units.length}" if np.ndim(at) else f"{numbers} {units.length}"


def _units_of(content: Mapping[str, Any]) -> Units:
    return Units(**content.get("units", {}))


def _studied(content: dict[str, Any]) -> dict[str, Any]:
    """The results of a study."""
    tables = tables_of({name: value for name, value in content.items() if name != "checks"})
    return {"lines": _words(content.get("found", [])), "tables": [*tables, *checks_of(content["checks"])]}


def _anything(content: dict[str, Any]) -> dict[str, Any]:
    """A table."""
    if not _tables(content):
        raise ValueError("it has no rows of named numbers")
    return {}


KINDS: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
    "sentence": _verdict,
    "shapes_real": identified,
    "laws": _designed,
    "placements": _placed,
    "checks": _studied,
}


def identification_page(
    report: IdentificationReport, measured: Sequence[Record | FrequencyResponses], *, made_by: str
) -> PageContent:
    """The page of an identification report and its data; FRFs are shown over the fitted band."""
    content = identified({**report.content, "heading": report.heading, "lines": list(report.lines)})
    blocks = [*content.pop("blocks"), *_stabilisation(report), *_response(measured, report.fitted)]
    return PageContent(title="Identified modes", blocks=blocks, made_by=made_by, **content)


def _stabilisation(report: IdentificationReport) -> list[dict[str, Any]]:
    decays = [replace(decay, outputs=decay.outputs[:, :MOST_SAMPLES]) for decay in report.decays]
    shortest = min((decay.n_samples for decay in decays), default=0)
    highest = min(len(report.rows) + EXTRA_ORDERS, shortest // SAMPLES_PER_ORDER)
    if highest < 2:
        return []
    diagram = stabilise(decays, orders=range(1, highest + 1))
    figure = stabilisation_diagram(diagram, stable_modes(diagram).modes, 0.5 * decays[0].sample_rate_hz)
    return [block(figure, STABLE)]


def _response(every: Sequence[Record | FrequencyResponses], fitted: FrequencyResponses | None) -> list[dict[str, Any]]:
    measured, why_not = every[0], ""
    if isinstance(measured, FrequencyResponses):
        if fitted is not None:
            kept = np.isin(measured.frequencies_hz, fitted.frequencies_hz)
            measured = replace(measured, values=measured.values[..., kept], frequencies_hz=fitted.frequencies_hz)
        return [block(plot_frf_matrix(measured, fitted), "FRFs, measured and fitted (dashed).")]
    if measured.n_inputs == 1 and np.ptp(measured.inputs) and fitted is not None:
        names, left_out = measured.output_names[:MOST_SENSORS], measured.output_names[MOST_SENSORS:]
        beside = plot_frf_matrix(frequency_response(measured).select_outputs(names), fitted.select_outputs(names))
        rest = f" Not drawn: {', '.join(left_out)}." if left_out else ""
        measured_by = "Frequency response, measured by Welch's method, whose windows blunt sharp peaks"
        return [
            block(beside, f"{measured_by}, and of the identified modes (dashed).{rest}"),
            block(plot_coherence(measured.select_outputs(names)), "Coherence of each sensor with the input."),
        ]
    if measured.n_inputs > 1 and fitted is not None:
        shown, why_not = responses_to_inputs([one for one in every if isinstance(one, Record)], fitted)
        if shown:
            return shown
    caption = f"Power spectral density of {measured.name}, by Welch's method. {why_not}".rstrip()
    return [block(plot_spectra(measured), caption)]
