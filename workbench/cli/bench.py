"""`workbench bench`: an interactive page for designs."""

from pathlib import Path
from typing import Annotated

import typer

from workbench.cli.terminal import guarded, say


@guarded
def bench(
    rig: Annotated[
        Path | None,
        typer.Argument(
            help=r"Case folder, or TOML file with \[structure], \[\[input]], \[\[output]]; a hinged beam unless given."
        ),
    ] = None,
    port: Annotated[int, typer.Option(help="Port on 127.0.0.1; 0 for any free one.")] = 8321,
    show: Annotated[bool, typer.Option(help="Open the page in a browser.")] = False,
) -> None:
    """Try a design interactively: drag actuators and sensors, change gains, see the spillover at once.

    Example: workbench bench case.toml
    """
    import webbrowser

    from workbench.study.bench import bench_server
    from workbench.study.design_evaluation import read_structure

    found, text, units = read_structure(rig)
    with bench_server(found, text, units, port=port) as server:
        address = f"http://127.0.0.1:{server.server_address[1]}/"
        say(f"The bench is at {address}\n  designs are saved in studies/; end with Ctrl-C")
        if show:
            webbrowser.open(address)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            say("  ended")
