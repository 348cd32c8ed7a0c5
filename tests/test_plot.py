"""Pictures show the numbers: axes, units, colours, and people where they are."""

import numpy as np

from tensorsim import plot


def test_decibels_are_below_the_peak_and_clipped() -> None:
    db = plot.decibels(np.array([[1.0, 0.1], [0.5, 0.0]]), 30.0)
    assert np.allclose(db, [[0, -20], [-6.0206, -30]], atol=1e-3)
    assert (plot.decibels(np.zeros((2, 2)), 30.0) == -30).all()


def test_map_figure_has_axes_with_units_a_colour_bar_and_ridges() -> None:
    magnitude = np.ones((5, 7))
    figure = plot.map_figure(
        magnitude, np.arange(7) / 10, np.linspace(-2, 2, 5), "map", "Doppler in Hz", np.zeros((2, 7)), 0.5
    )
    axes = figure.axes[0]
    assert axes.get_xlabel() == "time in s"
    assert axes.get_ylabel() == "Doppler in Hz"
    assert len(axes.lines) == 2
    assert [a.get_ylabel() for a in figure.axes[1:]] == ["dB below the peak"]
    left, right, bottom, top = axes.images[0].get_extent()
    assert np.allclose([left, right, bottom, top], [-0.05, 0.65, -2.5, 2.5])
    assert axes.images[0].origin == "lower"


def test_long_maps_are_thinned_by_power() -> None:
    magnitude = np.zeros((1, 40_000))
    magnitude[0, 100] = 3.0
    thin = plot._thin_columns(magnitude)
    assert thin.shape[1] <= 4000
    assert np.isclose(np.square(thin).sum() * 20, 9.0)


def test_people_are_drawn_where_they_are_on_a_copy() -> None:
    image = np.zeros((100, 100, 3), dtype=np.uint8)
    keypoints = np.full((2, 17, 2), 50.0)
    drawn = plot.draw_people(
        image,
        np.array([[10, 20, 60, 80], [0, 0, 5, 5]], dtype=float),
        keypoints,
        np.ones((2, 17)),
        np.array([True, False]),
        0.3,
    )
    assert image.max() == 0
    assert tuple(drawn[40, 10]) == plot.PERSON_COLOURS[0]
    assert drawn[50, 50].any()
    assert not drawn[2:4, 0:5].any(), "an invalid person is not drawn"


def test_skeleton_figure_shows_only_people_who_are_there() -> None:
    joints = np.random.default_rng(0).normal(size=(2, 10, 14, 3))
    valid = np.zeros((2, 10), dtype=bool)
    valid[0, 2:8] = True
    figure = plot.skeleton_figure(joints, valid, 10.0, poses=3)
    labels = [t.get_text() for t in figure.axes[0].get_legend().get_texts()]
    assert labels == ["person 1", "radar"]
    assert len(figure.axes[0].lines) == 3 * len(plot.BODY_BONES) + 1
