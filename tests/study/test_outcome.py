"""What a study finds is kept, written the same from run to run, and shown on a page that needs nothing else."""

import json
from html.parser import HTMLParser

import numpy as np
import pytest

from workbench.draw.style import new_figure
from workbench.study.catalogue import StudyError, describe
from workbench.study.pages.page import PageContent, study_page, write_page
from workbench.study.runs.outcome import Outcome, plain


class Tags(HTMLParser):
    def __init__(self):
        super().__init__()
        self.found = []

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))


def sample(folder) -> Outcome:
    outcome = Outcome("sample", title="Is 1 < 2 & 3?", figures_folder=folder / "figures")
    outcome.say("<script>alert(1)</script>")
    outcome.table("numbers", {"a": np.array([1.0, 1 / 3]), 2: (np.int64(3), np.bool_(True), np.nan)})
    outcome.check("small", 0.5, 1.0)
    outcome.check("large", np.float64(0.5), 1.0, at_least=True)
    figure, ax = new_figure()
    ax.plot([0, 1])
    outcome.figure("line", figure, "A line, 'quoted' \"twice\".")
    return outcome


def test_results_are_plain_json_with_checks(tmp_path):
    outcome = sample(tmp_path)
    path = outcome.write(tmp_path)
    results = json.loads(path.read_text())
    assert results["numbers"] == {"a": [1.0, 0.3333333333], "2": [3, True, None]}
    assert [(c["name"], c["value"], c["limit"], c["holds"]) for c in results["checks"]] == [
        ("small", 0.5, 1.0, True),
        ("large", 0.5, 1.0, False),
    ]
    assert not outcome.holds
    again = sample(tmp_path).write(tmp_path / "again")
    assert path.read_bytes() == again.read_bytes()


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        ("found", {"W_R": 3.0}, "a table cannot be called 'found', .* rename the table"),
        ("checks", 1.0, "a table cannot be called 'checks'"),
        ("poles", {"first": [1j]}, "table 'poles': .* complex .* by its parts"),
    ],
)
def test_a_table_that_the_results_could_not_hold_is_refused(name, values, words):
    with pytest.raises(StudyError, match=words):
        Outcome("x").table(name, values)


def test_a_value_that_is_not_a_number_never_holds():
    outcome = Outcome("x")
    outcome.check("a", np.nan, 1.0)
    outcome.check("b", np.nan, 1.0, at_least=True)
    assert [c["holds"] for c in outcome.checks] == [False, False]


def test_numbers_are_stable_to_ten_digits():
    assert plain(0.1 + 0.2) == plain(0.3) == 0.3
    assert plain({1: [np.float32(0.5)]}) == {"1": [0.5]}


def test_a_page_is_one_file_and_escapes_what_it_is_told(tmp_path):
    text = study_page(sample(tmp_path), tmp_path, inputs={}, made_by="workbench study sample").read_text(
        encoding="utf-8"
    )
    tags = Tags()
    tags.feed(text)
    assert "<script>alert(1)</script>" not in text and "&lt;script&gt;alert(1)" in text
    assert "Is 1 &lt; 2 &amp; 3?" in text
    sources = [a["src"] for _, a in tags.found if "src" in a] + [a["href"] for _, a in tags.found if "href" in a]
    assert all(s.startswith("data:") for s in sources), "nothing is fetched"
    assert [a["class"] for t, a in tags.found if t == "td" and "class" in a] == ["good", "bad"]


def test_hostile_table_cells_are_escaped(tmp_path):
    path = write_page(tmp_path / "p.html", PageContent("t", tables=[("<b>", ("<i>",), [("</td><img src=x>",)])]))
    tags = Tags()
    tags.feed(path.read_text(encoding="utf-8"))
    assert not {"b", "i", "img"} & {tag for tag, _ in tags.found}


@pytest.mark.parametrize(("text", "words"), [("x = 1", "defines no function study"), ("def study(", "is not a study")])
def test_what_is_no_study_is_refused(tmp_path, text, words):
    path = tmp_path / "s.py"
    path.write_text(text)
    with pytest.raises(StudyError, match=words):
        describe(path)


def test_progress_passes_the_items_through():
    told = []
    outcome = Outcome("x", on_track=lambda items, what: (told.append(what), iter(items))[1])
    assert list(outcome.track([1, 2], "things")) == [1, 2] and told == ["things"]
    assert list(Outcome("y").track([3], "things")) == [3]
