"""The bench: its numbers are the library's, its server answers its own page only, and it can be played on."""

import http.client
import json
import socket
import threading
import time
from contextlib import contextmanager
from dataclasses import asdict, replace
from itertools import combinations, pairwise
from typing import Any

import numpy as np
import pytest

from workbench.cases.points import write_points
from workbench.design.estimation.controller import filtered
from workbench.design.estimation.modal_filter import filter_on, point_filter
from workbench.design.laws.imsc import imsc
from workbench.design.laws.law import DesignError
from workbench.design.loop.closed_loop import close_loop, close_with, impulse_state
from workbench.design.spillover.spillover import effort, finite_spillover
from workbench.records.units import Units
from workbench.rig.actuators import Actuator, piezo_patch
from workbench.structure.damping import ModalDamping
from workbench.structure.domain import NamedPoints
from workbench.structure.modes import PointShapes
from workbench.study.bench import bench_server
from workbench.study.catalogue import describe, run_study
from workbench.study.design_evaluation import design_from, read_structure, results_of, setting, start, try_out
from workbench.study.runs.cases import StudyError
from workbench.study.runs.outcome import Outcome
from workbench.study.saved_design import save
from workbench.trials.plane_frame import Section, plane_frame

RIG, TEXT, _ = read_structure(None)
PLATE = """[structure]
kind = "plate"
length = [1.2, 0.8]
mass_per_area = 8.0
bending_stiffness = 175.0
poisson_ratio = 0.3
edges = {left = "simply supported", right = "simply supported", bottom = "simply supported", top = "simply supported"}
damping_ratio = 0.005
modes = 6
[[input]]
name = "F1"
kind = "actuator"
at = [0.3, 0.24]
[[input]]
name = "F2"
kind = "actuator"
at = [0.84, 0.52]
[[input]]
name = "hammer"
kind = "hammer"
at = [0.5, 0.46]
[[output]]
name = "w1"
quantity = "displacement"
at = [0.36, 0.56]
noise_std = 1e-6
"""
PATCHES = PLATE.replace("at = [0.3, 0.24]", "at = [0.3, 0.24]\npatch = [0.2, 0.12]").replace(
    "at = [0.84, 0.52]", "at = [0.84, 0.52]\npatch = [0.2, 0.12]"
)


@contextmanager
def serving(rig, text, folder):
    with bench_server(rig, text, folder=folder) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield server.server_address[1]
        server.shutdown()
        thread.join()


@pytest.fixture
def bench(tmp_path):
    with serving(RIG, TEXT, tmp_path / "studies") as port:
        yield port


@pytest.fixture(params=["forces", pytest.param("patches", marks=pytest.mark.slow)])
def plate(request, tmp_path):
    """A plate with two actuators: its rig and its description."""
    path = tmp_path / "plate.toml"
    path.write_text(PLATE if request.param == "forces" else PATCHES)
    return read_structure(path)[:2]


def test_labels_have_the_units_of_the_rig(tmp_path):
    labels = setting(RIG)["labels"]
    assert labels["effort"] == "effort [N² s]" and labels["forces"] == "force [N]" and labels["x"] == "x [m]"
    (tmp_path / "case.toml").write_text(f'[units]\nlength = "mm"\nmass = "t"\ntime = "s"\nforce = "N"\n{PATCHES}')
    rig, _, units = read_structure(tmp_path)
    labels = setting(rig, units)["labels"]
    assert labels["residual"] == "spillover work W_R [N mm]" and labels["forces"] == "moment [N mm/mm]"
    per_ms = setting(RIG, Units(time="ms"))["labels"]
    assert (per_ms["clock"], per_ms["rate"], labels["clock"], labels["rate"]) == ("ms", "1/ms", "s", "1/s")


def plain(design) -> dict:
    return json.loads(json.dumps(asdict(design)))


def request(port, method, path, content=None, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    headers = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, path, content if content is None else json.dumps(content), headers)
    answer = connection.getresponse()
    return answer.status, answer.read().decode()


def test_it_begins_with_the_design_of_section_5_8():
    design = start(RIG)
    assert design.actuators == (2.0, 4.0, 6.0, 8.0) and design.impulse_at == 6.3 and design.controlled == 4
    found = results_of(RIG, replace(design, final_time=3000.0))
    expected = [0.0, 1.213865e-3, 5.203347e-5, 1.294254e-4, 1.037589e-4]
    np.testing.assert_allclose(found["by_mode"][4:], expected, rtol=1e-5, atol=1e-12)
    assert found["stable"] and len(found["poles"]) == 9 and found["residual"] == pytest.approx(1.499083e-3, rel=1e-5)


def test_effort_is_that_of_the_lyapunov_equation():
    tried = try_out(RIG, replace(start(RIG), final_time=120.0))
    exact = effort(RIG.modes, tried.law, impulse_state(RIG.modes, 6.3))
    assert tried.effort == pytest.approx(exact, rel=1e-4)


def test_sensors_close_the_loop_through_modal_filters():
    design = start(RIG)
    exact = results_of(RIG, design)
    many = results_of(RIG, replace(design, sensors=tuple(np.linspace(0.5, 9.5, 15))))
    few = results_of(RIG, replace(design, sensors=(2.0, 3.5, 5.2, 8.1)))
    assert many["residual"] == pytest.approx(exact["residual"], rel=0.05)
    assert abs(few["residual"] / exact["residual"] - 1) > 0.2, "few sensors mistake residual modes for controlled ones"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"controlled": 0}, "at least 1; got 0"),
        ({"controlled": True}, "at least 1"),
        ({"controlled": 12, "weight": [1.0] * 12}, "12 controlled modes, but the rig has 9"),
        ({"controlled": 5, "weight": [1.0] * 5}, "5 controlled modes need as many actuators"),
        ({"weight": [1.0, 1.0, 1.0]}, "each of the 4 controlled modes"),
        ({"weight": [1.0, 1.0, 1.0, 0.0]}, "positive"),
        ({"weight": [1.0, 1.0, 1.0, float("nan")]}, "finite numbers; got nan"),
        ({"actuators": [2.0, 2.0, 6.0, 8.0]}, "are both at x = 2"),
        ({"actuators": [2.0] * 41}, "at most 40"),
        ({"actuators": ["a", 2.0, 6.0, 8.0]}, "a position x in m; got 'a'"),
        ({"impulse_at": 11.0}, "outside the structure"),
        ({"impulse_at": [1.0, 2.0]}, "a place is a position along the structure, m; got"),
        ({"sensors": [[1.0, "b"]]}, "sensors must be finite numbers; got 'b'"),
        ({"sensors": [3.0, 3.0]}, "increasing"),
        ({"law": "bang"}, "law is one of"),
        ({"final_time": 0}, "final_time must be positive"),
        ({"final_time": 10**400}, "finite numbers"),
        ({"extra": 1}, "a design has actuators"),
    ],
)
def test_what_makes_no_design_is_refused(change, words):
    with pytest.raises(ValueError, match=words):
        results_of(RIG, design_from({**plain(start(RIG)), **change}))


def test_a_design_on_a_plate_is_what_the_library_makes_of_it(plate):
    rig, _ = plate
    design = start(rig)
    assert design.actuators == ((0.3, 0.24), (0.84, 0.52)) and design.impulse_at == (0.5, 0.46)
    moved = replace(design, actuators=((0.35, 0.3), (0.8, 0.5)))
    found = results_of(rig, design_from(plain(moved)))
    sizes = {"length": (0.2, 0.12)} if rig.actuators[0].quantity == "moment" else None
    actuators = [piezo_patch("P", at, **sizes) if sizes else Actuator("F", at) for at in moved.actuators]
    law = imsc(rig.modes, 2, [replace(a, name=f"F{i}") for i, a in enumerate(actuators)], weight=design.weight)
    state = impulse_state(rig.modes, (0.5, 0.46)) * np.r_[np.ones(6), 1, 1, 0, 0, 0, 0]
    exact = finite_spillover(close_loop(rig.modes, law), state, design.final_time).work_by_mode
    np.testing.assert_allclose(found["by_mode"], exact, rtol=1e-5, atol=1e-9)
    many = tuple((x, y) for x in np.linspace(0.1, 1.1, 9) for y in np.linspace(0.1, 0.7, 6))
    assert results_of(rig, replace(moved, sensors=many))["residual"] == pytest.approx(found["residual"], rel=0.05)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"actuators": [[0.3, 0.24], [1.3, 0.5]]}, "1.3.* 0 to 1.2 by 0 to 0.8"),
        ({"actuators": [0.3, [0.8, 0.5]]}, "a place is a pair .* m; got 0.3"),
        ({"impulse_at": 0.3}, "a place is a pair .* m; got 0.3"),
        ({"sensors": [[0.3, 0.2], [0.3, 0.2]]}, "two of the 2 sensors are at one place"),
    ],
)
def test_what_makes_no_design_on_a_plate_is_refused(change, words, tmp_path):
    path = tmp_path / "plate.toml"
    path.write_text(PLATE)
    rig, *_ = read_structure(path)
    with pytest.raises(ValueError, match=words):
        results_of(rig, design_from({**plain(start(rig)), **change}))


@pytest.mark.slow
def test_a_design_saved_on_a_plate_is_a_study_that_runs_and_agrees(plate, tmp_path):
    rig, text = plate
    path = save(rig, text, replace(start(rig), sensors=((0.4, 0.3), (0.8, 0.3), (0.6, 0.6))), "found", tmp_path)
    outcome = Outcome("found", figures_folder=tmp_path / "figures")
    run_study(describe(path), None, outcome, tmp_path)
    assert outcome.holds and len(outcome.checks) == 3 and len(outcome.figures) == 2


@pytest.mark.parametrize("sensors", [(1.0, 2.0, 3.0, 4.0), (2.0, 5.0, 8.0, 9.0)])
def test_a_loop_that_runs_away_names_the_modes_that_grow_and_whether_residual_modes_are_the_cause(sensors):
    """Truth: the poles of the controlled modes alone, and those of the loop with one residual mode at a time."""
    design = replace(start(RIG), sensors=sensors, weight=(1e-4,) * 4, final_time=1e4)
    with pytest.raises(DesignError, match=r"unstable, with a pole of real part \+.*: residual modes .* grow;") as told:
        try_out(RIG, design)
    modes, n = RIG.modes, design.controlled
    actuators = [replace(RIG.actuators[0], name=f"F{i}", at=at) for i, at in enumerate(design.actuators)]
    law = imsc(modes, n, actuators, weight=design.weight)
    through = filter_on(RIG.structure, modes, range(n), design.sensors)

    def fastest(kept):
        return close_with(modes.select(kept), filtered(law, through)).poles.real.max()

    alone = fastest(range(n))
    assert ("without residual modes it is stable" in str(told.value)) is bool(alone < 0)
    worst = max(range(n, modes.n_modes), key=lambda r: fastest([*range(n), r]))
    assert str(worst + 1) in str(told.value).split("residual modes ")[1].split(" grow")[0]


def test_a_saved_design_is_a_study_that_runs_and_agrees(tmp_path):
    design = replace(start(RIG), actuators=(1.9, 4.2, 6.0, 8.0), sensors=tuple(np.linspace(1.0, 9.0, 11)))
    path = save(RIG, TEXT, design, "found", tmp_path / "studies")
    outcome = Outcome("found", figures_folder=tmp_path / "figures")
    run_study(describe(path), None, outcome, tmp_path)
    assert outcome.holds and len(outcome.checks) == 3 and len(outcome.figures) == 2
    with pytest.raises(StudyError, match="exists already"):
        save(RIG, TEXT, design, "found", tmp_path / "studies")
    for name in ("../found", "Found", "", "a b", "a" * 50, "1a", "a\n"):
        with pytest.raises(StudyError, match="the name of a study"):
            save(RIG, TEXT, design, name, tmp_path / "studies")


def test_the_server_answers_its_own_page_and_nobody_else(bench):
    design, own = plain(start(RIG)), {"Content_Type": "application/json"}
    assert request(bench, "GET", "/")[0] == 200
    status, text = request(bench, "POST", "/try", design, **own)
    assert status == 200 and json.loads(text)["stable"]
    for headers in ({"Host": "evil.example"}, {"Host": f"evil.example:{bench}"}, {"Origin": "http://evil.example"}):
        assert request(bench, "GET", "/", **headers)[0] == 403
        assert request(bench, "POST", "/try", design, **own, **headers)[0] == 403
    assert request(bench, "POST", "/try", design, Content_Type="text/plain")[0] == 403, "what a form could send"
    assert request(bench, "GET", "/etc/passwd")[0] == 404 and request(bench, "POST", "/other", {}, **own)[0] == 404
    for content in (None, [], 3, {"name": 3}, {**design, "law": None}, {**design, "actuators": {}}):
        status, text = request(bench, "POST", "/try", content, **own, **({} if content else {"Content_Length": "0"}))
        assert status == 422 and json.loads(text)["error"]
    assert request(bench, "POST", "/save", {"name": "x", "design": []}, **own)[0] == 422
    assert request(bench, "POST", "/try", design, **own, Content_Length="99999999")[0] == 422
    assert request(bench, "POST", "/try", design, **own)[0] == 200, "it lives on"


@pytest.fixture
def opened(look, until):
    """A page of that width, once the bars of its work are drawn and all of it is within the width."""

    def at(port, width):
        browser = look(f"http://127.0.0.1:{port}/", width)
        until(lambda: browser.find_elements("css selector", "#work .marks rect"))
        assert browser.execute_script("return document.documentElement.scrollWidth") <= width
        return browser

    return at


@pytest.mark.parametrize("width", [390, pytest.param(1200, marks=pytest.mark.slow)])
def test_it_can_be_played_on(bench, look, drawn, moves, until, width, tmp_path):
    from selenium.webdriver import ActionChains

    browser = look(f"http://127.0.0.1:{bench}/", width)
    drawn(browser, 4)
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width

    def card(name):
        return browser.find_element("id", name).text

    def bars():
        return len(browser.find_elements("css selector", "#work .marks rect"))

    assert card("residual") == "0.001499" and card("stable") == "undamped" and bars() == 5
    assert moves(browser.find_element("css selector", ".stand .track"))

    second = browser.find_elements("css selector", ".handle.actuators")[1]
    length = browser.find_element("css selector", ".stand").size["width"] - 36
    ActionChains(browser).click_and_hold(second).move_by_offset(round(0.05 * length), 0).release().perform()
    at = float(second.get_attribute("aria-valuenow"))
    assert at == pytest.approx(4.5, abs=0.1)
    moved = results_of(RIG, replace(start(RIG), actuators=(2.0, at, 6.0, 8.0)))["residual"]
    until(lambda: float(card("residual").replace("−", "-")) == pytest.approx(moved, rel=1e-3))

    def control(count):
        slider = browser.find_element("id", "controlled")
        browser.execute_script(f"arguments[0].value = {count}; arguments[0].dispatchEvent(new Event('input'))", slider)

    control(3)
    until(lambda: bars() == 6)
    control(5)
    until(lambda: "5 controlled modes need as many" in browser.find_element("css selector", ".say").text)
    control(4)
    until(lambda: bars() == 5 and "Drag" in browser.find_element("css selector", ".say").text)

    name = browser.find_element("id", "name")
    name.clear()
    name.send_keys(f"played_{width}")
    name.submit()
    until(lambda: "saved as" in browser.find_element("id", "saved").text)
    assert (tmp_path / f"studies/played_{width}.py").is_file()
    errors = [entry for entry in browser.get_log("browser") if "422" not in entry["message"]]
    assert errors == []


@pytest.mark.parametrize("width", [390, pytest.param(1200, marks=pytest.mark.slow)])
def test_actuators_are_dragged_over_a_plate(plate, opened, until, width, tmp_path):
    from selenium.webdriver import ActionChains, Keys

    rig, text = plate
    with serving(rig, text, tmp_path / "studies") as port:
        browser = opened(port, width)
        track, pictures = browser.find_element("css selector", ".track"), set()
        until(lambda: pictures.add(track.get_attribute("href")) or len(pictures) > 3)

        second = browser.find_elements("css selector", ".handle.actuators")[1]
        scale = track.size["width"] / 1.2
        grip = second.find_element("css selector", ".halo")
        drag = ActionChains(browser).click_and_hold(grip)
        drag.move_by_offset(round(-0.1 * scale), round(0.2 * scale)).release().perform()
        ActionChains(browser).send_keys(Keys.ARROW_UP).perform()
        x, y = (float(part) for part in second.get_attribute("aria-valuetext").split(","))
        assert (x, y) == pytest.approx((0.74, 0.32 + 0.008), abs=0.02)
        moved = results_of(rig, replace(start(rig), actuators=((0.3, 0.24), (x, y))))["residual"]
        residual = browser.find_element("id", "residual")
        until(lambda: float(residual.text.replace("−", "-")) == pytest.approx(moved, rel=0.02))
        ActionChains(browser).click_and_hold(grip).move_by_offset(0, round(-0.5 * scale)).release().perform()
        highest = 0.74 if rig.actuators[0].quantity == "moment" else 0.8
        until(lambda: float(second.get_attribute("aria-valuetext").split(",")[1]) == pytest.approx(highest, abs=1e-3))
        assert [entry for entry in browser.get_log("browser") if "422" not in entry["message"]] == []


@pytest.fixture
def frame(tmp_path):
    """A portal of two nodes a column and one on its beam, with its rig and its description."""
    strips = Section.of_strip(0.03, 0.004, youngs_modulus=2.1e11, density=7850.0)
    nodes = {
        "0": (0, 0),
        "l": (0, 0.2),
        "L": (0, 0.4),
        "m": (0.2, 0.4),
        "R": (0.4, 0.4),
        "r": (0.4, 0.2),
        "1": (0.4, 0),
    }
    chain = [(one, other, strips) for one, other in pairwise(nodes)]
    model = plane_frame(nodes, chain, fixed=("0", "1"), damping=ModalDamping(0.01))
    named = [name for name in model.nodes.names if not name.endswith("rz")]
    at = model.nodes.locate(named)
    points = NamedPoints(
        tuple(named), model.nodes.positions[at], ("x", "y") * 5, tuple(name.split(".")[0] for name in named)
    )
    modes = model.modes(5)
    shapes = PointShapes(modes.phi(named))
    write_points(tmp_path / "points.csv", points, shapes.values)
    (tmp_path / "frame.toml").write_text(
        '[structure]\nkind = "modal"\npoints = "points.csv"\n'
        f"natural_frequencies_hz = {modes.frequencies_hz.tolist()}\ndamping_ratios = {[0.01] * 5}\n"
        '[[input]]\nname = "F1"\nkind = "actuator"\npoint = "l.x"\n[[input]]\nname = "F2"\nkind = "actuator"\n'
        'point = "R.x"\n[[input]]\nname = "hammer"\nkind = "hammer"\npoint = "m.y"\n'
        '[[output]]\nname = "a"\nquantity = "acceleration"\npoint = "r.x"\nnoise_std = 0.01\n'
    )
    return read_structure(tmp_path / "frame.toml")[:2]


def test_a_design_on_a_frame_is_what_the_library_makes_of_it(frame):
    rig, _ = frame
    design = start(rig)
    assert design.actuators == ("R.x", "l.x") and design.impulse_at == "m.y"
    moved = design_from({**plain(design), "actuators": ["L.x", "m.y"]})
    actuators = [Actuator("F1", "L.x"), Actuator("F2", "m.y")]
    law = imsc(rig.modes, 2, actuators, weight=design.weight)
    loop = close_loop(rig.modes, law)
    at_rest = impulse_state(rig.modes, "m.y")
    at_rest[rig.modes.n_modes + 2 :] = 0.0
    expected = finite_spillover(loop, at_rest, design.final_time).residual_work
    assert results_of(rig, moved)["residual"] == pytest.approx(expected, rel=1e-5)
    sensors = ["l.x", "R.x", "m.y"]
    through = close_loop(rig.modes, law, point_filter(rig.modes, sensors, [0, 1]))
    expected = finite_spillover(through, at_rest, design.final_time).residual_work
    seen = results_of(rig, design_from({**plain(moved), "sensors": sensors}))
    assert seen["residual"] == pytest.approx(expected, rel=1e-5)
    for change, words in (
        ({"actuators": ["L.x", "Q.x"]}, "there is no point 'Q.x'"),
        ({"sensors": ["r.x"]}, "a filter of 2 modes at named points needs at least as many sensors; got 1"),
    ):
        with pytest.raises(ValueError, match=words):
            results_of(rig, design_from({**plain(design), **change}))


@pytest.mark.parametrize("before", ["", "  "])
def test_a_design_saved_on_a_frame_is_a_study_that_runs_and_agrees(frame, before, tmp_path):
    rig, text = frame
    indented = "\n".join(before + line for line in text.splitlines())
    path = save(rig, indented, start(rig), "found", tmp_path / "studies")
    outcome = Outcome("found", figures_folder=tmp_path / "figures")
    run_study(describe(path), None, outcome, tmp_path)
    assert outcome.holds and len(outcome.checks) == 3


@pytest.mark.parametrize("width", [390, pytest.param(1200, marks=pytest.mark.slow)])
def test_actuators_are_dragged_from_point_to_point_of_a_frame(frame, opened, until, width, tmp_path):
    from selenium.webdriver import ActionChains, Keys

    rig, text = frame
    with serving(rig, text, tmp_path / "studies") as port:
        browser = opened(port, width)
        track, drawn = browser.find_element("css selector", ".track"), set()
        until(lambda: drawn.add(track.get_attribute("d")) or len(drawn) > 3)
        first = browser.find_elements("css selector", ".handle.actuators")[0]
        assert first.get_attribute("aria-valuetext") == "R.x"
        grip = first.find_element("css selector", ".halo")
        # half a column down stands r
        spots = {c.find_element("css selector", "title").get_attribute("textContent"): c for c in
                 browser.find_elements("css selector", ".stand > circle")}  # fmt: skip
        down = spots["r.x"].location["y"] - spots["R.x"].location["y"]
        ActionChains(browser).click_and_hold(grip).move_by_offset(3, round(down) - 4).release().perform()
        until(lambda: first.get_attribute("aria-valuetext") == "r.x")
        residual = browser.find_element("id", "residual")
        moved = results_of(rig, replace(start(rig), actuators=("r.x", "l.x")))["residual"]
        until(lambda: float(residual.text.replace("−", "-")) == pytest.approx(moved, rel=1e-3))
        ActionChains(browser).send_keys(Keys.ARROW_RIGHT).perform()
        until(lambda: first.get_attribute("aria-valuetext") == "r.y")
        assert [entry for entry in browser.get_log("browser") if "422" not in entry["message"]] == []


@pytest.fixture
def apart(look, until, tmp_path):
    """Handles, their labels, ticks and the key cover nothing of each other; axes have two ticks at least."""

    def checked(rig, text, width, scheme):
        with serving(rig, text, tmp_path / "studies") as port:
            browser = look(f"http://127.0.0.1:{port}/", width, scheme)
            until(lambda: browser.find_elements("css selector", "#work .marks rect"))
            for what in ("actuators", "sensors", "sensors"):
                browser.find_element("css selector", f"[aria-label='add to {what}']").click()
            until(lambda: len(browser.find_elements("css selector", ".handle")) == len(start(rig).actuators) + 4)
            until(lambda: min(browser.execute_script(BOXES)["ticks"]) >= 2)
            found = browser.execute_script(BOXES)
        for one, other in combinations(found["boxes"], 2):
            x = min(one["right"], other["right"]) - max(one["left"], other["left"])
            y = min(one["bottom"], other["bottom"]) - max(one["top"], other["top"])
            assert x < 1 or y < 1, (one, other)
        assert len(found["boxes"]) > 12

    return checked


def screens(first: tuple[int, str]) -> list[Any]:
    """Every screen, all but the first in the slow run alone."""
    every = [(width, scheme) for width in (390, 1400) for scheme in ("light", "dark")]
    return [screen if screen == first else pytest.param(*screen, marks=pytest.mark.slow) for screen in every]


@pytest.mark.parametrize(("width", "scheme"), screens((1400, "light")))
def test_nothing_covers_anything_else_beside_a_beam(width, scheme, apart):
    apart(RIG, TEXT, width, scheme)


@pytest.mark.parametrize(("width", "scheme"), screens((390, "dark")))
def test_nothing_covers_anything_else_on_a_plate(width, scheme, apart, plate):
    apart(*plate, width, scheme)


@pytest.mark.parametrize(("width", "scheme"), screens((1400, "light")))
def test_nothing_covers_anything_else_on_a_frame(width, scheme, apart, frame):
    apart(*frame, width, scheme)


BOXES = """
var boxes = [], add = function (what) {
  return function (e) {
    var b = e.getBoundingClientRect(), box = { left: b.left, right: b.right, top: b.top, bottom: b.bottom };
    if (b.width) boxes.push(Object.assign({ what: what, text: e.textContent }, box));
  };
};
document.querySelectorAll(".handle > path").forEach(add("mark"));
document.querySelectorAll(".stand text").forEach(add("text"));
document.querySelectorAll(".key > span").forEach(add("key"));
document.querySelectorAll(".figures text").forEach(add("axis"));
var ticks = Array.from(document.querySelectorAll(".figures .panel > svg")).map(function (s) {
  return Array.from(s.querySelectorAll("text[text-anchor=end]")).length;
});
return { boxes: boxes, ticks: ticks };
"""


def test_a_case_folder_has_a_bench_too(tmp_path):
    (tmp_path / "case.toml").write_text(PLATE)
    rig, text, _ = read_structure(tmp_path)
    assert text == PLATE and rig.actuators == read_structure(tmp_path / "case.toml")[0].actuators


def test_points_without_positions_cannot_be_drawn(tmp_path):
    path = tmp_path / "modal.toml"
    path.write_text(
        '[structure]\nkind = "modal"\nnatural_frequencies_hz = [1.0]\ndamping_ratios = [0.01]\n'
        '[[input]]\nname = "F"\nkind = "actuator"\nshape = [1.0]\n'
        '[[output]]\nname = "y"\nquantity = "displacement"\nshape = [1.0]\nnoise_std = 0.001\n'
    )
    with pytest.raises(StudyError, match="points without positions cannot be drawn"):
        bench_server(*read_structure(path))


def test_fifty_connections_at_once_are_answered(bench):
    body, answers = plain(start(RIG)), []

    def ask():
        answers.append(request(bench, "POST", "/try", body, Content_Type="application/json")[0])

    threads = [threading.Thread(target=ask) for _ in range(50)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert answers == [200] * 50


def test_a_client_that_sends_nothing_is_dropped_and_keeps_no_other_waiting(bench, monkeypatch):
    monkeypatch.setattr("workbench.study.bench._Handler.timeout", 0.5)
    with socket.create_connection(("127.0.0.1", bench), timeout=10) as silent:
        silent.sendall(b"POST /try HTTP/1.1\r\nHost: 127.0.0.1")
        assert request(bench, "GET", "/")[0] == 200
        assert silent.recv(1) == b"", "the server closes the connection"


def test_a_client_that_sends_bytes_one_by_one_is_dropped_in_time(bench, monkeypatch):
    """Each byte began the wait anew, so that such a client stayed for ever."""
    monkeypatch.setattr("workbench.study.bench.CLIENT_SECONDS", 0.5)
    start, ended = time.monotonic(), False
    with socket.create_connection(("127.0.0.1", bench), timeout=0.05) as slow:
        slow.sendall(b"POST /try HTTP/1.1\r\nX: ")
        while not ended and time.monotonic() - start < 5.0:
            try:
                slow.sendall(b"a")
                ended = slow.recv(1) == b""
            except TimeoutError:
                continue
            except OSError:
                ended = True
    assert ended and request(bench, "GET", "/")[0] == 200


def test_undamped_residual_modes_are_not_called_stable_alone():
    design = start(RIG)
    found = results_of(RIG, design)
    assert found["stable"] and found["undamped"] == RIG.modes.n_modes - design.controlled
