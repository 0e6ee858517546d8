"""`workbench design`: a comparison of control laws."""

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from workbench.cli import options
from workbench.cli.design_options import impulse_place, read_structure_rig
from workbench.cli.terminal import check_target, guarded, say, show_table, write_json
from workbench.structure.printed import command_headings

if TYPE_CHECKING:
    from workbench.design.spillover.explain import Explanation
    from workbench.records.units import Units
    from workbench.rig.rig import Rig

PERIODS = 20  # default final time of the work, in periods of the first mode


@guarded
def design(
    rig: options.RigPath,
    control: options.Control = None,
    weight: options.Weight = 1.0,
    damping: Annotated[
        float | None, typer.Option(help="Also design by pole assignment, with this damping ratio.")
    ] = None,
    errors: Annotated[
        float | None, typer.Option(help="Robustness to a hundred models perturbed by this share; 0.05 is 5 %.")
    ] = None,
    impulse_at: options.ImpulseAt = None,
    final_time: Annotated[
        float | None, typer.Option(help=f"Time until which work is counted, s; {PERIODS} periods of mode 1.")
    ] = None,
    json_path: options.JsonPath = None,
) -> None:
    """Compare IMSC with coupled control: cost, effort, spillover, and stability on the full plant.

    With more modes than actuators only coupled control is possible.

    Example: workbench design case.toml --controlled-modes 3 --weight 20 --damping 0.2 --errors 0.05
    """
    import numpy as np

    from workbench.design.loop.closed_loop import impulse_state
    from workbench.design.spillover.performance import compare, laws_of, through_sensors
    from workbench.design.spillover.robustness import perturbed_modes, stable_share
    from workbench.rig.actuators import command_unit

    check_target(json_path)
    found, units = read_structure_rig(rig)
    actuators = [a for a in found.actuators if not a.direct]
    n = len(actuators) if control is None else control
    modes, at = found.modes, impulse_place(found, impulse_at)
    state = impulse_state(modes, at)
    state[modes.n_modes + n :] = 0.0
    perturbed = None if errors is None else perturbed_modes(modes, errors)
    laws, refused = laws_of(modes, n, actuators, weight=weight, damping=damping)
    elastic = modes.omega[modes.omega > 0]
    if final_time is None and not elastic.size:
        raise ValueError("without elastic modes the final time of the work has no default; give --final-time")
    end = PERIODS * 2.0 * np.pi / elastic[0] if final_time is None else final_time
    rows = compare(modes, laws, state, weight=weight, final_time=end)
    shown = []
    for row in rows:
        numbers = (row.cost, row.effort, row.peak_force, row.work.controlled_work, row.work.residual_work)
        most = "" if row.most_excited is None else f"mode {row.most_excited + 1}"
        shown.append((row.law.name, *(f"{value:.5g}" for value in numbers), most, row.stability))
    where, unit = modes.domain.text(at, 6), command_unit(actuators)
    say(f"{n} of {modes.n_modes} modes controlled, unit impulse at {where}, R = {weight:g}", bold=True)
    for why in refused:
        say(f"  {why}")
    headings = map(units.named, (*command_headings(unit), "W_C [J]", "W_R [J]"))
    show_table(("law", "cost", *headings, "largest W_r", "loop"), shown)
    say("  W_C, W_R: work of the actuators on the controlled and on the residual modes, W_r on mode r, until")
    say(f"  {end:.4g} {units.time}, with residual modes that start at rest and have their damping; cost and effort")
    say("  over all time")
    if {row.law.name for row in rows} >= {"IMSC", "coupled LQR"}:
        say("  R weights FᵀF in the cost and coupled LQR, but fᵀf of modal forces in IMSC: the ranking depends on")
        say("  masses and units; --damping compares the laws at equal poles")
    say("with displacement and velocity sensors at the places of the outputs:", bold=True)
    sensed = []
    for controller, explained, why in through_sensors(modes, laws, [s.at for s in found.sensors], found.structure):
        if controller is None or explained is None:
            say(f"  {why}")
        else:
            share = None if perturbed is None else stable_share(perturbed, controller)
            sensed.append(_sensed(controller.name, explained, found, units, share, len(perturbed or ())))
    heads = ["controller", units.named("decay rate, -max Re λ [1/s]"), "limiting residual mode, Re λ", "path"]
    if errors is not None and perturbed is not None:
        heads.append(f"stable of {len(perturbed)} models with {100 * errors:.3g} % error")
    show_table(heads, [row for row, _ in sensed])
    write_json(
        json_path,
        {
            "impulse_at": at,
            "weight": weight,
            "command_unit": unit,
            "units": asdict(units),
            "final_time": end,
            "controlled": list(range(1, n + 1)),
            "laws": [
                {
                    "law": row.law.name,
                    "gain": row.law.gain,
                    "cost": row.cost,
                    "effort": row.effort,
                    "peak_force": row.peak_force,
                    "work": row.work.work_by_mode,
                    "poles_real": row.poles.real,
                    "poles_imag": row.poles.imag,
                    "stability": row.stability,
                }
                for row in rows
            ],
            "through_sensors": [content for _, content in sensed],
        },
    )


def _sensed(
    name: str, explained: "Explanation", rig: "Rig", units: "Units", share: float | None, count: int
) -> tuple[list[str], dict[str, Any]]:
    """A controller that works through sensors, as a row of the table and as JSON; `share` of `count` is stable."""
    rate, stability = f"{explained.decay_rate:.3g}", explained.loop.stability
    limiting, path = _limit(explained, rig, units)
    row = [name, {"stable": rate, "unstable": f"{rate} unstable"}.get(stability, stability), limiting, path]
    return row + ([] if share is None else [str(round(share * count))]), {
        "design": name,
        "decay_rate": explained.decay_rate,
        "stable": not explained.loop.unstable_poles.size,
        "stability": stability,
        "limited_by": limiting,
        "path": path,
        "robustness": share,
        "poles_real": explained.poles.real,
        "poles_imag": explained.poles.imag,
    }


def _limit(explained: "Explanation", rig: "Rig", units: "Units") -> tuple[str, str]:
    """The residual mode that limits the decay rate, and the path through which it does, as text."""
    no_growth = not explained.loop.unstable_poles.size
    worst = explained.limiting if no_growth else explained.destabilising
    if worst is None and no_growth:
        return "none", ""
    if worst is None:
        return "none: unstable without residual modes" if explained.reduced_decay_rate <= 0 else "no single mode", ""
    grows = no_growth or worst.closed_pole.real > 0
    pole = f"{worst.closed_pole.real:+.3g} {units.named('1/s')}" if grows else "stable without this mode"
    at = worst.dominant.sensor_at
    names = [sensor.name for sensor in rig.sensors if sensor.at == at]
    return f"mode {worst.mode + 1}: {pole}", f"{', '.join(names)} → {worst.dominant.actuator}"
