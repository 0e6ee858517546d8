"""The `workbench` command: thin; it prints, shows progress, and turns bad input into one clear line."""

import json
import math
import warnings
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

BAD_INPUT, FAILURE = 2, 1
TURN = 2.0 * math.pi

JsonPath = Annotated[Path | None, typer.Option("--json", help="Write what was found here as JSON.")]

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="From the measured response of a flexible structure to a controlled one, and a diagnosis of the gap between"
    " simulation and test.",
)


def _version(asked: bool) -> None:
    if asked:
        from workbench.study.versions import versions

        for name, version in versions().items():
            typer.echo(f"{name:<16} {version}")
        raise typer.Exit()


@app.callback()
def _options(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Say versions.")] = False,
) -> None:
    """Options of the command itself."""


WIDE = 150  # columns of a table that goes to a file or a pipe
console = Console(soft_wrap=True, highlight=False)
if not console.is_terminal:
    console.width = WIDE
errors = Console(stderr=True, soft_wrap=True, highlight=False)


def _guarded(command: Callable) -> Callable:
    """Bad input ends in one line and exit code 2, anything unforeseen in one line and exit code 1."""

    @wraps(command)
    def guarded(*args, **kwargs):
        try:
            with warnings.catch_warnings():
                warnings.showwarning = _warned
                return command(*args, **kwargs)
        except typer.Exit:
            raise
        except (ValueError, OSError, MemoryError) as error:
            _tell(str(error))
            raise typer.Exit(BAD_INPUT) from None
        except KeyboardInterrupt:
            _tell("interrupted")
            raise typer.Exit(FAILURE) from None
        except Exception as error:
            _tell(f"{type(error).__name__}: {error}")
            raise typer.Exit(FAILURE) from None

    return guarded


def _tell(fault: str) -> None:
    errors.print(f"workbench: {_legible(fault)}", style="red", markup=False)


def _legible(text: str) -> str:
    """In one line, and without the signs by which a name of a file could steer the terminal."""
    return "".join(sign if sign.isprintable() else repr(sign)[1:-1] for sign in " ".join(text.split()))


def _warned(message, category, filename, lineno, file=None, line=None) -> None:
    """A warning in one line; those of arithmetic are for developers, its results are checked where they are used."""
    if not issubclass(category, RuntimeWarning):
        errors.print(f"workbench: {_legible(str(message))}", style="yellow", markup=False)


def _progress() -> Progress:
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        console=errors,
        transient=True,
        disable=not errors.is_terminal,
    )


@app.command()
@_guarded
def study(
    name: Annotated[
        str | None, typer.Argument(help="Name of a study, or path of its script; without it, a list.")
    ] = None,
    data: Annotated[Path | None, typer.Option(help="File or folder that the study works on.")] = None,
    every: Annotated[bool, typer.Option("--all", help="Run every study that makes its own data.")] = False,
    scheduler: Annotated[str | None, typer.Option(help="Dask scheduler that takes the cases: tcp://HOST:PORT.")] = None,
) -> None:
    """Run a study, or list them.

    Example: workbench study beam_control
    """
    from workbench.study.catalogue import find_study, list_studies

    if name is None and not every:
        entries = list_studies()
        width = max((len(entry.name) for entry in entries), default=0)
        for entry in entries:
            needs = f" (needs --data: {entry.needs_data})" if entry.needs_data else ""
            told = f"cannot be run: {entry.fault}" if entry.fault else f"{entry.question}{needs}"
            console.print(f"{entry.name:<{width}}  {told}", markup=False)
        return
    if name is None or every:
        chosen = [entry for entry in list_studies() if not entry.needs_data]
    else:
        chosen = [find_study(name)]
    # of several, one that fails keeps none of the others from running
    run = _run if len(chosen) == 1 else _run_of_several
    if not all([run(entry, data, scheduler) for entry in chosen]):
        raise typer.Exit(FAILURE)


def _run_of_several(found, data: Path | None, scheduler: str | None) -> bool:
    try:
        return _run(found, data, scheduler)
    except Exception as error:
        _tell(f"{found.name}: {type(error).__name__}: {error}")
        return False


def _run(found, data: Path | None, scheduler: str | None) -> bool:
    """Run one study, print what it found, and say whether its checks hold."""
    from workbench.study.catalogue import run_study
    from workbench.study.outcome import Outcome

    if found.fault:
        _tell(found.fault)
        return False

    root = found.path.resolve().parent.parent
    with _progress() as progress:
        cases = progress.add_task("cases", total=1.0, visible=False)

        def track(iterable, what):
            yield from progress.track(iterable, description=what, total=len(iterable))

        outcome = Outcome(
            name=found.name,
            title=found.question,
            figures_folder=root / "figures",
            # where both go to one terminal, the progress bar makes room for the line
            on_say=lambda text: (errors if console.is_terminal else console).print(f"  {text}", markup=False),
            on_track=track,
            on_report=lambda text, share: progress.update(cases, description=text, completed=share, visible=True),
            cache=root / "out" / "cache",
            scheduler=scheduler,
        )
        console.print(found.question, style="bold", markup=False)
        result, page = run_study(found, data, outcome, root)
    failed = [check for check in outcome.checks if not check["holds"]]
    console.print(f"  {len(outcome.checks) - len(failed)} of {len(outcome.checks)} checks hold")
    for check in failed:
        console.print(f"  does not hold: {check['name']}: {check['value']} against {check['limit']}", markup=False)
    broken = {name: found.failed for name, found in outcome.runs.items() if found.failed}
    for name, results in broken.items():
        console.print(f"  {len(results)} of {len(outcome.runs[name])} {name} failed; the first:", markup=False)
        console.print(f"    {dict(results[0].parameters)}: {results[0].error}", markup=False)
    for name in outcome.runs:
        console.print(f"  table   {_short(root / 'out' / f'{found.name}-{name}.csv')}", markup=False)
    for _, path, caption in outcome.figures:
        console.print(f"  figure  {_short(path)}  {caption}", markup=False)
    console.print(f"  results {_short(result)}\n  page    {_short(page)}", markup=False)
    return not failed and not broken


@app.command()
@_guarded
def identify(
    records: Annotated[list[Path], typer.Argument(help="Of the same sensors: .csv, .txt, .npz, .mat, .h5, .uff.")],
    modes: Annotated[int | None, typer.Option(help="How many modes; those above the noise unless given.")] = None,
    sample_rate_hz: Annotated[float | None, typer.Option(help="Where the file tells no time.")] = None,
    start: Annotated[
        float | None, typer.Option(help="Time from which it decays freely, s; found unless given.")
    ] = None,
    inputs: Annotated[str, typer.Option(help="Names of measured inputs, with commas between: driven by them.")] = "",
    ambient: Annotated[bool, typer.Option("--ambient", help="Driven by unknown broadband forces all along.")] = False,
    outputs: Annotated[str, typer.Option(help="Names of the outputs to read, with commas between; else all.")] = "",
    band_hz: Annotated[
        tuple[float, float] | None, typer.Option(help="Lowest and highest line of transfer functions to fit.")
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """Find the modes of ring-downs, driven records or transfer functions, each figure with its standard error.

    Example: workbench identify ringdown.csv --outputs a,b --json modes.json
    """
    from workbench.records.files import read_measured
    from workbench.study.identification_report import HEADINGS, told_of
    from workbench.study.whole_file import check_target

    check_target(json_path)
    read = [read_measured(path, sample_rate_hz=sample_rate_hz, inputs=_names(inputs)) for path in records]
    if outputs:
        read = [measured.only(_names(outputs)) for measured in read]
    told = told_of(read, start=start, n_modes=modes, ambient=ambient, band_hz=band_hz)
    shown = Table(box=None, pad_edge=False)
    for heading in HEADINGS:
        shown.add_column(heading, justify="right" if "[" in heading else "left", no_wrap=True)
    for row in told.rows:
        shown.add_row(*row)
    console.print(told.heading, style="bold", markup=False)
    console.print(shown)
    for line in told.lines:
        console.print(f"  {line}", markup=False)
    _write_json(json_path, told.content)


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


@app.command()
@_guarded
def design(
    rig: Annotated[Path, typer.Argument(help="TOML with [structure], [[input]] and [[output]], as a case has.")],
    control: Annotated[int | None, typer.Option(help="Modes to control, lowest first; as many as actuators.")] = None,
    weight: Annotated[float, typer.Option(help="Weight R of force against motion.")] = 1.0,
    damping: Annotated[
        float | None, typer.Option(help="Damping ratio that laws by poles give, beside the others.")
    ] = None,
    errors: Annotated[
        float | None, typer.Option(help="Try each on a hundred models as wrong as this, 0.05 is 5 %.")
    ] = None,
    impulse_at: Annotated[float | None, typer.Option(help="Place of a unit blow; the hammer's unless given.")] = None,
    final_time: Annotated[float | None, typer.Option(help="Time for the work, s; 20 periods of mode 1.")] = None,
    json_path: JsonPath = None,
) -> None:
    """Design IMSC beside coupled control: cost, effort, spillover, and on the full plant which mode is unsettled.

    With more modes than actuators only coupled control is to be had.

    Example: workbench design case.toml --control 3 --weight 20 --damping 0.2 --errors 0.05
    """
    from workbench.design.estimation.closed_loop import impulse_state
    from workbench.design.spillover.comparison import compare, laws_of, through_sensors
    from workbench.design.spillover.robustness import survival_of, wrong_by
    from workbench.study.whole_file import check_target

    check_target(json_path)
    found = _structure_rig(rig)
    actuators = [a for a in found.actuators if not a.direct]
    n = len(actuators) if control is None else control
    modes, at = found.modes, _blow(found, impulse_at)
    state = impulse_state(modes, at)
    state[modes.n_modes + n :] = 0.0
    wrong = None if errors is None else wrong_by(modes, errors)
    laws, refused = laws_of(modes, n, actuators, weight=weight, damping=damping)
    end = final_time or 20 * TURN / modes.omega[modes.omega > 0][0]
    rows = compare(modes, laws, state, weight=weight, final_time=end)
    shown = Table("law", "cost", "effort", "peak force", "W_C", "W_R", "feeds", box=None, pad_edge=False)
    for row in rows:
        figures = (row.cost, row.effort, row.peak_force, row.work.controlled_total, row.work.residual_total)
        feeds = "" if row.most_fed is None else f"mode {row.most_fed + 1}"
        shown.add_row(row.law.name, *(f"{value:.5g}" for value in figures), feeds)
    console.print(f"{n} of {modes.n_modes} modes controlled, unit blow at x = {at:g}, R = {weight:g}", style="bold")
    for why in refused:
        console.print(f"  {why}", markup=False)
    console.print(shown)
    mass = None if found.structure is None else found.structure.mass_per_length
    places = [s.at for s in found.sensors]
    tried = through_sensors(modes, laws, places, mass)
    console.print("displacement and velocity read at the sensors' places:", style="bold")
    heads = ["design", "margin [1/s]", "residual mode behind it", "by the path"]
    sensed = Table(*heads, *([] if errors is None else [f"stable, models {errors:.2g} off"]), box=None, pad_edge=False)
    shares = []
    for controller, explained, why in tried:
        if controller is None or explained is None:
            console.print(f"  {why}", markup=False)
            continue
        shares.append(None if wrong is None else survival_of(wrong, controller))
        survived = [] if shares[-1] is None else [f"{shares[-1]:.0%}"]
        margin = f"{explained.margin:.3g}" + ("" if explained.loop.stable else " unstable")
        sensed.add_row(controller.name, margin, *_behind(explained), *survived)
    console.print(sensed)
    _write_json(
        json_path,
        {
            "impulse_at": at,
            "weight": weight,
            "final_time": end,
            "controlled": list(range(n)),
            "laws": [
                {
                    "law": r.law.name,
                    "gain": r.law.gain,
                    "cost": r.cost,
                    "effort": r.effort,
                    "peak_force": r.peak_force,
                    "work": r.work.by_mode,
                    "poles_real": r.poles.real,
                    "poles_imag": r.poles.imag,
                }
                for r in rows
            ],
            "through_sensors": [
                {
                    "design": c.name,
                    "margin": e.margin,
                    "survived": share,
                    "poles_real": e.poles.real,
                    "poles_imag": e.poles.imag,
                }
                for (c, e, _), share in zip([t for t in tried if t[0] is not None], shares)
                if c is not None and e is not None
            ],
        },
    )


def _behind(explained) -> tuple[str, str]:
    """The residual mode that a margin is owed to, and the path by which it is."""
    worst = explained.culprit or (explained.moved[0] if explained.moved else None)
    if worst is None:
        return "", ""
    if not explained.loop.stable and explained.culprit is None:
        return "none: unstable without any" if explained.reduced_margin <= 0 else "no single one", ""
    grows = explained.loop.stable or worst.closed_pole.real > 0
    told = f"{worst.closed_pole.real:+.3g} 1/s" if grows else "stable without it"
    return f"mode {worst.mode + 1}: {told}", f"sensor at {worst.paths[0].sensor_at:g} to {worst.paths[0].actuator}"


@app.command()
@_guarded
def place(
    rig: Annotated[Path, typer.Argument(help="TOML with [structure], [[input]] and [[output]], as a case has.")],
    control: Annotated[int, typer.Option(help="Modes to control, lowest first, and actuators to place.")],
    weight: Annotated[float, typer.Option(help="Weight R of force against motion.")] = 1.0,
    impulse_at: Annotated[float | None, typer.Option(help="Place of a unit blow; the hammer's unless given.")] = None,
    effort: Annotated[float, typer.Option(help="Effort allowed, as a multiple of evenly spaced actuators'.")] = 1.5,
    spacing: Annotated[float | None, typer.Option(help="Least distance apart; a twentieth of the length.")] = None,
    peak_force: Annotated[float, typer.Option(help="Largest force of any actuator, N.")] = math.inf,
    condition: Annotated[float, typer.Option(help="Largest condition of B (Frobenius).")] = math.inf,
    forbid: Annotated[list[str] | None, typer.Option(help="Stretch FROM:TO without actuators; repeat.")] = None,
    at: Annotated[str | None, typer.Option(help="The only places there are: X,X,X,...; all choices are tried.")] = None,
    proof: Annotated[float | None, typer.Option(help="Prove the optimum global within this share, e.g. 0.05.")] = None,
    json_path: JsonPath = None,
) -> None:
    """Place actuators where control spills the least work, under the limits of a rig.

    Example: workbench place case.toml --control 3 --weight 20 --effort 1.2 --forbid 0.2:0.3 --proof 0.05
    """
    import numpy as np

    from workbench.design.placement.certificate import certify
    from workbench.design.placement.placement import nodes_of_mode, placement_task, scan
    from workbench.design.placement.placement import place as least_work
    from workbench.study.whole_file import check_target

    check_target(json_path)
    if proof is not None and not 0 < proof < 1:
        raise ValueError(f"--proof is a share between 0 and 1; got {proof:g}")
    found = _structure_rig(rig)
    modes, blow = found.modes, _blow(found, impulse_at)
    task = placement_task(modes, control, impulse_at=blow, weight=weight)
    even = task.placed(modes.length * np.arange(1, control + 1) / (control + 1), "evenly spaced")
    apart = modes.length / 20 if spacing is None else spacing
    limits: dict[str, Any] = {
        "effort_limit": effort * even.effort,
        "spacing": apart,
        "peak_limit": peak_force,
        "condition_limit": condition,
        "forbidden": [_stretch(s) for s in forbid or ()],
    }
    if at is not None:
        limits["candidates"] = _places(at, modes.length)
    best = least_work(task, **limits) if at is None else scan(task, **limits)[0]
    rows = [best, even]
    nodes = nodes_of_mode(modes, control)
    if nodes.size == control:
        rows.append(task.placed(nodes, f"nodes of mode {control + 1}"))
    shown = Table("places", "W_R", "effort", "peak force", "condition of B", "", box=None, pad_edge=False)
    for row in rows:
        where = ", ".join(f"{x:.4g}" for x in row.positions)
        figures = (row.residual_work, row.effort, row.peak_force, row.condition)
        shown.add_row(where, *(f"{value:.5g}" for value in figures), row.status)
    console.print(
        f"{control} of {modes.n_modes} modes controlled, unit blow at x = {blow:g}, R = {weight:g}", style="bold"
    )
    console.print(shown)
    proven = None
    if proof is not None:
        proven = certify(task, best, gap=proof, **limits)
        if proven.better is not None:
            where = ", ".join(f"{x:.4g}" for x in proven.better)
            console.print(f"  not the best there is: actuators at {where} spill less; ask again with them in mind")
        else:
            console.print(
                f"  no placement spills less than {1 - proven.gap:.1%} of this, shown on {proven.cells} cells"
            )
    keys = ("positions", "residual_work", "by_mode", "effort", "peak_force", "condition", "status")
    _write_json(
        json_path,
        {
            "placements": [{key: getattr(row, key) for key in keys} for row in rows],
            "lower_bound": None if proven is None else proven.lower_bound,
        },
    )


@app.command()
@_guarded
def diagnose(
    case: Annotated[Path, typer.Argument(help="Case folder: case.toml and its records.")],
    json_path: JsonPath = None,
    page: Annotated[Path | None, typer.Option(help="Write the page here; default out/CASE.html.")] = None,
    free_nominal: Annotated[
        bool, typer.Option("--free-nominal", help="The nominal frequencies and damping are known to be a little off.")
    ] = False,
    workers: Annotated[int | None, typer.Option(help="Processes that share the work; default one a core.")] = None,
) -> None:
    """Say where a simulation and a test disagree, which effect is missing, and how far the gap then shrinks.

    Example: workbench diagnose cases/arm --json verdict.json
    """
    from workbench.cases.case import read_case
    from workbench.gap.diagnose import diagnose as run
    from workbench.gap.effects.structural import known_places
    from workbench.study.verdict_page import verdict_page
    from workbench.study.whole_file import check_target, write_whole

    check_target(json_path)
    found = read_case(case)
    with _progress() as progress:
        task = progress.add_task("reading", total=1.0)
        verdict = run(
            found.rig,
            found.fit,
            validation=found.validation,
            name=found.name,
            free_nominal=free_nominal,
            workers=workers,
            report=lambda text, share: progress.update(task, description=text, completed=share),
        )
    console.print(verdict.sentence, style="bold", markup=False)
    shown = verdict.to_json()
    where = verdict.where
    console.print(
        f"  path       {where.path}; {'depends' if where.amplitude_dependent else 'does not depend'} on level"
    )
    console.print(f"  modes      {', '.join(map(str, where.modes)) or 'none'}")
    if where.path in ("structure", "environment") and known_places(found.rig) is None:
        if verdict.place_stands:
            console.print(f"  place      x = {where.at:.4g} ± {where.at_std:.1g} m, of one force of any law")
        elif where.place.holds is False:
            console.print("  place      the gap is not that of one force at a point")
    after, floor = shown["gap"]["after"], shown["gap"]["floor"]
    for name, before in shown["gap"]["before"].items():
        console.print(f"  {name:<10} gap {before:.4g} → {after[name]:.4g}, floor {floor[name]:.4g}")
    for label, probability in verdict.alternatives[:3]:
        console.print(f"  rival      {label} ({probability:.2g})", markup=False)
    for note in verdict.notes:
        console.print(f"  {note}", markup=False)
    if json_path is not None:
        write_whole(json_path, json.dumps(shown, indent=1, allow_nan=False) + "\n")
        console.print(f"  verdict    {_short(json_path)}", markup=False)
    target = verdict_page(verdict, found, page or Path("out") / f"{found.name}.html", folder=case)
    console.print(f"  page       {_short(target)}", markup=False)


@app.command()
@_guarded
def trial(
    case: Annotated[Path, typer.Argument(help="Case folder: its rig, sensors, levels and noise are taken.")],
    cases: Annotated[int, typer.Option(help="How many blind cases to make, diagnose and score.")] = 30,
    seed: Annotated[int, typer.Option(help="The same seed makes the same cases.")] = 0,
    json_path: Annotated[Path | None, typer.Option("--json", help="Write labels, verdicts and scores here.")] = None,
    picture: Annotated[Path, typer.Option(help="Where the confusion matrix is drawn.")] = Path("out/trial.png"),
) -> None:
    """Say how far a diagnosis can be trusted on your own rig: blind cases made, diagnosed and scored.

    Example: workbench trial cases/arm --cases 40
    """
    from workbench.cases.case import read_case
    from workbench.draw.trials import plot_confusion
    from workbench.study.whole_file import check_target
    from workbench.trials.hold import hold_trials

    check_target(json_path)
    if cases < 1:
        raise ValueError(f"--cases must be at least 1; got {cases}")
    found = read_case(case)
    with _progress() as progress:
        task = progress.add_task("making cases", total=1.0)
        held = hold_trials(
            cases,
            seed,
            like=found,
            report=lambda text, share: progress.update(task, description=text, completed=share),
        )
    for family, (right, of) in held.tally.shares.items():
        console.print(f"  {family:<8} {right} of {of} named rightly")
    console.print(f"  places   {held.tally.misplaced} of {held.tally.placed} more than 2 % of the length off")
    for name, one in held.scores.items():
        if not one["kinds"]:
            console.print(f"  {name}: hidden {one['hidden']}, told {one['told']}", markup=False)
    picture.parent.mkdir(parents=True, exist_ok=True)
    plot_confusion(held.tally).savefig(picture)
    if json_path is not None:
        _write_json(json_path, {"labels": held.labels, "verdicts": held.verdicts, "scores": held.scores})
    console.print(f"  picture  {_short(picture)}", markup=False)


@app.command()
@_guarded
def report(
    what: Annotated[str, typer.Argument(help="A JSON file of this command, a case folder, or a study that has run.")],
    page: Annotated[Path | None, typer.Option(help="Write the page here; default out/NAME.html.")] = None,
) -> None:
    """Make one page of a study, a case or a result: figures that zoom, motion that moves, no network needed.

    Example: workbench report verdict.json
    """
    from workbench.study.page import write_page
    from workbench.study.report import story_about

    name, story = story_about(what)
    console.print(story.title, style="bold", markup=False)
    if story.lead:
        console.print(f"  {story.lead}", markup=False)
    for line in story.lines:
        console.print(f"  {line}", markup=False)
    target = write_page(page or Path("out") / f"{name}.html", story)
    console.print(f"  page  {_short(target)}", markup=False)
    console.print(f"  data  {_short(target.with_suffix('.page.json'))}", markup=False)


@app.command()
@_guarded
def bench(
    rig: Annotated[
        Path | None, typer.Argument(help="TOML with [structure], [[input]], [[output]]; a hinged beam unless given.")
    ] = None,
    port: Annotated[int, typer.Option(help="Port on 127.0.0.1; 0 takes any that is free.")] = 8321,
    show: Annotated[bool, typer.Option(help="Open the page in a browser.")] = False,
) -> None:
    """Play with a design: drag actuators and sensors, move the gains, see at once what control spills.

    Example: workbench bench case.toml
    """
    import webbrowser

    from workbench.study.bench import bench_server
    from workbench.study.trying import read_structure

    found, text = read_structure(rig)
    with bench_server(found, text, port=port) as server:
        address = f"http://127.0.0.1:{server.server_address[1]}/"
        console.print(f"The bench is at {address}\n  designs are saved in studies/; end with Ctrl-C", markup=False)
        if show:
            webbrowser.open(address)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            console.print("  ended")


def _places(text: str, length: float) -> list[float]:
    try:
        places = sorted({float(x) for x in text.split(",")})
    except ValueError:
        raise ValueError(f"--at takes places between commas, such as 0.1,0.25,0.4; got {text!r}") from None
    if not all(0 <= x <= length for x in places):
        raise ValueError(f"--at names a place outside the structure, 0 to {length:g} m: {text}")
    return places


def _stretch(text: str) -> tuple[float, float]:
    try:
        low, high = (float(part) for part in text.split(":"))
    except ValueError:
        raise ValueError(f"a forbidden stretch is FROM:TO in m, as 0.2:0.3; got {text!r}") from None
    return low, high


def _structure_rig(path: Path):
    from workbench.cases.case import read_rig

    found = read_rig(path)
    if found.structure is None:
        raise ValueError(f"{path}: plain modal data know no places; describe the structure as a beam or a rod")
    return found


def _blow(rig, at: float | None) -> float:
    hammers = [a.at for a in rig.actuators if a.direct]
    if at is None and not hammers:
        raise ValueError("where is the structure struck? give --impulse-at, or an [[input]] of kind hammer")
    return hammers[0] if at is None else at


def _write_json(path: Path | None, content: dict) -> None:
    from workbench.study.outcome import plain
    from workbench.study.whole_file import write_whole

    if path is not None:
        write_whole(path, json.dumps(plain(content), indent=1, allow_nan=False) + "\n")
        console.print(f"  written to {_short(path)}", markup=False)


def _short(path: Path) -> str:
    try:
        return str(path.resolve().relative_to(Path.cwd()))
    except ValueError:
        return str(path)


def main() -> None:
    """Entry point of the command."""
    app()


if __name__ == "__main__":
    main()
