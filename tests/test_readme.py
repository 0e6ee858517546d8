"""What the README shows is what happens."""

import contextlib
import io
import re
from pathlib import Path

import workbench

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_example_runs_and_prints_what_it_says(tmp_path, monkeypatch):
    code = re.search(r"```python\n(.*?)```", README, re.S).group(1)
    promised = re.findall(r"print\(.*\)  # (.*)", code)
    monkeypatch.chdir(tmp_path)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(code, "README.md", "exec"), {})
    assert promised and printed.getvalue().split() == promised
    assert (tmp_path / "response.png").stat().st_size > 5000


def test_every_public_name_is_there():
    for name in workbench.__all__:
        assert getattr(workbench, name) is not None
    assert {"Beam", "Record", "imsc", "diagnose", "plot"} <= set(dir(workbench))


def test_every_file_and_target_named_is_there():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"^make (\w+)", README, re.M):
        assert f"\n{target}:" in makefile
    for figure in re.findall(r"!\[.*?\]\((.*?)\)", README):
        assert (ROOT / figure).is_file()
    for study in re.findall(r"workbench study ([a-z]\w*)", README):
        assert (ROOT / "studies" / f"{study}.py").is_file()
