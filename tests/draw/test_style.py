"""The look of figures."""

import pytest

from workbench.draw.style import new_figure, plain_ticks, prefixed


@pytest.mark.parametrize(("low", "high", "expected"), [(0.1, 30.0, "1"), (1.2, 4.0, "2"), (1e-12, 1.0, None)])
def test_logarithmic_axes_have_plain_numbers_where_they_are_few(low, high, expected):
    figure, ax = new_figure()
    ax.loglog([1.0, 2.0], [low, high])
    plain_ticks(figure).draw_without_rendering()
    texts = [label.get_text() for label in (*ax.get_yticklabels(), *ax.get_yticklabels(minor=True))]
    if expected is None:
        assert any("10^" in text for text in texts)
    else:
        assert expected in texts and not any("10^" in text or "times" in text for text in texts)


def test_numbers_of_a_logarithmic_axis_within_a_decade_reach_along_it():
    figure, ax = new_figure()
    ax.semilogy([0.0, 1.0], [0.13, 0.26])
    ax.set_ylim(0.13, 0.26)
    plain_ticks(figure).draw_without_rendering()
    shown = [float(mark.label1.get_text() or "nan") for mark in ax.yaxis.get_minor_ticks()]
    assert min(value for value in shown if value > 0.13) < 0.16


@pytest.mark.parametrize("extent", [2.5, 2.95, 4.0, 9.0])
@pytest.mark.parametrize(
    "low", [0.0101, *(pytest.param(low, marks=pytest.mark.slow) for low in (0.01, 0.0301, 0.051, 0.0701))]
)
def test_a_short_logarithmic_axis_has_two_numbers_at_least_and_no_crowd(low, extent):
    figure, ax = new_figure()
    ax.semilogx([low, low * extent], [0.0, 1.0])
    ax.set_xlim(low, low * extent)
    plain_ticks(figure).draw_without_rendering()
    marks = [*ax.xaxis.get_major_ticks(), *ax.xaxis.get_minor_ticks()]
    shown = {m.label1.get_text() for m in marks if low <= m.get_loc() <= low * extent} - {""}
    assert 2 <= len(shown) <= (8 if extent < 2.9 else 5)


@pytest.mark.parametrize(
    ("largest", "unit", "factor", "expected"),
    [
        (2e-5, "m", 1e6, "µm"),
        (1.2e-12, "J", 1e12, "pJ"),
        (0.02, "m", 1.0, "m"),
        (0.0, "J", 1.0, "J"),
        (2e-5, "N mm", 1e6, "10⁻⁶ N mm"),
        (3e-17, "J", 1e18, "10⁻¹⁸ J"),
    ],
)
def test_small_values_are_in_a_unit_with_a_prefix(largest, unit, factor, expected):
    found, name = prefixed(largest, unit)
    assert found == pytest.approx(factor) and name == expected
