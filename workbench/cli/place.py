"""`workbench place`: actuator placement."""

import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from workbench.cli import options
from workbench.cli.design_options import impulse_place, place_in, read_structure_rig, typed_place
from workbench.cli.terminal import check_target, guarded, reporting, say, short, show_table, write_json
from workbench.structure.domain import Domain, Interval, NamedPoints, Place, Rectangle, middle, reach
from workbench.structure.printed import command_headings, in_unit, places_text

if TYPE_CHECKING:
    from workbench.design.placement.limits import Limits
    from workbench.design.placement.placement import PlacementTask
    from workbench.design.placement.task import Placement
    from workbench.records.units import Units
    from workbench.rig.rig import Rig

BEST = "best found"
SAME = 1e-6  # of the size: places nearer to each other than this are the same
LEAST_SPACING = 1 / 20  # default least spacing, over the size of the structure
WRITTEN = ("positions", "residual_work", "residual_work_by_mode", "effort", "peak_force", "condition", "status")
IN_JSON = {"residual_work_by_mode": "by_mode"}  # other names there


@guarded
def place(
    rig: options.RigPath,
    control: Annotated[
        int, typer.Option("--controlled-modes", help="Number of controlled modes, lowest first, and of actuators.")
    ],
    weight: options.Weight = 1.0,
    impulse_at: options.ImpulseAt = None,
    effort_ratio: Annotated[
        float,
        typer.Option(
            help="Effort limit, as a multiple of that of evenly spaced positions (beam) or of the rig's own actuators."
        ),
    ] = 1.5,
    spacing: Annotated[
        float | None,
        typer.Option(
            help="Least distance between the centres of actuators, m; default 1/20 of the structure's size, for patches"
            " on a beam their length. Patches on a plate may overlap, which is reported; their diagonal prevents it."
        ),
    ] = None,
    peak_force: Annotated[
        float, typer.Option(help="Force limit of each actuator, N; moment limit of patches, N m (N m/m on a plate).")
    ] = math.inf,
    condition: Annotated[float, typer.Option(help="Limit of the condition number of B (Frobenius).")] = math.inf,
    forbid: Annotated[
        list[str] | None, typer.Option(metavar="FROM:TO", help="Zone without actuators, m; X,Y:X,Y on a plate.")
    ] = None,
    at: Annotated[
        str | None, typer.Option(metavar="PLACES", help="Candidate places, m (X,Y;X,Y on a plate) or names.")
    ] = None,
    grid: Annotated[
        float | None, typer.Option(metavar="M", help="Spacing of a grid of candidates over a plate, m.")
    ] = None,
    certified_gap: Annotated[
        float | None,
        typer.Option(
            "--certify", metavar="GAP", help="Certify global optimality within this gap, a share such as 0.05."
        ),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option("--figure", help="Draw the placement to this file (.png, .svg, .pdf).")
    ] = None,
    json_path: options.JsonPath = None,
) -> None:
    """Place actuators, or the piezo patches of a rig, for the least spillover work within given limits.

    Example: workbench place case.toml --controlled-modes 3 --weight 20 --effort-ratio 1.2 --certify 0.05
    """
    from workbench.design.laws.law import DesignError
    from workbench.design.placement.certificate import certify
    from workbench.design.placement.limits import Limits
    from workbench.design.placement.placement import nodes_of_mode, placement_task
    from workbench.design.placement.placement import place_actuators as least_work
    from workbench.design.placement.task import SPREAD, extent, patch_of
    from workbench.rig.actuators import command_unit

    check_target(json_path, picture, figure=picture)
    if not effort_ratio > 0:
        raise ValueError(
            f"--effort-ratio is a multiple, above 0, of the effort at evenly spaced positions or the rig's; got"
            f" {effort_ratio:g}"
        )
    if spacing is not None and not 0 <= spacing < math.inf:
        raise ValueError(f"--spacing must be 0 or more; got {spacing:g}")
    if certified_gap is not None and not 0 < certified_gap < 1:
        raise ValueError(f"--certify is a share between 0 and 1; got {certified_gap:g}")
    found, units = read_structure_rig(rig)
    modes, impulse_point = found.modes, impulse_place(found, impulse_at)
    if not modes.proportional:
        say("damping couples the modes: placements are compared without its coupling terms")
        modes = replace(modes, damping=np.diag(np.diag(modes.damping)))
    domain = modes.domain
    candidates = _candidates(domain, at, grid, units)
    if certified_gap is not None and isinstance(domain, Rectangle) and candidates is None:
        raise ValueError("--certify on a plate needs candidate places; give their spacing by --grid M, or --at PLACES")
    with reporting("placing actuators") as report:
        task = placement_task(modes, control, impulse_at=impulse_point, weight=weight, actuator=patch_of(found))
        unit_of_commands = command_unit([task.actuator])
        reference = _reference(task, found)
        least = 0.0 if isinstance(domain, NamedPoints) else max(LEAST_SPACING * domain.size, extent(task.actuator))
        limits = Limits(
            effort=effort_ratio * reference.effort,
            spacing=least if spacing is None else spacing,
            peak_force=peak_force,
            condition=condition,
            forbidden=tuple(_zone(domain, text, units) for text in forbid or ()),
            candidates=candidates,
        )
        try:
            best = least_work(task, limits)
        except DesignError as error:
            if "meets the limits" not in str(error):
                raise
            text = units.named(str(error))
            if "effort" in text:
                unit = in_unit(reference.effort, units.named(command_headings(unit_of_commands)[0]))
                text += f"; --effort-ratio is a multiple of {unit}, that of actuators {reference.status}"
            raise DesignError(text) from error
        certificate = None
        if certified_gap is not None:

            def proving(bound: float, work: float, cells: int) -> None:
                share = bound / work
                done = min(share / (1.0 - certified_gap), 1.0)
                report(f"branch and bound: at least {share:.1%} of W_R, {cells:,} cells", 0.5 + 0.5 * done)

            certificate = certify(task, limits, placement=best, gap=certified_gap, progress=proving)
    rows = [best, reference]
    if isinstance(domain, Interval):
        nodes, (first, last) = nodes_of_mode(modes, control), task.reach
        if nodes.size == control and first <= nodes.min() and nodes.max() <= last:  # a patch may reach beyond the end
            rows.append(task.placed(nodes, f"nodes of mode {control + 1}"))
    named = dict(zip((BEST, *(row.status for row in rows[1:])), rows))
    if len(rows) > 2 and np.abs(rows[2].positions - reference.positions).max() < SAME * domain.size:
        named = {BEST: best, f"{reference.status}, {rows[2].status}": reference}
    shown = []
    for name, row in named.items():
        numbers = (row.residual_work, row.effort, row.peak_force, row.condition)
        shown.append((name, places_text(row.positions), *(f"{value:.5g}" for value in numbers)))
    where = domain.text(impulse_point, 6)
    say(f"{control} of {modes.n_modes} modes controlled, unit impulse at {where}, R = {weight:g}", bold=True)
    where = "points" if isinstance(domain, NamedPoints) else "positions [m]"
    headings = map(units.named, (where, "W_R [J]", *command_headings(unit_of_commands)))
    show_table(("placement", *headings, "condition number of B"), shown)
    say("  W_R: work of the actuators on the residual modes, which start at rest, without damping and over all time")
    say(f"  search: {best.status}")
    if best.overlapping:
        size = float(np.linalg.norm(2.0 * reach(domain, task.actuator.at)[0]))  # type: ignore[arg-type]
        say(f"  patches overlap; {SPREAD}: --spacing {size:.3g}")
    if certificate is not None:
        say(f"  {certificate.text(units.named('J'), units.length)}")
    if picture is not None:
        _draw(picture, task, {BEST: best, reference.status: reference}, limits, impulse_point, units)
    write_json(
        json_path,
        {
            "length": None if isinstance(domain, NamedPoints) else domain.length,
            "impulse_at": impulse_point,
            "weight": weight,
            "command_unit": unit_of_commands,
            "units": asdict(units),
            "controlled": list(range(1, control + 1)),
            "limits": {
                name: getattr(limits, name) for name in ("effort", "spacing", "peak_force", "condition", "forbidden")
            },
            "placements": [{IN_JSON.get(name, name): getattr(row, name) for name in WRITTEN} for row in rows],
            "lower_bound": None if certificate is None else certificate.lower_bound,
            "certified": certificate is not None and certificate.complete and certificate.better is None,
        },
    )


def _reference(task: "PlacementTask", rig: "Rig") -> "Placement":
    """The placement whose effort is the unit of --effort-ratio: evenly spaced along a member, else that of the rig."""
    n = task.n_controlled
    if isinstance(task.modes.domain, Interval):
        return task.placed(task.modes.length * np.arange(1, n + 1) / (n + 1), "evenly spaced")
    own = [middle(a.at) for a in rig.actuators if not a.direct]
    if len(own) != n:
        raise ValueError(
            f"--effort-ratio is relative to the rig's own actuators here, and there are {len(own)} for {n} modes:"
            f" describe {n} [[input]] of kind actuator"
        )
    found = task.placed(own, "of the rig")
    if not math.isfinite(found.effort):
        raise ValueError(
            "the rig's own actuators cannot control these modes (B is singular), so --effort-ratio has no reference:"
            " move one off the nodal lines"
        )
    return found


def _candidates(domain: Domain, at: str | None, grid: float | None, units: "Units") -> tuple[Place, ...] | None:
    """The places of --grid, or of --at, separated by semicolons on a plate, else by commas; None without both."""
    if grid is not None:
        if not isinstance(domain, Rectangle):
            raise ValueError("--grid is for a plate; name candidate places by --at, or leave --grid out")
        if at is not None:
            raise ValueError("--grid and --at both name candidate places; leave one of them out")
        widest = 0.5 * min(domain.length)
        if not 0.0 < grid <= widest:
            raise ValueError(
                f"--grid must be between 0 and half the shorter side, {widest:g} {units.length}; got {grid:g}"
            )
        return domain.grid(round(max(domain.length) / grid))
    if at is None:
        return None
    parts = at.split(";" if isinstance(domain, Rectangle) else ",")
    if isinstance(domain, Interval):
        try:
            [float(part) for part in parts]
        except ValueError:
            raise ValueError(f"--at takes places separated by commas, such as 0.1,0.25,0.4; got {at!r}") from None
    return tuple(dict.fromkeys(place_in(domain, part, "--at") for part in parts))


def _zone(domain: Domain, text: str, units: "Units") -> tuple[Place, Place]:
    ends = text.split(":")
    if len(ends) != 2:
        example = "0.1,0.2:0.3,0.4" if isinstance(domain, Rectangle) else "0.2:0.3"
        raise ValueError(f"--forbid takes FROM:TO in {units.length}, such as {example}; got {text!r}")
    low, high = (typed_place(domain, end, "--forbid") for end in ends)
    return low, high


def _draw(
    path: Path,
    task: "PlacementTask",
    placements: "dict[str, Placement]",
    limits: "Limits",
    impulse_point: Place,
    units: "Units",
) -> None:
    """Draw the placements along a member or over the nodal lines of a plate; at points, the best one's work by mode."""
    from workbench.draw.placement import plot_member_placement, plot_placement, plot_surface_placement

    options: Any = {"limits": limits, "impulse_at": impulse_point, "units": units}
    if isinstance(task.modes.domain, NamedPoints):
        figure = plot_placement(next(iter(placements.values())), units=units)
    elif isinstance(task.modes.domain, Rectangle):
        figure = plot_surface_placement(task, placements, **options)
    else:
        figure = plot_member_placement(task, placements, **options)
    figure.savefig(path)
    say(f"  figure     {short(path)}")
