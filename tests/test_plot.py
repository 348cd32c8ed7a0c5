"""Pictures show the numbers: axes, units, colours, and people where they are."""

import itertools
import os
from pathlib import Path
from typing import Any

import matplotlib.colors
import numpy as np
import pytest
import torch

import tensorsim as ts
from tensorsim import plot
from tensorsim.evaluation.report import save_pictures
from tensorsim.plot.overview import overview_figure, save_small


def test_decibels_are_below_the_peak_and_clipped() -> None:
    db = plot.decibels(np.array([[1.0, 0.1], [0.5, 0.0]]), 30.0)
    assert np.allclose(db, [[0, -20], [-6.0206, -30]], atol=1e-3)
    assert (plot.decibels(np.zeros((2, 2)), 30.0) == -30).all()


def test_map_figure_has_axes_with_units_a_colour_bar_and_ridges() -> None:
    magnitude = np.ones((5, 7))
    ridges = np.repeat(np.array([0.0, 1.0, -1.0, 1.5, -1.5, 2.0])[:, None], 7, axis=1)
    figure = plot.map_figure(
        magnitude,
        np.arange(7) / 10,
        np.linspace(-2, 2, 5),
        "map",
        "Doppler in Hz",
        ridges,
        0.5,
        subtitle="film.mp4",
    )
    axes, speed, bar = figure.axes
    assert axes.get_xlabel() == "time in s"
    assert axes.get_ylabel() == "Doppler in Hz"
    assert [line.get_color() for line in axes.lines] == list(plot.RIDGE_COLOURS)
    assert len({matplotlib.colors.to_rgb(colour) for colour in plot.RIDGE_COLOURS}) == 6
    assert np.allclose([line.get_ydata() for line in axes.lines], ridges)
    assert speed.get_ylabel().startswith("radial speed in m/s")
    assert np.allclose(np.array(axes.get_ylim()) * 0.5, speed.get_ylim())
    assert bar.get_ylabel() == "dB below the peak"
    assert figure.get_suptitle() == "film.mp4"
    left, right, bottom, top = axes.images[0].get_extent()
    assert np.allclose([left, right, bottom, top], [-0.05, 0.65, -2.5, 2.5])
    assert axes.images[0].origin == "lower"
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == [f"ridge {number}" for number in range(1, 7)]
    figure.canvas.draw()
    assert legend.get_window_extent().y1 < axes.get_window_extent().y0, "covers nothing of the map"


def test_long_maps_are_thinned_by_power() -> None:
    magnitude = np.zeros((1, 40_000))
    magnitude[0, 100] = 3.0
    thin = plot.maps.thin_columns(magnitude)
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


def test_a_keypoint_at_infinity_is_drawn_as_far_outside() -> None:
    keypoints = np.full((1, 17, 2), 50.0)
    keypoints[0, 9] = 1e11, 5.0
    image, scores = np.zeros((100, 100, 3), np.uint8), np.ones((1, 17))
    drawn = plot.draw_people(image, np.full((1, 4), 1e11), keypoints, scores, np.ones(1, dtype=bool), 0.3)
    assert drawn[:50, 60:].any(), "the forearm leads there"


def test_the_radar_stands_where_its_antennas_are() -> None:
    joints = np.random.default_rng(0).normal(size=(1, 4, 14, 3))
    figure = plot.skeleton_figure(joints, np.ones((1, 4), dtype=bool), 10.0, radar_m=(0.2, 0.1, 2.5))
    radar = figure.axes[0].collections[0]
    assert np.array(radar._offsets3d)[:, 0].tolist() == [0.2, 0.1, 2.5]


def test_skeleton_figure_shows_only_people_who_are_there() -> None:
    joints = np.random.default_rng(0).normal(size=(2, 10, 14, 3))
    valid = np.zeros((2, 10), dtype=bool)
    valid[0, 2:8] = True
    figure = plot.skeleton_figure(joints, valid, 10.0, poses=3)
    labels = [t.get_text() for t in figure.axes[0].get_legend().get_texts()]
    assert labels == ["person 1, 0.2 to 0.7 s", "radar"]
    *poses, way = figure.axes[0].lines
    assert len(way.get_data_3d()[0]) == 6
    assert len(poses) == 3
    for pose, frame in zip(poses, (2, 4, 7), strict=True):
        bones = np.stack(pose.get_data_3d(), axis=-1).reshape(-1, 3, 3)
        assert np.isnan(bones[:, 2]).all(), "bones are apart from each other"
        assert np.array_equal(bones[:, :2], joints[0, frame][np.array(plot.BODY_BONES)])


def test_ridges_are_hidden_where_dots_would_cover_the_map() -> None:
    axis = np.arange(-10.0, 11.0)
    shown = np.zeros((21, 4), dtype=bool)
    shown[8:14, 0] = True  # -2 to 3: high enough
    shown[10, 1] = True  # one row
    shown[:, 2] = True
    ridges = np.array([[0.0, 0.0, 5.0, 0.0], [3.0, np.nan, 5.5, np.nan]])
    kept = plot.clear_ridges(ridges, axis, shown, least_height=4.0)
    expected = np.array([[0.0, np.nan, 5.0, np.nan], [3.0, np.nan, np.nan, np.nan]])
    assert np.array_equal(kept, expected, equal_nan=True)


def test_style_without_ridges_and_with_another_range_and_colour_map() -> None:
    style = plot.MapStyle("parula", dynamic_range_db=30.0, ridges=False)
    magnitude = np.logspace(-3, 0, 20)[:, None] * np.ones((20, 4))
    figure = plot.map_figure(
        magnitude, np.arange(4.0), np.arange(20.0), "map", "range in m", np.ones((1, 4)), style=style
    )
    axes = figure.axes[0]
    assert len(axes.lines) == 0
    assert axes.images[0].get_clim() == (-30, 0)
    assert axes.images[0].get_cmap().name == "parula-like"
    with pytest.raises(ts.TensorsimError, match="colormap: got 'parulla'"):
        plot.MapStyle("parulla")  # type: ignore[arg-type]
    with pytest.raises(ts.TensorsimError, match="dynamic_range_db"):
        plot.MapStyle(dynamic_range_db=0.0)


def test_parula_like_runs_from_blue_to_yellow_and_grows_lighter() -> None:
    colours = plot.colormap("parula")(np.linspace(0, 1, 64))[:, :3]
    lightness = colours @ (0.2126, 0.7152, 0.0722)
    assert (np.diff(lightness) > 0).all()
    assert colours[0].argmax() == 2
    assert colours[-1].argmin() == 2


def test_noise_of_an_empty_scene_is_drawn_below_the_echo_of_a_person() -> None:
    simulator = ts.radar.RadarSimulator(ts.RadarConfig.free_space())
    state = torch.get_rng_state()
    peaks = plot.person_peaks(simulator)
    assert torch.equal(state, torch.get_rng_state())
    empty = simulator(torch.tensor([0.0, 3.0, 1.0]).expand(1000, 1, 3), torch.zeros(1))
    for name, peak in peaks.items():
        magnitude = getattr(empty, name).numpy()
        assert plot.decibels(magnitude, 90.0, peak).max() < -50
    magnitude = empty.doppler_time.numpy()
    figure = plot.map_figure(
        magnitude,
        np.arange(magnitude.shape[1]),
        simulator.doppler.doppler_hz.numpy(),
        "map",
        "Doppler in Hz",
        peak=peaks["doppler_time"],
        note="no person in the scene",
    )
    assert (figure.axes[0].images[0].get_array() == -50).all()
    assert figure.axes[0].texts[0].get_text() == "no person in the scene"
    assert figure.axes[1].get_ylabel() == "dB below the echo of a person"


RADARS: dict[str, tuple[ts.RadarConfig, dict[str, Any]]] = {
    "beside": (ts.RadarConfig.through_wall(tx_m=(2.9, 1.0, 1.5), rx_m=(3.1, 1.0, 1.5)), {}),
    "behind": (ts.RadarConfig.through_wall(tx_m=(-0.1, 3.0, 1.5), rx_m=(0.1, 3.0, 1.5)), {}),
    "long window": (ts.RadarConfig.through_wall(), {"window_s": 1.7}),
    "far gate": (ts.RadarConfig.through_wall(), {"range_gate_m": (3.0, 6.0)}),
}


@pytest.mark.parametrize(("radar", "options"), RADARS.values(), ids=RADARS)
def test_the_echo_of_a_person_is_that_of_one_at_3_m(
    radar: ts.RadarConfig, options: dict[str, Any], recwarn: pytest.WarningsRecorder
) -> None:
    usual = plot.person_peaks(ts.radar.RadarSimulator(ts.RadarConfig.through_wall()))["range_time"]
    peak = plot.person_peaks(ts.radar.RadarSimulator(radar, **options))["range_time"]
    assert not recwarn.list
    assert peak == pytest.approx(usual, rel=0.25 if options == {} else 1.0)


def test_the_echo_of_a_person_before_a_slow_radar() -> None:
    """Half of its unambiguous speed, 0.24 m/s; at 1 m/s the map would be refused."""
    simulator = ts.radar.RadarSimulator(ts.RadarConfig(prf_hz=500.0))
    doppler_time = plot.person_peaks(simulator)["doppler_time"]
    assert doppler_time > 0


def test_a_map_of_one_row_is_drawn() -> None:
    figure = plot.map_figure(np.ones((1, 20)), np.arange(20.0), np.zeros(1), "map", "range in m")
    assert figure.axes[0].get_ylim() == (-0.5, 0.5)


def test_caption_names_film_radar_and_label() -> None:
    radar = ts.RadarConfig.free_space()
    line = plot.caption(radar, "S8 Walking", "films/clip.mp4")
    assert line == "clip.mp4 | 77 GHz, sweep 4 GHz, PRF 8192 Hz | S8 Walking"
    assert plot.caption(radar, film=os.fsdecode(b"caf\xe9.npz")).startswith("caf?.npz | ")
    assert plot.caption(radar) == "77 GHz, sweep 4 GHz, PRF 8192 Hz"


def test_names_with_dollar_signs_are_drawn_as_they_are(tmp_path: Path) -> None:
    """Between two of them matplotlib reads mathematics, which ``a_$`` is not."""
    name, axis = "a$b_$c.mp4", np.arange(5.0)
    confusion = plot.confusion_figure(np.eye(2), [name, "b"], "counts")
    maps = plot.map_figure(np.ones((5, 5)), axis, axis, "map", "range in m", subtitle=name)
    skeleton = plot.skeleton_figure(np.zeros((0, 4, 14, 3)), np.zeros((0, 4), bool), 10.0, subtitle=name)
    for figure in (confusion, maps, skeleton):
        plot.save_figure(figure, tmp_path / "figure.png")
    save_pictures(tmp_path / "maps.png", {name: [(name, np.ones((5, 5)))]}, axis)


def test_skeleton_axes_hold_feet_below_the_floor_and_what_is_far_off_is_reported() -> None:
    joints = np.zeros((1, 4, 14, 3))
    joints[..., 1] = 3.0
    joints[..., 2] = np.linspace(1.5, -0.3, 14)
    joints[0, :, 4, 0] = 9.0
    figure = plot.skeleton_figure(joints, np.ones((1, 4), dtype=bool), 10.0, poses=4)
    axes = figure.axes[0]
    assert axes.get_zlim()[0] <= -0.3
    assert axes.get_xlim()[1] < 2.0
    assert "4 of 56 joints lie more than 1.5 m from their hips" in figure.get_supxlabel()
    assert "the lowest joint is 0.30 m below the floor" in figure.get_supxlabel()


@pytest.mark.parametrize(("suffix", "start"), [("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")])
def test_figures_are_written_by_suffix(suffix: str, start: bytes, tmp_path: Path) -> None:
    figure = plot.confusion_figure(np.eye(2), ["a", "b"], "counts")
    plot.save_figure(figure, tmp_path / f"figure.{suffix}")
    assert (tmp_path / f"figure.{suffix}").read_bytes().startswith(start)
    with pytest.raises(ts.TensorsimError, match=r"got the suffix '\.bmp', expected one of"):
        plot.save_figure(figure, tmp_path / "figure.bmp")


def test_tick_labels_do_not_overlap() -> None:
    axis = np.linspace(-4096, 4096, 819)
    figure = plot.map_figure(np.ones((819, 9)), np.arange(9.0), axis, "map", "Doppler in Hz", None, 1.95e-3)
    figure.canvas.draw()
    boxes = [
        label.get_window_extent()
        for axes in figure.axes
        for place, label in [
            *zip(axes.get_yticks(), axes.get_yticklabels(), strict=True),
            (axes.get_ylim()[0], axes.yaxis.label),
        ]
        if axes.get_ylim()[0] <= place <= axes.get_ylim()[1]
    ]
    assert len(boxes) > 15
    assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))


@pytest.mark.parametrize("last_m", [7.0, 12.0, 28.0, 200.0])
def test_labels_of_the_skeletons_have_room(last_m: float) -> None:
    joints = np.zeros((1, 20, 14, 3))
    joints[0] = np.linspace([-1.0, 3.0, 1.0], [1.0, last_m, 1.0], 20)[:, None]
    figure = plot.skeleton_figure(joints, np.ones((1, 20), bool), 10.0)
    figure.canvas.draw()
    (axes,) = figure.axes
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        low, high = axis.get_view_interval()
        ticks = [tick.label1 for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high]
        boxes = [text.get_window_extent().padded(2) for text in ticks]
        assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))


def test_the_doppler_axis_is_as_wide_as_what_stands_out_of_the_noise() -> None:
    doppler_hz = np.linspace(-4000, 4000, 801)
    noise = 0.01 * np.random.default_rng(0).random((801, 50))  # above the floor of the colours
    brief = np.where((np.abs(doppler_hz) < 900)[:, None] & (np.arange(50) == 20), 1.0, noise)
    assert plot.doppler_span(brief, doppler_hz) == pytest.approx(1.25 * 890)
    # Brisk motion behind a wall fills most of the axis at one time or another.
    wide = np.where((doppler_hz < 2500)[:, None] & (np.arange(50) % 5 == 0), 0.5, brief)
    assert plot.doppler_span(wide, doppler_hz) >= 4000
    weak = np.where(np.abs(doppler_hz)[:, None] < 1500, 1e-3 * np.ones(50), 1e-6)
    weak[400] = 1.0
    assert plot.doppler_span(weak, doppler_hz, 70.0) == pytest.approx(1.25 * 1490)
    assert plot.doppler_span(weak, doppler_hz, 40.0) == pytest.approx(1.25 * 500)


def test_overview_shows_a_run_in_a_small_picture(tmp_path: Path) -> None:
    frames = [np.full((48, 64, 3), 128, np.uint8)] * 4
    ts.data.write_video(tmp_path / "overlay.mp4", frames, 10.0)
    rows = np.zeros((64, 30))
    rows[40] = 1.0
    np.savez(
        tmp_path / "maps.npz",
        range_time_mti=rows,
        doppler_time=rows,
        range_m=np.arange(64.0),
        doppler_hz=np.arange(64.0) - 32,
        time_s=np.arange(30) / 10,
        range_time_rate_hz=10.0,
    )
    figure = overview_figure(tmp_path)
    picture, range_axes, doppler_axes, _ = figure.axes
    assert np.abs(picture.images[0].get_array().mean() - 128) < 4
    assert range_axes.get_ylabel() == "range in m"
    assert np.allclose(doppler_axes.get_ylim(), (-10.0, 10.0))
    save_small(figure, tmp_path / "overview.png")
    assert (tmp_path / "overview.png").read_bytes().startswith(b"\x89PNG")
    (tmp_path / "maps.npz").unlink()
    with pytest.raises(ts.TensorsimError, match=r"got no maps\.npz"):
        overview_figure(tmp_path)
