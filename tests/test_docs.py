"""What the pages of the site show is what happens."""

import contextlib
import io
import re
import subprocess
import sys
from pathlib import Path

import matplotlib
import pytest
from typer.main import get_command

import workbench
from workbench.cases.case import RECORD
from workbench.cases.nominal import INPUT, MEMBER, MODAL, OUTPUT, PLATE, SINGLE, STRUCTURES, TABLES
from workbench.cli.app import app
from workbench.gap.effects.catalogue import CATALOGUE
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.structure.member import Beam
from workbench.structure.supports import SIDES

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(path for path in DOCS.rglob("*.md") if path.parent.name != "api")
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.M | re.S)


def blocks(page: Path) -> list[tuple[str, str]]:
    """(language, text) of each block of code, in order."""
    return FENCE.findall(page.read_text(encoding="utf-8"))


def name(page: Path) -> str:
    return page.relative_to(DOCS).as_posix()


LONG = ("how-to/plates.md",)
WITH_EXAMPLES = [p for p in PAGES if any(lang == "python" for lang, _ in blocks(p))]
MARKED = [pytest.param(p, id=name(p), marks=[pytest.mark.slow] if name(p) in LONG else []) for p in WITH_EXAMPLES]


@pytest.mark.parametrize("page", MARKED)
def test_the_examples_of_a_page_run_and_print_what_it_says(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    names: dict[str, object] = {"__name__": "__main__"}
    shown = blocks(page)
    for (language, code), (follows, text) in zip(shown, [*shown[1:], ("", "")], strict=True):
        if language != "python":
            continue
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(code, f"docs/{name(page)}", "exec"), names)
        assert printed.getvalue() == (text if follows == "text" else ""), name(page)
        for written in re.findall(r'"([\w-]+\.(?:csv|png))"', code):
            assert (tmp_path / written).stat().st_size > 300, written


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_link_of_a_page_leads_somewhere(page):
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
        assert target.startswith("https://") or (page.parent / target).exists(), target


def page_text(path: str) -> str:
    return (DOCS / path).read_text(encoding="utf-8")


def test_every_figure_names_the_study_that_draws_it():
    gallery = page_text("gallery.md")
    for figure, study in re.findall(r"figures/(\w+)-\w+\.png\)\n.*`workbench study (\w+)`", gallery):
        assert figure == study and (ROOT / "studies" / f"{study}.py").is_file()
    assert gallery.count("workbench study") == gallery.count("](../figures/") > 10


def test_the_case_format_names_every_key_and_every_effect():
    text = page_text("reference/case-format.md")
    keys = {
        *TABLES,
        *MEMBER,
        *PLATE,
        *SIDES,
        *MODAL,
        *SINGLE,
        *INPUT,
        *OUTPUT,
        *RECORD,
        *(k for keys in STRUCTURES.values() for k in keys),
    }
    missing = [key for key in keys if not re.search(rf"`{key}`|\[{key}\]|^{key} = ", text, re.M)]
    assert not missing
    rows = dict(re.findall(r"^\| `(\w+)` \| .* \| (.*) \|$", text, re.M))
    beam = Beam(length=1.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="clamped")
    rig = Rig(beam.modes(3), [Actuator("F1", 0.3)], [Sensor("y1", 0.7, noise_std=1.0)], structure=beam)
    for kind in CATALOGUE:
        for target in kind.targets(rig):
            lacking = [p.name for p in kind.parameters(rig, target) if f"`{p.name}`" not in rows[kind.name]]
            assert not lacking, (kind.name, lacking)


def test_every_message_shown_is_one_that_the_package_has():
    source = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "workbench").rglob("*.py"))
    fragments = re.findall(r"^\| `([^`]+)` \|", page_text("reference/messages.md"), re.M)
    assert len(fragments) > 10
    assert not [fragment for fragment in fragments if fragment not in source]


def test_every_command_has_its_options_shown():
    shown = re.findall(r"^\.\. command-options:: (\w+)$", page_text("reference/command.md"), re.M)
    assert sorted(shown) == sorted(get_command(app).commands)


def test_every_public_name_has_a_room_whose_page_shows_it():
    rooms = {path.stem for path in (DOCS / "api").glob("*.md")}
    for room in rooms - {"index"}:
        assert f".. public-names:: {room} core" in page_text(f"api/{room}.md")
    stub = (ROOT / "workbench/__init__.pyi").read_text(encoding="utf-8")
    named = re.findall(r"^from \.(\w+)\S* import (\w+)", stub, re.M)
    assert {name for _, name in named} == set(workbench.__all__) and {room for room, _ in named} <= rooms


@pytest.mark.slow
def test_the_site_is_built_without_a_warning_and_fetches_nothing(tmp_path):
    pytest.importorskip("furo", reason="pip install -e '.[docs]'")
    build = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html", DOCS, tmp_path]
    subprocess.run(build, check=True, timeout=600)
    pages = {path: path.read_text(encoding="utf-8") for path in tmp_path.rglob("*.html")}
    api = "".join(text for path, text in pages.items() if path.parent.name == "api")
    assert not [n for n in workbench.__all__ if f'id="workbench.{n}"' not in api]
    for path, text in pages.items():
        assert not re.findall(r"<(?:script|img|link|iframe)[^>]+(?:src|href)=\"(?:https?:)?//[^\"]+", text), path
