"""The page in a real browser: figures drawn, zoomed and read, motion that moves, nothing fetched, no error."""

import json
import re

import numpy as np
import pytest

from workbench.design.laws.imsc import imsc
from workbench.design.loop.closed_loop import close_loop, impulse_state, initial_response
from workbench.draw.design import plot_poles
from workbench.draw.interactive import Undescribed, described, drawable
from workbench.draw.motion import mode_motion, response_motion
from workbench.draw.style import new_figure
from workbench.rig.actuators import Actuator
from workbench.rig.sensors import Sensor
from workbench.structure.member import Beam
from workbench.structure.modes import SampledModes
from workbench.study.pages.page import PageContent, block, page_content_of, write_page
from workbench.study.report import page_content_in

WIDTHS = (390, 1200)
HOSTILE = "</script><script>document.title='taken'</script><img src=x onerror=\"document.title='taken'\">"


def beam_modes():
    return Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged").modes(6)


def every_mark():
    """A figure of each kind of mark, panels that share an axis, and a logarithmic axis."""
    figure, axes = new_figure(2, 2, width=9, height=6)
    axes[1, 0].sharex(axes[0, 0])
    t = np.linspace(0.0, 10.0, 1001)
    axes[0, 0].plot(t, np.sin(t), label="sine " + HOSTILE)
    axes[0, 0].plot([2.0], [0.5], "s", label="point")
    axes[0, 0].axhline(0.25)
    axes[0, 0].axvspan(1, 2, alpha=0.3)
    axes[0, 0].legend()
    axes[0, 0].set(title="lines", xlabel="time [s]", ylabel="value [m]")
    axes[1, 0].fill_between(t, np.cos(t), 0.0, alpha=0.3)
    axes[1, 0].vlines([1, 2], 0, 1)
    axes[1, 0].scatter([3, 4], [0.1, 0.2], c=[0.0, 1.0])
    axes[1, 0].annotate("here", (5, 0.5))
    bars = axes[0, 1].bar(["one", "two"], [3.0, 500.0], label="bars")
    axes[0, 1].bar_label(bars, ["3", "500"])
    axes[0, 1].set_yscale("log")
    x, y = np.meshgrid(np.linspace(0, 4, 50), np.linspace(0, 2, 20))
    image = axes[1, 1].pcolormesh(x, y, x * y, shading="gouraud")
    figure.colorbar(image, ax=axes[1, 1], label="product")
    return figure


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    modes = beam_modes()
    actuators = [Actuator(f"F{i + 1}", x) for i, x in enumerate((3.0, 7.0))]
    law = imsc(modes, 2, actuators, weight=5.0)
    response = initial_response(close_loop(modes, law), np.linspace(0.0, 20.0, 201), impulse_state(modes, 6.3))
    sensors = [Sensor("y1", 4.0, "displacement")]
    sampled = SampledModes(modes.omega, modes.zeta, modes.phi([2.0, 5.0, 8.0]) * (1 + 0.3j), [2.0, 5.0, 8.0])
    page_content = PageContent(
        title="Is it " + HOSTILE + "?",
        lead=HOSTILE,
        lines=(HOSTILE,),
        blocks=[
            block(every_mark(), HOSTILE),
            block(response_motion({"controlled": response}, actuators=actuators, sensors=sensors), "moves"),
            block(mode_motion({"nominal": modes, "measured": sampled}, sensors=sensors), "swings"),
        ],
        tables=[("Numbers", ("name", HOSTILE), [("a", 10.0), ("b", 9.0), ("c", -1e-3), (HOSTILE, "none")])],
        inputs={"case.toml": HOSTILE},
        made_by="workbench study " + HOSTILE,
    )
    return write_page(tmp_path_factory.mktemp("page") / "p.html", page_content)


@pytest.mark.parametrize("width", WIDTHS)
def test_it_draws_and_moves_without_an_error(page, look, drawn, moves, width):
    browser = look(page.as_uri(), width)
    panels = drawn(browser, 4)
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    marks = [len(panel.find_elements("css selector", ".marks > *")) for panel in panels]
    assert len(panels) == 4 and min(marks) >= 1 and marks[0] >= 4
    assert all(panel.size["width"] > 150 and panel.size["height"] > 100 for panel in panels)
    columns = {round(panel.location["x"]) for panel in panels}
    assert len(columns) == (1 if width < 600 else 2), "on a phone the panels stand below each other"
    for figure in browser.find_elements("css selector", "figure[data-block]")[1:]:
        browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", figure)
        assert moves(figure.find_element("css selector", ".track"))
    assert browser.title != "taken" and browser.find_elements("css selector", "img") == []
    assert browser.execute_script("return performance.getEntriesByType('resource').length") == 0
    assert browser.get_log("browser") == []


def ticks(panel):
    return [t.text for t in panel.find_elements("css selector", "text[text-anchor=middle]:not(.axis)")]


def test_a_figure_is_read_zoomed_and_shown_whole_again(page, look, drawn):
    from selenium.webdriver import ActionChains

    browser = look(page.as_uri(), 1200)
    first, second, third, _ = drawn(browser, 4)
    mark = first.find_element("css selector", ".marks rect:last-of-type")  # the square at (2, 0.5)
    ActionChains(browser).move_to_element(mark).perform()
    tip = browser.find_element("css selector", ".tip")
    assert tip.text.splitlines() == ["point", "time [s]: 2", "value [m]: 0.5"]
    bar = second.find_elements("css selector", ".marks rect")[1]
    ActionChains(browser).move_to_element(bar).perform()
    assert tip.text.splitlines() == ["bars", "x: two", "y: 500"]

    whole = ticks(third)
    size = first.size
    drag = ActionChains(browser).move_to_element_with_offset(first, round(-0.2 * size["width"]), 0)
    drag.click_and_hold().move_by_offset(round(0.2 * size["width"]), 3).release().perform()
    zoomed = [float(t) for t in ticks(first)]
    assert zoomed and 1.5 < min(zoomed) and max(zoomed) < 6.0 and ticks(third) != whole, (
        "panels that share x zoom as one"
    )
    browser.find_element("css selector", ".tools button").click()
    assert ticks(third) == whole
    entry = browser.find_element("css selector", ".panel .legend button")
    before = len(first.find_elements("css selector", ".marks > *"))
    entry.click()
    assert len(first.find_elements("css selector", ".marks > *")) == before - 1
    assert browser.get_log("browser") == []


@pytest.fixture(scope="module")
def stacked(tmp_path_factory):
    """Two panels that share x, of numbers that are wide and narrow, with a tick at their right edge."""
    figure, axes = new_figure(2, 1, sharex=True)
    axes[0].plot([0.0, 100.0], [0.0, 10000.0], color="#8a8a8a", label="grey")
    axes[1].plot([0.0, 100.0], [0.0, 4e-7])
    axes[1].set(xlabel="share [%]", xlim=(0.0, 100.0))
    axes[0].legend()
    content = PageContent(title="Stacked", blocks=[block(figure, "stacked")])
    return write_page(tmp_path_factory.mktemp("page") / "s.html", content)


@pytest.mark.parametrize("width", WIDTHS)
def test_panels_that_share_x_stand_in_line_and_cut_no_number(stacked, look, drawn, width):
    browser = look(stacked.as_uri(), width)
    above, below = drawn(browser, 2)
    frames = [panel.find_element("css selector", ".frame").get_attribute("d") for panel in (above, below)]
    assert len({frame.split(",")[0] for frame in frames}) == 1
    for panel in (above, below):
        assert panel.find_elements("css selector", "text[text-anchor=middle]")[-1].text and "100" in ticks(panel)
        edge = panel.rect["x"] + panel.rect["width"]
        assert all(t.rect["x"] + t.rect["width"] <= edge + 0.5 for t in panel.find_elements("css selector", "text"))
    assert "4·10⁻⁷" in [t.text for t in below.find_elements("css selector", "text[text-anchor=end]")]


def test_a_legend_has_the_colours_of_its_lines_in_the_dark(stacked, look, drawn):
    browser = look(stacked.as_uri(), 1200, scheme="dark")
    drawn(browser, 2)
    brightened = [browser.find_element("css selector", at) for at in (".legend i", ".marks path")]
    assert {one.value_of_css_property("filter") for one in brightened} == {"brightness(1.3)"}


@pytest.fixture(scope="module")
def poles(tmp_path_factory):
    figure, ax = new_figure()
    ax.plot([0.0, 1.0], [0.0, 1.0], "--", linewidth=3.0, label="nominal")
    ax.fill_between([0.0, 1.0], 0.0, 1.0, alpha=0.3, label="band")
    ax.legend()
    both = plot_poles({name: np.array([-1.0 + 5.0j]) for name in ("IMSC", "coupled", "a", "b", "c", "d", "e")})
    content = PageContent(title="Poles", blocks=[block(figure, "lines"), block(both, "poles")])
    return write_page(tmp_path_factory.mktemp("page") / "l.html", content)


def test_a_legend_has_the_dash_width_and_marker_of_each_line(poles, look, drawn):
    """As they are drawn: pole markers are hollow, so that one does not cover another."""
    browser = look(poles.as_uri(), 1200)
    lines, plane = drawn(browser, 2)

    def sample(name):
        return browser.find_elements("xpath", f"//button[text()='{name}']//*[local-name()='svg']/*")

    def look_of(mark, *names):
        return [mark.get_attribute(name) for name in names]

    [dashed] = sample("nominal")
    line = lines.find_element("css selector", ".marks path[stroke-dasharray]")
    names = ("stroke", "stroke-width", "stroke-dasharray")
    assert look_of(dashed, *names) == look_of(line, *names) == ["#0072b2", "4", "6 4"]
    assert not sample("band"), "an area has a colour"
    for name, tag in (("IMSC", "circle"), ("coupled", "path"), ("b", "rect"), ("c", "path"), ("d", "path")):
        [mark] = sample(name)
        assert mark.tag_name == tag and mark.get_attribute("fill") in (None, "none")
    hollow = plane.find_elements("css selector", ".marks [fill]:not([fill=none])")
    assert not hollow
    assert len({one.rect["width"] for one in plane.find_elements("css selector", ".marks > :not(line)")}) >= 6
    assert browser.get_log("browser") == []


def test_a_figure_is_zoomed_by_keyboard(stacked, look, drawn):
    from selenium.webdriver import ActionChains, Keys

    browser = look(stacked.as_uri(), 1200)
    above, below = drawn(browser, 2)
    whole = ticks(below)
    browser.execute_script("arguments[0].focus()", above)
    assert above.value_of_css_property("outline-style") == "solid"
    ActionChains(browser).send_keys("+").perform()
    assert browser.switch_to.active_element == above
    zoomed = [float(t) for t in ticks(below)]
    assert 20.0 <= min(zoomed) and max(zoomed) <= 80.0
    ActionChains(browser).send_keys(Keys.ARROW_RIGHT).perform()
    assert max(float(t) for t in ticks(below)) > max(zoomed)
    ActionChains(browser).send_keys(Keys.ESCAPE).perform()
    assert ticks(below) == whole
    assert browser.get_log("browser") == []


def test_tables_sort_and_the_page_follows_light_dark_and_paper(page, look):
    browser = look(page.as_uri(), 1200)
    heads = browser.find_elements("css selector", "th button")

    def column():
        return [cell.text for cell in browser.find_elements("css selector", "td:nth-child(2)")]

    heads[1].click()
    assert column() == ["-0.001", "9", "10", "none"]
    heads[1].click()
    assert column() == ["10", "9", "-0.001", "none"]

    def paper():
        colour = browser.execute_script("return getComputedStyle(document.body).backgroundColor")
        return sum(map(int, re.findall(r"\d+", colour)[:3]))

    assert paper() > 700
    look(page.as_uri(), 1200, scheme="dark")
    assert paper() < 100
    browser.find_element("css selector", ".theme").click()
    assert paper() > 700
    look(page.as_uri(), 1200, scheme="dark", media="print")
    assert paper() > 700
    shown = [e.is_displayed() for e in browser.find_elements("css selector", ".player, .theme, .tools")]
    assert len(shown) == 4 and not any(shown)


def test_a_damaged_figure_leaves_the_others_drawn(page, look, drawn, tmp_path):
    content = json.loads(page.with_suffix(".page.json").read_text())
    content["blocks"] = [{"caption": "damaged", "figure": {}}, {"caption": "moved", "motion": 3}, content["blocks"][0]]
    browser = look(write_page(tmp_path / "p.html", page_content_of(content)).as_uri(), 1200)
    drawn(browser, 4)
    damaged = [stage.text for stage in browser.find_elements("css selector", ".stage")]
    assert damaged[:2] == ["This figure is damaged."] * 2
    assert len(browser.get_log("browser")) == 2


def test_the_content_beside_the_page_makes_the_same_page_again(page, tmp_path):
    again = write_page(tmp_path / "p.html", page_content_in(page.with_suffix(".page.json")))
    assert again.read_bytes() == page.read_bytes()


@pytest.mark.parametrize("name", ["title", "blocks", "tables", "versions"])
def test_a_damaged_content_is_refused(page, name):
    content = json.loads(page.with_suffix(".page.json").read_text())
    with pytest.raises(ValueError, match=name):
        page_content_of({**content, name: 3})
    del content[name]
    with pytest.raises(ValueError, match=name):
        page_content_of(content)


def test_a_figure_becomes_its_numbers():
    figure, ax = new_figure()
    ax.plot([1.0, 2.0, np.nan], [3.0, 1e-9, 5.0], "o--", color="#0072B2", label="a")
    ax.set(xlabel="x", yscale="log", xlim=(0, 4))
    [panel] = described(figure)["panels"]
    [mark] = panel["marks"]
    assert (mark["x"], mark["y"], mark["dash"], mark["marker"]) == ([1, 2, None], [3, 1e-9, 5], "6 4", "o")
    assert mark["colour"] == "#0072b2" and panel["y"]["log"] and panel["x"]["limits"] == [0, 4]


def test_a_long_line_keeps_its_peaks():
    figure, ax = new_figure()
    y = np.zeros(200_000)
    y[[777, 123_456]] = 1.0, -2.0
    ax.plot(np.arange(y.size), y)
    [mark] = described(figure)["panels"][0]["marks"]
    assert len(mark["x"]) <= 4000
    points = dict(zip(mark["y"], mark["x"]))
    assert points[1.0] == 777 and points[-2.0] == 123_456


def test_what_a_page_cannot_draw_becomes_a_picture():
    figure, ax = new_figure()
    ax.pie([1, 2])
    with pytest.raises(Undescribed, match="Wedge"):
        described(figure)
    assert drawable(figure)["picture"].startswith("iVBOR")
