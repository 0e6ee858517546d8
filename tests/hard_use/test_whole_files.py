"""Reports stand whole in their place, or not at all."""

import os

import pytest
from typer.testing import CliRunner

from workbench.cli.app import app
from workbench.study.runs.whole_file import write_whole


def test_an_interrupted_report_leaves_the_one_before(tmp_path, monkeypatch):
    path = write_whole(tmp_path / "new" / "report.json", "first")
    with pytest.raises(UnicodeEncodeError):
        write_whole(path, "a" * 100_000 + "\ud800")  # fails on the way to the disk

    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", stopped)
    with pytest.raises(KeyboardInterrupt):
        write_whole(path, "second")
    assert path.read_text() == "first" and [*path.parent.iterdir()] == [path]


@pytest.mark.parametrize(
    "arguments", [("identify", "x.csv"), ("diagnose", "case"), ("trial", "case")], ids=lambda arguments: arguments[0]
)
def test_a_place_that_cannot_be_written_is_told_before_the_work(tmp_path, arguments):
    for target, words in ((tmp_path / "nowhere" / "x.json", "there is no folder"), (tmp_path, "is a folder")):
        result = CliRunner().invoke(app, [*arguments, "--json", str(target)])
        assert result.exit_code == 2 and words in result.output
