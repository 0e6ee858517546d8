"""What the README shows is what happens."""

import contextlib
import io
import json
import re
from pathlib import Path

import workbench

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def run(code: str) -> str:
    """What a block of code prints."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(code, "README.md", "exec"), {"__name__": "__main__"})
    return printed.getvalue()


def test_the_example_runs_and_prints_what_it_says(tmp_path, monkeypatch):
    (code,) = re.findall(r"```python\n(.*?)```", README, re.S)
    monkeypatch.chdir(tmp_path)
    tutorial = (ROOT / "docs/tutorial.md").read_text(encoding="utf-8")
    run(re.search(r"```python\n(.*?)```", tutorial, re.S).group(1))  # writes ringdown.csv
    promised = re.findall(r"^print\(.*\)  # (.*)", code, re.M)
    assert len(promised) == 3 and run(code).splitlines() == promised
    assert (tmp_path / "controlled.png").stat().st_size > 5000


def test_it_is_short():
    assert len(README.splitlines()) <= 150


def test_every_public_name_is_there():
    for name in workbench.__all__:
        assert getattr(workbench, name) is not None
    assert {"Beam", "Record", "imsc", "diagnose", "plot"} <= set(dir(workbench))


def test_every_file_and_target_named_is_there():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"^make (\w+)", README, re.M):
        assert f"\n{target}:" in makefile
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert target.startswith("https://") or (ROOT / target).is_file(), target
    for study in re.findall(r"workbench study ([a-z]\w*)", README):
        assert (ROOT / "studies" / f"{study}.py").is_file()


# For each row of the results: the study that wrote the number, and how it is found there.
ROWS = {
    "Table 4.1": lambda r: _largest(r, "Table 4.1"),
    "the same bar, order unknown": lambda r: _largest(r, "no order given: worst"),
    "Tables 4.2, 4.3": lambda r: _largest(r, "Tables 4.2-4.3: default"),
    "Table 5.1": lambda r: _largest(r, "Table 5.1"),
    "W_r of section 5.8": lambda r: _largest(r, "W_r, set", "quadrature"),
    "closed-form Riccati gains": lambda r: _largest(r, "gains against control.lqr"),
    "a hundred random structures": lambda r: min(check["value"] for check in r["checks"]),
    "95 % intervals": lambda r: min(c["value"] for c in r["checks"] if c["name"].endswith("from below")),
    "200 sensors": lambda r: _largest(r, "modes", "at full size"),
    "eight kinds of record": lambda r: max(
        row["over_bound"] for row in r["records"].values() if row["bound"] == "Cramér-Rao"
    ),
    "closely spaced actuators": lambda r: _largest(r, "close together: cost of IMSC"),
    "a fifth of the stiffness": lambda r: min(c["value"] for c in r["checks"] if "found and placed" in c["name"]),
    "error of the worst mode": lambda r: _largest(r, "median worst mode over the best peer's"),
    "the same: time": lambda r: _largest(r, "time over SSI-cov's"),
    "400 structures without any effect": lambda r: len(r["alarms"]),
    "coupled poles": lambda r: _largest(r, "its gain norm over"),
    "CasADi's W_R": lambda r: _largest(r, "CasADi's W_R"),
    "W_R of the optimum / the best of a full grid": lambda r: _largest(r, "W_R of the optimum over the best"),
    "IMSC of a hundred thousand modes": lambda r: r["speeds"]["imsc_100000_modes_s"],
    "spillover explained": lambda r: _largest(r, "paths add up"),
    "placement of 4 actuators": lambda r: _largest(r, "4 actuators", "certifi"),
    "frequencies re-identified": lambda r: _largest(r, "re-identified in the loop"),
    "ruler": lambda r: _largest(r, "MAC with the free-free beam"),
    "Silverbox": lambda r: 1e3 * r["rmse"]["multisines"]["after"],
    "EMPS": lambda r: r["friction_velocity"]["dry"],
    "a flexible arm": lambda r: 1e3 * r["mass"]["kg"],
    "two hundred cases": lambda r: _share(r, "single"),
    "the same, two effects": lambda r: _share(r, "pair"),
    "the same, nothing hidden": lambda r: min(_share(r, "none"), _share(r, "unknown")),
    "210 cases of an unseen seed": lambda r: next(c["value"] for c in r["checks"] if c["name"] == "share named"),
    "the same: false alarms in": lambda r: sum(s["false_alarms"] for s in r["by size"].values()),
    "42 cases on plates and frames": lambda r: min(_share(r, "single"), _share(r, "pair")),
    "a hundred simulated plants": lambda r: r["redesign over the design on the true effects, median"]["work"],
    "median share": lambda r: _largest(r, "median share"),
}


def _share(results: dict, family: str) -> float:
    right, of = results["shares"][family]
    return right / of


def _largest(results: dict, *words: str) -> float:
    found = [c["value"] for c in results["checks"] if all(word in c["name"] for word in words)]
    assert found, words
    return max(found)


def test_every_result_is_what_its_study_wrote():
    section = README[README.index("## Results") : README.index("## Documentation")]
    rows = [line.strip("| ").split(" | ") for line in section.splitlines() if "`workbench study" in line]
    unseen = set(ROWS)
    for what, found, command in rows:
        (key,) = [key for key in ROWS if what.startswith(key)]
        unseen.discard(key)
        study = re.search(r"study (\w+)", command).group(1)
        value = ROWS[key](json.loads((ROOT / "studies/results" / f"{study}.json").read_text(encoding="utf-8")))
        words, number = re.match(r"(below|at most|at least)? ?([\d.e-]+)", found).groups()
        if words is None:
            digits = len(number.partition(".")[2])
            assert f"{value:.{digits}f}" == number, what
        else:
            limit = float(number)
            assert value >= limit if words == "at least" else value <= limit, what
    assert not unseen


def test_every_room_has_a_page_that_the_readme_shows():
    rooms = [path.parent.name for path in (ROOT / "workbench").glob("*/__init__.py")]
    pages = dict(re.findall(r"^\| \[`(\w+)`\]\((docs/\S+\.md)\)", README, re.M))
    assert sorted(pages) == sorted(rooms)
    for room, page in pages.items():
        folder, text = ROOT / "workbench" / room, (ROOT / page).read_text(encoding="utf-8")
        pointer = (folder / "README.md").read_text(encoding="utf-8")
        assert f"({'../../' + page})" in pointer and len(pointer.splitlines()) <= 12, room
        for shown in (text, pointer):
            named = re.findall(r"`([a-z_/]+\.py)`", shown)
            assert named and all((folder / name).is_file() for name in named), (room, named)
            for name in re.findall(r"`wb\.(\w+)", shown):
                assert name in workbench.__all__, (room, name)
