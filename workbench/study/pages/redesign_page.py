"""The page of a redesign: the better controller for the real structure, with its uncertainty."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from workbench.design.loop.closed_loop import Response
from workbench.design.loop.rig_loop import LoopTest, run_loop
from workbench.draw.motion import response_motion
from workbench.draw.robust import NEW, OLD, plot_redesign, plot_steps
from workbench.draw.style import GREY, new_figure
from workbench.records.record import Record
from workbench.rig.actuators import Actuator
from workbench.robust.redesign import Redesign
from workbench.robust.steps import LOSS
from workbench.robust.verification import Verification, displacement_at, interval
from workbench.structure.domain import NamedPoints
from workbench.study.pages.page import PageContent, Table, block, write_page
from workbench.study.pages.verdict_page import case_inputs
from workbench.study.runs.outcome import Shown

MOST = 3000  # samples of a record that are simulated again
DRAWN_LIMIT = 4.0  # largest drawn modal displacement of the present loop, over that of the redesigned one
NEGLIGIBLE = 1e-4  # loss, relative to vibration and effort, up to which the figure of steps is omitted


def redesign_page(found: Redesign, path: Path, *, name: str, record: Record, folder: Path, made_by: str) -> Path:
    """Write the page of a case; the inputs of a measured record are applied as forces to both loops."""
    blocks = _replayed(found, record)
    test = found.test
    excitation = "the test"
    if test.impulse_at is not None:
        at = found.uncertain_rig.rig.modes.domain.text(test.impulse_at, 4)
        excitation = f"an impulse of {test.impulse:.3g} {found.units.named('N s')} at {at}"
    compared = (
        f"Both controllers after {excitation}, on the same draws of the uncertain model, including all"
        " dead zones, delays, friction and noise. The controller with the lower curve is better; a wide band means"
        " that the records leave much uncertain."
    )
    blocks.append(block(plot_redesign(found), compared))
    if max(s.loss for s in found.steps) > NEGLIGIBLE:
        caption = f"From the present controller to the redesigned one, step by step. {LOSS[0].upper()}{LOSS[1:]}."
        blocks.append(block(plot_steps(found), caption))
    steps = [(s.name, s.what, s.lost, s.in_new_controller) for s in found.steps]
    tables: list[Table] = [
        ("On the same draws: median (95 % interval)", ("", "present", "redesigned"), _figures(found)),
        ("Steps", ("step", "change", "performance loss", "in the new controller"), steps),
    ]
    used = found.verification if found.improves else found.present_verification
    moved = [] if found.relocation is None else [found.relocation.sentence]
    safe = "good" if found.safe and not found.spillover_warning else "part"
    page_content = PageContent(
        title=f"Redesign for {name}",
        lead=f"{found.advice} {found.guarantee}".rstrip(),
        standing="bad" if used.share_stable < 0.95 else safe,
        lines=[found.comparison, *moved, *found.notes],
        blocks=blocks,
        tables=tables,
        inputs=case_inputs(folder),
        made_by=made_by,
    )
    return write_page(path, page_content)


def _figures(found: Redesign) -> list[tuple[str, ...]]:
    old, new = found.present_verification, found.verification
    rows: list[tuple[str, ...]] = [("stable draws", *(f"{p.n_stable} of {p.n_draws}" for p in (old, new)))]
    for r in found.controlled:
        rows.append((f"damping ratio of mode {r + 1} [%]", *(_rounded(100.0 * p.damping[:, r]) for p in (old, new))))
    rows.append(("minimum damping ratio of all modes [%]", *(_rounded(100.0 * p.worst_damping) for p in (old, new))))
    each = {
        "controlled_settling": "settling time of the controlled modes [s]",
        "settling": "settling time of all modes [s]",
        "peak_force": "peak force [N]",
        "stroke": "largest displacement at an actuator [m]",
        "controlled_work": "work in controlled modes, W_C [J]",
        "residual_work": "work in residual modes, W_R [J]",
        "effort": "effort, ∫ FᵀF dt [N² s]",
    }
    for name, words in each.items():
        # for a growing motion the value depends on the length of the test
        cells = (_rounded(getattr(p, name)) if p.share_stable >= 0.5 else "diverges" for p in (old, new))
        rows.append((found.units.named(words), *cells))
    rows.append(("output uncertainty tolerated (small gain) [%]", *(_margin(p) for p in (old, new))))
    return rows


def _rounded(values: np.ndarray) -> str:
    middle, low, high = (f"{value:.3g}" for value in interval(values))
    return middle if low == high else f"{middle} ({low} to {high})"


def _margin(verification: Verification) -> str:
    margin = verification.small_gain_margin
    return "no linear bound" if np.isnan(margin) else f"{100.0 * margin:.3g}"


def _replayed(found: Redesign, record: Record) -> list[dict[str, Any]]:
    """Blocks of both loops on the corrected rig, with the inputs of a measured record as forces at the same places."""
    rig = found.uncertain_rig.rig
    step = found.test.sample_time
    if abs(record.sample_time / step - 1.0) > 1e-6:
        return []
    inputs = record.inputs[:, :MOST]
    exciters = tuple(Actuator(a.name, a.at, quantity=a.quantity, direction=a.direction) for a in rig.actuators)
    test = LoopTest(inputs.shape[1], step, forces=inputs, exciters=exciters, seed=found.test.seed)
    old, new = run_loop(rig, found.present, test), run_loop(rig, found.redesigned, test)
    if not (old.bounded or new.bounded):
        return []
    name = f" “{record.name}”" if record.name else ""
    caption = f"Under the inputs of the measured record{name}"
    shown, domain = [], rig.modes.domain
    if old.bounded and new.bounded and not (isinstance(domain, NamedPoints) and domain.positions is None):
        shown.append(_moving(found, old.response, new.response, caption))
    read = any(s.quantity == "displacement" for s in rig.sensors)
    where = "the sensor with the largest reading, and that measured without control" if read else "an actuator"
    readings = _readings(found, record, {"present": old.response, "redesigned": new.response})
    shown.append(block(readings, f"{caption}: the displacement at {where}."))
    return shown


def _moving(found: Redesign, old: Response, new: Response, caption: str) -> dict[str, Any]:
    scale = np.abs(new.modal[: new.modes.n_modes]).max()
    limit = DRAWN_LIMIT * scale
    limited = replace(old, modal=np.clip(np.nan_to_num(old.modal), -limit, limit))
    actuators = [a for a in found.uncertain_rig.rig.actuators if a.name in found.redesigned.actuators]
    sensors = [s for s in found.uncertain_rig.rig.sensors if s.name in found.redesigned.sensors]
    both, colours = {"present": limited, "redesigned": new}, {"present": OLD, "redesigned": NEW}
    units = {"length": found.units.length, "time": found.units.time}
    motion = response_motion(both, actuators=actuators, sensors=sensors, colours=colours, **units)
    grown = np.abs(old.modal[: old.modes.n_modes]).max() > limit
    cut = f" The present one diverges; its motion is clipped at {DRAWN_LIMIT:g} times the other's." if grown else ""
    return block(motion, f"{caption}: the corrected structure under the present and the redesigned controller.{cut}")


def _readings(found: Redesign, record: Record, responses: dict[str, Response]) -> Shown:
    rig = found.uncertain_rig.rig
    seen = [(i, s) for i, s in enumerate(rig.sensors) if s.quantity == "displacement"]
    figure, ax = new_figure(width=9, height=3.6)
    n = next(iter(responses.values())).time.size
    if seen:
        i, sensor = max(seen, key=lambda one: float(np.abs(record.outputs[one[0], :n]).max()))
        shape, name = rig.modes.phi_at(sensor.at, direction=sensor.direction), sensor.name
        look = {"color": GREY, "linewidth": 0.8, "label": "measured, without control"}
        ax.plot(record.time[:n], record.outputs[i, :n], **look)
    else:
        shape, name = displacement_at(rig.modes, rig.actuators[0]), f"at {rig.actuators[0].name}"
    for (label, response), colour in zip(responses.items(), (OLD, NEW), strict=True):
        reading = shape @ response.modal[: response.modes.n_modes]
        ax.plot(response.time, reading, color=colour, linewidth=1.0, label=label)
    limit = 1.3 * max(float(np.abs(line.get_ydata()).max()) for line in ax.lines if line.get_label() != "present")
    time, length = found.units.time, found.units.length
    ax.set(xlabel=f"time [{time}]", ylabel=f"displacement, {name} [{length}]", ylim=(-limit, limit))
    ax.legend(fontsize=8, ncols=3)
    return figure
