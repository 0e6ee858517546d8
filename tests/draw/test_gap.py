"""The places of an unmodelled force are drawn with the likeliest on top, and models in their colours."""

from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.colors import to_hex

from workbench.draw.gap import ALIKE, _plot_places, plot_responses, units_of_inputs
from workbench.draw.interactive import described
from workbench.draw.motion import mode_motion
from workbench.draw.style import new_figure
from workbench.records.units import SI
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.structure.domain import Interval, NamedPoints, Rectangle

NOMINAL, CORRECTED = "#d55e00", "#0072b2"


def verdict_of(domain, places, profile, at):
    place = SimpleNamespace(places=places, profile=profile, at=at, is_single_force=True)
    effect = SimpleNamespace(at=at, kind=SimpleNamespace(path="structure"))
    return SimpleNamespace(
        where=SimpleNamespace(place=place),
        nominal=SimpleNamespace(modes=SimpleNamespace(domain=domain)),
        effects=(effect,),
        outcome="explained",
        units=SI,
    )


def test_along_a_structure_the_likeliest_place_is_on_top_and_all_of_the_curve_inside():
    x = np.linspace(0.0, 2.0, 41)
    profile = -4000.0 * (x - 0.7) ** 2 - 3.0
    figure, ax = new_figure()
    _plot_places(ax, verdict_of(Interval(2.0), tuple(x), profile, 0.7))
    figure.draw_without_rendering()
    below, (low, high) = ax.lines[0].get_ydata(), ax.get_ylim()
    np.testing.assert_allclose(below, np.maximum(profile.max() - profile, ALIKE))
    assert low > below.max() and 0 < high < below.min() and below.argmin() == 14
    names = [label.get_text() for label in ax.get_yticklabels()]
    assert names == ["≤ 0.1", "1", "10", "100", "1000"] and "-" not in "".join(names)
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["most likely position", "named effect"]


def test_over_a_plate_places_have_a_colour_bar_and_marks_a_legend():
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(0.0, 1.0, 11), np.linspace(0.0, 0.5, 6)))
    profile = -300.0 * ((x - 0.3) ** 2 + (y - 0.2) ** 2)
    figure, ax = new_figure()
    _plot_places(ax, verdict_of(Rectangle((1.0, 0.5)), tuple(zip(x, y)), profile, (0.3, 0.2)))
    figure.draw_without_rendering()
    bar = figure.axes[1]
    assert bar.get_ylabel() == "log-likelihood below its maximum [-]"
    bottom, top = bar.get_ylim()
    assert top == pytest.approx(ALIKE) and bottom == pytest.approx(np.ptp(profile))
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["most likely position", "named effect"]
    assert all(line.get_path_effects() for line in ax.lines), "each has a white edge"


def test_named_points_that_fit_alike_have_bars_that_are_seen():
    names = ("a.x", "b.x", "c.x", "d.x", "e.x")
    figure, ax = new_figure()
    _plot_places(ax, verdict_of(NamedPoints(names), names, np.array([-3.0, -40.0, -3.02, -3000.0, -3.0]), "b.x"))
    (panel,) = described(figure)["panels"]  # a page draws it, not a picture
    (bars,) = (mark for mark in panel["marks"] if mark["kind"] == "bars")
    low, high = panel["x"]["limits"]
    lengths = [np.log(box[1] / box[0]) / np.log(high / low) for box in bars["boxes"]]
    assert min(lengths) > 0.05 and max(lengths) < 1.0
    np.testing.assert_allclose([box[1] for box in bars["boxes"]], [ALIKE, ALIKE, ALIKE, 37.0, 2997.0])
    assert [t["text"] for t in panel["marks"] if t["kind"] == "text"] == [
        "most likely",
        "equally likely",
        "equally likely",
    ]
    assert [name for _, name in panel["y"]["ticks"]] == ["a.x", "e.x", "c.x", "b.x (named)", "d.x"]
    assert panel["x"]["ticks"][0][1] == "≤ 0.1"


def test_the_rms_of_inputs_has_their_units():
    force, other, moment = Actuator("F", 0.3), Actuator("G", 0.5), Actuator("M", 0.4, quantity="moment")
    driven = Actuator("U", 0.4, gain=2.5)
    assert units_of_inputs([force, other], SI) == "N"
    assert units_of_inputs([force, moment], SI) == "N and N m"
    assert units_of_inputs([driven], SI) == "unit of the command"


def test_a_model_has_one_colour_in_responses_and_in_shapes_that_move(hinged_beam):
    sensors = (Sensor("d1", 0.3), Sensor("d2", 0.7))
    rig = Rig(hinged_beam.modes(3), (Actuator("F1", 0.45), Actuator("F2", 1.2)), sensors, structure=hinged_beam)
    record = simulate(rig, np.random.default_rng(0).normal(size=(2, 50)), sample_time=0.01, name="one")
    lines = plot_responses({"nominal": rig, "corrected": rig}, [record]).axes[0].lines
    colours = {line.get_label(): to_hex(line.get_color()) for line in lines}
    tracks = mode_motion({"nominal": rig.modes, "corrected": rig.modes})["tracks"]
    assert {track["label"]: track["colour"].lower() for track in tracks} == {"nominal": NOMINAL, "corrected": CORRECTED}
    assert (colours["nominal"], colours["corrected"]) == (NOMINAL, CORRECTED)
