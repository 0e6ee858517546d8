"""What the tests of the commands share."""

from collections.abc import Callable

import pytest
from click.testing import Result
from typer.testing import CliRunner

from workbench.cli.app import app


@pytest.fixture(scope="session")
def run() -> Callable[..., Result]:
    """Runs the command with arguments of any type."""

    def invoke(*arguments: object) -> Result:
        return CliRunner().invoke(app, [str(argument) for argument in arguments])

    return invoke
