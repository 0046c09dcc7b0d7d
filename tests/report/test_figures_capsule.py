"""Figures of simulated motions draw what they are given, where they are told to."""

import numpy as np

from capsule_id.records.view import MotionView
from capsule_id.report.figures.fits import overview, overview_size, phase_plane
from capsule_id.report.figures.style import new_axes, new_figure, png


def test_phase_plane_shows_impact_line_and_section() -> None:
    s = np.linspace(0.0, 1.0, 50)
    view = MotionView(
        s, {"x_capsule": s, "x_rel": 1e-3 * s}, 1e-3 * s, 0.1 * s, np.array([5e-4]), np.array([0.05]), 8e-4
    )
    phase_plane(view, ax := new_axes(4.0, 3.0))
    path, impact, section = ax.lines
    np.testing.assert_allclose(path.get_xdata(), 1e3 * view.x_rel)
    np.testing.assert_allclose(impact.get_xdata(), 0.8)
    np.testing.assert_allclose([section.get_xdata()[0], section.get_ydata()[0]], [0.5, 0.05])
    overview(view, figure := new_figure(*overview_size(view)))
    assert [ax.get_ylabel() for ax in figure.axes] == ["X2, mm", "X1 - X2, mm", "Y1 - Y2, m/s"]
    assert png(figure).startswith(b"\x89PNG")
