"""The configuration of a whole run: documents, changes, conflicts, and the stages that it makes."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import tensorsim as ts
from tensorsim import cli
from tensorsim.commands.options import FIELDS, RadarOptions
from tensorsim.commands.simulate import Simulate
from tensorsim.config.people import PANEL_WEIGHTS_KG
from tensorsim.errors import TensorsimError
from tensorsim.pipeline import PoseToDoppler, VideoToPose
from tensorsim.vision.pose2d.topdown import FlipTest, TopDownPose
from tests.film import RectangleDetector, StandingPose, film, walker
from tests.stage import assert_same

CHANGED = {
    "scene__radar__prf_hz": 4096.0,
    "scene__wall": ts.WallConfig(loss_tangent=0.01),
    "scene__snr_db": None,
    "processing__range_gate_m": (1.0, 6.0),
    "tracking__max_tracks": 2,
    "pose__person_height_m": (1.6, 1.9, 1.7),
    "pose__camera__pitch_rad": 0.1,
    "smoothing__mode": "forward",
    "seed": 7,
}


def test_a_yaml_file_holds_everything(tmp_path: Path) -> None:
    config = ts.SimulationConfig().replace(**CHANGED)
    config.to_yaml(tmp_path / "run.yaml")
    assert ts.SimulationConfig.from_yaml(tmp_path / "run.yaml") == config
    assert ts.SimulationConfig.from_document(json.loads(json.dumps(config.to_document()))) == config
    numpy = {
        "scene__radar__carrier_hz": np.float64(60e9),
        "scene__radar__tx_m": np.zeros(3, dtype=np.float32),
        "scene__snr_db": np.float32(20.5),
        "scene__bounces": np.int32(2),
        "scene__receiver__iq_imbalance_db": np.float64(0.5),
        "scene__receiver__adc_bits": np.int64(8),
        "processing__display_rate_hz": np.int64(30),
        "processing__ridge_count": np.int64(2),
    }
    config = ts.SimulationConfig().replace(**numpy)
    assert type(config.scene.bounces) is type(config.processing.ridge_count) is int
    torch.jit.script(ts.radar.RadarSimulator(config.scene))
    config.to_yaml(tmp_path / "run.yaml")
    assert ts.SimulationConfig.from_yaml(tmp_path / "run.yaml") == config
    (tmp_path / "some.yaml").write_text("scene: {radar: {prf_hz: 4e3}}\nseed: 3\n")
    expected = ts.SimulationConfig().replace(scene__radar__prf_hz=4000.0, seed=3)
    assert ts.SimulationConfig.from_yaml(tmp_path / "some.yaml") == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("tracker: {}", r"run.yaml: got the key 'tracker', .*perhaps 'tracking'"),
        ("scene: {snr: 3}", r"run.yaml: scene: got the key 'snr', .*snr_db"),
        ("scene: {wall_paths: best}", r"scene: SceneConfig.wall_paths: got 'best', expected one of 'series', 'paper'"),
        ("tracking: {max_tracks: 1.5}", r"tracking: max_tracks: got 1.5, expected a whole number"),
        ("pose: {flip_test: 1}", r"pose: flip_test: got 1, expected true or false"),
        ("scene: {paths: direct}", r"scene: paths: got 'direct', expected a list of names"),
        ("processing: {range_gate_m: near}", r"range_gate_m: got 'near', expected a number"),
        ("classifier: [a]", r"classifier: got \['a'\], expected text"),
        ("pose: {people: 2}", r"people: got 2, expected text, in quotes: \"2\""),
        ("seed: -1", r"seed: got -1, expected an integer from 0"),
        ("scene: {radar: {carrier_hz: .nan}}", r"scene: radar: carrier_hz: got .*nan"),
    ],
)  # fmt: skip
def test_a_bad_file_is_refused_with_its_key(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "run.yaml").write_text(text)
    with pytest.raises(TensorsimError, match=message):
        ts.SimulationConfig.from_yaml(tmp_path / "run.yaml")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scene__snr": 3.0}, "got no 'snr' in SceneConfig, expected one of its fields, perhaps 'snr_db'"),
        ({"pose__keypoint_threshold": 1.5}, "keypoint_threshold: got 1.5, expected a score in"),
        ({"scene__wall__loss_tangent": 0.1}, "got 'loss_tangent', but this scene has no 'wall'"),
        ({"scene": 3}, "SimulationConfig.scene: got 3, expected a SceneConfig"),
        ({"pose__person_weight_kg": ()}, "person_weight_kg: got no values"),
        ({"scene__paths": ("direct",), "scene__leakage": True}, "got names of paths and leakage"),
        ({"smoothing__brief_gap_s": float("nan")}, "brief_gap_s: got nan, expected time from 0 to"),
        ({"smoothing__brief_gap_s": -1.0}, "brief_gap_s: got -1, expected time from 0 to"),
        ({"smoothing__smoothing_ratio": 1e9}, r"got 1e\+09, expected length of a window from .* to 1000 s"),
        (
            {"processing__window_s": 1e7},
            r"window_s: got 1e\+07, expected length of a window from .* to 1000 s",
        ),
    ],
)
def test_a_bad_change_is_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        ts.SimulationConfig().replace(**change)


def test_every_parameter_of_the_panel_is_an_option() -> None:
    """Each option names a field that exists; the defaults of these fields are those of the panel."""
    config = ts.SimulationConfig.through_wall()
    for option, path in FIELDS.items():
        assert any(field.name == option for field in dataclasses.fields(Simulate)), option
        part: object = config
        for name in path.split("__"):
            assert hasattr(part, name), path
            part = getattr(part, name)
    tracking, pose = config.tracking, config.pose
    assert (tracking.detection_interval, tracking.max_tracks, tracking.assignment_threshold) == (2, 5, 150.0)
    assert (tracking.confirm_hits, tracking.confirm_window) == (2, 5)
    assert (tracking.delete_misses, tracking.delete_window, tracking.min_box_px) == (23, 23, 5.0)
    assert pose.person_height_m == (1.80, 1.70)
    assert pose.person_weight_kg == (84.24, 75.00)
    assert ts.SimulationConfig.paper().pose.initial_distance_m == (4.00, 0.50)
    assert ts.SimulationConfig.paper().smoothing.smoothing_ratio == 0.25
    assert (config.processing.window_s, config.processing.overlap, config.processing.ridge_count) == (
        0.1,
        0.9,
        3,
    )


def test_options_change_the_configuration_of_a_file(tmp_path: Path) -> None:
    ts.SimulationConfig().replace(**CHANGED).to_yaml(tmp_path / "run.yaml")
    config = RadarOptions(config=tmp_path / "run.yaml", snr=20.0, wall_permittivity=4.0).configuration()
    changed = CHANGED | {"scene__snr_db": 20.0}
    expected = ts.SimulationConfig().replace(**changed, scene__wall__relative_permittivity=4.0)
    assert config == expected
    paper = RadarOptions(paper=True, scene="through-wall").configuration()
    assert paper == ts.SimulationConfig.paper(ts.SimulationConfig.through_wall())
    with pytest.raises(
        TensorsimError,
        match="--wall-permittivity: got 'relative_permittivity', but this scene has no 'wall'",
    ):
        RadarOptions(wall_permittivity=4.0).configuration()


@pytest.mark.parametrize(
    ("option", "value", "beside"),
    [
        ("multipath", True, {"scene": "through-wall"}),
        ("wall_echo", True, {"scene": "through-wall"}),
        ("wall_paths", "paper", {"scene": "through-wall"}),
        ("isolation_db", 0.0, {"leakage": True}),
        ("adc_headroom_db", 0.0, {"adc_bits": 8}),
    ],
)
def test_an_option_that_would_do_nothing_is_refused(
    option: str, value: object, beside: dict[str, object], tmp_path: Path
) -> None:
    with pytest.raises(TensorsimError, match=f"--{option.replace('_', '-')} has no effect without"):
        RadarOptions(**{option: value}).configuration()  # type: ignore[arg-type]
    config = RadarOptions(**{option: value}, **beside).configuration()  # type: ignore[arg-type]
    # Settings of a configuration that have no effect are no options.
    config = config.replace(scene__wall=None, scene__leakage=False, scene__receiver__adc_bits=None)
    config.to_yaml(tmp_path / "run.yaml")
    assert RadarOptions(config=tmp_path / "run.yaml").configuration() == config


def test_a_summary_repeats_its_run_to_the_bit(tmp_path: Path) -> None:
    steps = np.linspace(0, 1, 45)[:, None, None]
    body = np.array([0, 4, 1]) + np.random.default_rng(0).normal(0, 0.3, (14, 3))
    np.savez(tmp_path / "walk.npz", joints=body + steps * [0.0, -1.0, 0.0], fps=30.0)
    first, again = tmp_path / "first", tmp_path / "again"
    run = ["simulate", str(tmp_path / "walk.npz"), "--quiet", "--out"]
    options = [
        "--scene",
        "through-wall",
        "--snr",
        "12",
        "--seed",
        "5",
        "--ridges",
        "2",
        "--classifier",
        "none",
    ]
    cli.main([*run, str(first), *options])
    cli.main([*run, str(again), "--config", str(first / "summary.json")])
    for name in ("maps.npz", "pose.npz"):
        with np.load(first / name) as one, np.load(again / name) as other:
            assert one.files == other.files
            assert all(np.array_equal(one[key], other[key]) for key in one.files)
    summaries = [json.loads((folder / "summary.json").read_text()) for folder in (first, again)]
    assert summaries[0]["config"] == summaries[1]["config"]
    assert summaries[0]["config"]["processing"]["ridge_count"] == 2


@pytest.mark.slow
def test_a_graph_made_by_hand_equals_that_of_the_configuration() -> None:
    """The README's composition, ``from_config`` and ``from_pretrained`` use the mirror image in the same way."""
    detector, network = ts.vision.RTMDet.from_pretrained(), ts.vision.HRNet.from_pretrained()
    graphs = (
        ts.VideoToDoppler(detector=detector, pose=network, radar=ts.RadarConfig.through_wall(), snr_db=None),
        ts.VideoToDoppler.from_pretrained(radar=ts.RadarConfig.through_wall(), snr_db=None),
        ts.VideoToDoppler.from_config(
            ts.SimulationConfig().replace(scene__radar=ts.RadarConfig.through_wall(), scene__snr_db=None)
        ),
    )
    assert all(isinstance(graph.video_to_pose.pose.network, FlipTest) for graph in graphs)
    # The drawn person is found by a detector of rectangles; the shipped pose network gives some result for it.
    video = film(*walker(12, 10.0, 4.0, 1.0, 0.0))[None]
    with torch.no_grad():
        for graph in graphs:
            graph.eval().video_to_pose.detector = RectangleDetector()
        poses = [graph.video_to_pose(video, 10.0) for graph in graphs]
    assert float(poses[0].keypoint_scores.max()) > 0.05
    for pose in poses[1:]:
        assert_same(pose, poses[0], atol=1e-6)


class OwnPose(nn.Module):
    """A pose stage with the signature of TopDownPose."""

    def forward(self, images: Tensor, boxes: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        return boxes.new_zeros(*boxes.shape[:2], 17, 2), boxes.new_zeros(*boxes.shape[:2], 17)


def test_own_pose_stages_are_not_wrapped() -> None:
    for pose in (OwnPose(), TopDownPose(nn.Identity())):
        assert VideoToPose(RectangleDetector(), pose).pose is pose
    assert isinstance(VideoToPose(RectangleDetector(), StandingPose()).pose, TopDownPose)
    scripted = torch.jit.script(TopDownPose(nn.Identity()))
    assert VideoToPose(RectangleDetector(), scripted).pose is scripted


def test_presets_work_by_name() -> None:
    graph = ts.VideoToDoppler(RectangleDetector(), StandingPose(), radar="cw-24ghz")
    assert graph.pose_to_doppler.simulator.radar == ts.radar.PRESETS["cw-24ghz"].radar
    with pytest.raises(TensorsimError, match="perhaps 'ti-awr1843'"):
        ts.VideoToDoppler(RectangleDetector(), StandingPose(), radar="ti-awr1834")
    with pytest.raises(
        TensorsimError, match=r"SceneConfig.radar: got \{'prf_hz': 3\}, expected a RadarConfig"
    ):
        ts.VideoToDoppler(RectangleDetector(), StandingPose(), radar={"prf_hz": 3})  # type: ignore[arg-type]


def test_weights_scale_the_cross_sections() -> None:
    """The echo's power goes with the body surface of each person, (weight / panel weight)^0.425."""
    config = ts.SimulationConfig().replace(
        scene__radar=ts.RadarConfig.through_wall(), pose__person_weight_kg=(2 * PANEL_WEIGHTS_KG[0], 75.0)
    )
    stage, plain = (
        PoseToDoppler.from_config(config),
        PoseToDoppler.from_config(ts.SimulationConfig.through_wall()),
    )
    joints = torch.rand(1, 3, 10, 14, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor(
        [0, 3.0, 0]
    )
    valid = torch.ones(1, 3, 10, dtype=torch.bool)
    rcs = [s.scene(s.resampler.coefficients(joints, 30.0), valid, 30.0, 0, 4)[1] for s in (stage, plain)]
    ratio = (rcs[0] / rcs[1]).reshape(4, 3, 14)
    torch.testing.assert_close(ratio[:, 0], torch.full_like(ratio[:, 0], 2**0.425), rtol=1e-5, atol=0)
    torch.testing.assert_close(ratio[:, 1:], torch.ones_like(ratio[:, 1:]), rtol=1e-6, atol=0)


def test_bodies_and_small_motions_are_those_of_the_scene() -> None:
    scene = {"scene__radar": ts.RadarConfig.through_wall(), "scene__snr_db": None}
    config = ts.SimulationConfig().replace(
        **scene, scene__body="surface", scene__sway=True, scene__vital_signs=True
    )
    stage = PoseToDoppler.from_config(config)
    assert isinstance(stage.scatterers, ts.motion.BodyScatterers)
    plain = PoseToDoppler.from_config(ts.SimulationConfig().replace(**scene))
    body = torch.rand(1, 1, 1, 14, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor(
        [0.0, 3.0, 0.5]
    )
    still, valid = body.expand(1, 1, 60, 14, 3).contiguous(), torch.ones(1, 1, 60, dtype=torch.bool)
    # A body that stands still is silent without them; pieces of the motion are those of the whole.
    silent, alive = plain(still, valid, 30.0), stage(still, valid, 30.0)
    assert float(silent.doppler_time.max()) < 1e-6 * float(silent.range_time.max())
    assert float(alive.doppler_time.max()) > 1e-4 * float(alive.range_time.max())
    coefficients = stage.resampler.coefficients(still, 30.0)
    whole, part = (stage.scene(coefficients, valid, 30.0, start, 60)[0] for start in (0, 40))
    torch.testing.assert_close(whole[:, 40:], part)
    scripted = torch.jit.script(stage)
    assert_same(scripted(still, valid, 30.0), alive, atol=1e-5)
    for module in (stage, scripted):
        assert_same([module.doppler_time(still, valid, 30.0)], [alive.doppler_time], atol=1e-5)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("people", "0", "people: got '0', expected 'all', 'moving', 'nearest' or a number from 1"),
        ("people", 2, "people: got 2, expected"),
        ("person_height_m", 1.75, "person_height_m: got 1.75, expected a tuple of one number per person"),
        ("initial_distance_m", (4.0, 0.0), r"initial_distance_m\[1\]: got 0.0, expected a positive"),
    ],
)
def test_people_that_cannot_be_are_refused(field: str, value: object, message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        ts.PoseConfig(**{field: value})  # type: ignore[arg-type]
