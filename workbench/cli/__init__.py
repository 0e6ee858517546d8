"""The `workbench` command, one file a command."""

from workbench.cli.app import main

__all__ = ["main"]
