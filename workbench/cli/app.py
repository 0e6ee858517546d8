"""The `workbench` command: its options and subcommands."""

from typing import Annotated

import typer

from workbench.cli.bench import bench
from workbench.cli.check import check
from workbench.cli.design import design
from workbench.cli.diagnose import diagnose
from workbench.cli.export import export
from workbench.cli.identify import identify
from workbench.cli.look import look
from workbench.cli.new import new
from workbench.cli.place import place
from workbench.cli.predict import predict
from workbench.cli.redesign import redesign
from workbench.cli.report import report
from workbench.cli.study import study
from workbench.cli.terminal import errors
from workbench.cli.trial import trial

# Former names of options, accepted for one more version.
RENAMED = {
    "mend": "correct",
    "as-wired": "uncorrected",
    "free-nominal": "uncertain-nominal",
    "proof": "certify",
    "picture": "figure",
    "validate": "validation",
    "control": "controlled-modes",
    "effort": "effort-ratio",
    "settle": "transient",
    "more-cost": "max-cost-increase",
    "more-work": "max-work-increase",
}


def current_option(name: str) -> str:
    """The present name of an option, with a notice on standard error if a former one is given."""
    if name not in RENAMED:
        return name
    errors.print(f"  --{name} is now --{RENAMED[name]}; the old name goes with the next version")
    return RENAMED[name]


app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["--help", "-h"], "token_normalize_func": current_option},
    help="Modal identification, vibration control and diagnosis of the gap between simulation and test, for flexible"
    " structures.",
)


def _version(wanted: bool) -> None:
    if wanted:
        from workbench.study.runs.versions import versions

        for name, version in versions().items():
            typer.echo(f"{name:<16} {version}")
        raise typer.Exit()


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show versions and exit.")
    ] = False,
) -> None:
    """Options of the command itself."""


COMMANDS = (look, identify, design, place, export, diagnose, redesign, predict, check, trial, study, report, bench, new)
for command in COMMANDS:
    app.command()(command)


def main() -> None:
    """Entry point of the command."""
    app()
