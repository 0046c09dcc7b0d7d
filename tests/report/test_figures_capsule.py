"""Figures of simulated motions draw what they are given, where they are told to."""

import numpy as np

from capsule_id.report.figures.style import MotionView, motion, new_figure, phase_plane, png


def test_phase_plane_shows_impact_line_and_section() -> None:
    s = np.linspace(0.0, 1.0, 50)
    view = MotionView(s, 1e-3 * s, s, 0.1 * s, np.array([5e-4]), np.array([0.05]), 8e-4)
    figure = new_figure(4.0, 3.0)
    ax = figure.subplots()
    assert phase_plane(view, ax) is ax
    path, impact, section = ax.lines
    np.testing.assert_allclose(path.get_xdata(), s)
    np.testing.assert_allclose(impact.get_xdata(), 0.8)
    np.testing.assert_allclose([section.get_xdata()[0], section.get_ydata()[0]], [0.5, 0.05])
    assert png(motion(view)).startswith(b"\x89PNG")
