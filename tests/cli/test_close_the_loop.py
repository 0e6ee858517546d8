"""From a record to a controller that holds on the real structure: the commands of the page, in their order."""

import re
import shlex
from pathlib import Path

import pytest

PAGE = Path(__file__).resolve().parents[2] / "docs/how-to/close-the-loop.md"


@pytest.mark.slow
def test_the_commands_of_the_page_close_the_loop(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = PAGE.read_text(encoding="utf-8")
    exec(re.search(r"```python\n(.*?)```", text, re.S).group(1), {})
    said = {}
    for line in re.findall(r"^    workbench (.*)$", text, re.M):
        done = run(*shlex.split(line))
        assert done.exit_code == 0, (line, done.output)
        said[line.split()[0]] = done.output
    assert list(said) == ["identify", "export", "diagnose", "redesign", "predict", "check"]
    frequencies = [float(f) for f in re.findall(r"^\s*\d+\s+([\d.]+)", said["identify"], re.M)]
    assert frequencies[:2] == pytest.approx([2.9518, 11.807], rel=1e-3)  # (r π / L)² √(EI/m) / 2π
    assert "A delay of the actuators (all: delay 0.004 s)" in said["diagnose"]
    assert "stable on 200 of 200 Monte Carlo draws" in said["redesign"] and "the redesigned one" in said["redesign"]
    assert "command of F2, 2 samples ago" in Path("after.h").read_text(encoding="utf-8")
    assert "the model is validated on 1 of 1 tests" in said["check"]
