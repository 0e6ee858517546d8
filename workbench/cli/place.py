"""`workbench place`: actuator placement."""

import math
from typing import Annotated

import typer
from rich.table import Table

from workbench.cli.rig_file import ImpulseAt, RigPath, Weight, impulse_place, read_structure_rig
from workbench.cli.terminal import JsonPath, console, guarded, progress_bar, reporter, say, write_json

LEAST_SPACING = 1 / 20  # of the length, unless one is given
WRITTEN = ("positions", "residual_work", "by_mode", "effort", "peak_force", "condition", "status")


@guarded
def place(
    rig: RigPath,
    control: Annotated[int, typer.Option(help="Number of controlled modes, lowest first, and of actuators.")],
    weight: Weight = 1.0,
    impulse_at: ImpulseAt = None,
    effort: Annotated[
        float, typer.Option(help="Effort limit, as a multiple of that of evenly spaced actuators.")
    ] = 1.5,
    spacing: Annotated[float | None, typer.Option(help="Least distance between actuators, m; length/20.")] = None,
    peak_force: Annotated[float, typer.Option(help="Force limit of each actuator, N.")] = math.inf,
    condition: Annotated[float, typer.Option(help="Limit of the condition number of B (Frobenius).")] = math.inf,
    forbid: Annotated[
        list[str] | None, typer.Option(metavar="FROM:TO", help="Interval without actuators, m; may be repeated.")
    ] = None,
    at: Annotated[
        str | None, typer.Option(metavar="X,X,X", help="Candidate places, m: all combinations are evaluated.")
    ] = None,
    proof: Annotated[
        float | None, typer.Option(help="Prove the optimum global to within this share, such as 0.05.")
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """Place actuators for the least spillover work, within the limits of a rig.

    Example: workbench place case.toml --control 3 --weight 20 --effort 1.2 --forbid 0.2:0.3 --proof 0.05
    """
    import numpy as np

    from workbench.design.placement.certificate import certify
    from workbench.design.placement.limits import Limits
    from workbench.design.placement.placement import nodes_of_mode, placement_task
    from workbench.design.placement.placement import place as least_work
    from workbench.study.whole_file import check_target

    check_target(json_path)
    if proof is not None and not 0 < proof < 1:
        raise ValueError(f"--proof is a share between 0 and 1; got {proof:g}")
    found = read_structure_rig(rig)
    modes, struck = found.modes, impulse_place(found, impulse_at)
    with progress_bar() as progress:
        report = reporter(progress, "placing actuators")
        task = placement_task(modes, control, impulse_at=struck, weight=weight)
        even = task.placed(modes.length * np.arange(1, control + 1) / (control + 1), "evenly spaced")
        limits = Limits(
            effort=effort * even.effort,
            spacing=LEAST_SPACING * modes.length if spacing is None else spacing,
            peak_force=peak_force,
            condition=condition,
            forbidden=tuple(_interval(text) for text in forbid or ()),
            candidates=None if at is None else tuple(_places(at, modes.length)),
        )
        best = least_work(task, limits)
        certificate = None
        if proof is not None:
            wanted = 1.0 - proof

            def proving(bound: float, work: float, cells: int) -> None:
                share = bound / work
                report(f"proving: at least {share:.1%} of W_R, {cells:,} cells", 0.5 + 0.5 * min(share / wanted, 1.0))

            certificate = certify(task, limits, placement=best, gap=proof, progress=proving)
    rows = [best, even]
    nodes = nodes_of_mode(modes, control)
    if nodes.size == control:
        rows.append(task.placed(nodes, f"nodes of mode {control + 1}"))
    table = Table("places [m]", "W_R", "effort", "peak force", "condition of B", "", box=None, pad_edge=False)
    for row in rows:
        where = ", ".join(f"{x:.4g}" for x in row.positions)
        numbers = (row.residual_work, row.effort, row.peak_force, row.condition)
        table.add_row(where, *(f"{value:.5g}" for value in numbers), row.status)
    say(f"{control} of {modes.n_modes} modes controlled, unit impulse at x = {struck:g} m, R = {weight:g}", bold=True)
    console.print(table)
    if certificate is not None:
        say(f"  {certificate}")
    write_json(
        json_path,
        {
            "length": modes.length,
            "impulse_at": struck,
            "weight": weight,
            "controlled": list(range(control)),
            "placements": [{key: getattr(row, key) for key in WRITTEN} for row in rows],
            "lower_bound": None if certificate is None else certificate.lower_bound,
        },
    )


def _places(text: str, length: float) -> list[float]:
    try:
        places = sorted({float(x) for x in text.split(",")})
    except ValueError:
        raise ValueError(f"--at takes places between commas, such as 0.1,0.25,0.4; got {text!r}") from None
    if not all(0 <= x <= length for x in places):
        raise ValueError(f"--at names a place outside the structure, 0 to {length:g} m: {text}")
    return places


def _interval(text: str) -> tuple[float, float]:
    try:
        low, high = (float(part) for part in text.split(":"))
    except ValueError:
        raise ValueError(f"--forbid takes FROM:TO in m, such as 0.2:0.3; got {text!r}") from None
    return low, high
