"""The look of figures."""

import pytest

from workbench.draw.style import new_figure, plain_ticks


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
