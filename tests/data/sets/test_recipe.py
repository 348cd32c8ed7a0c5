"""Recipes: what a file may contain, what follows from it, and what is refused."""

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tensorsim import cli
from tensorsim.body.skeleton import mid_hips
from tensorsim.config import SceneConfig, SimulationConfig, Vector, WallConfig
from tensorsim.config.processing import Mti
from tensorsim.data.sets.array_outputs import array_outputs
from tensorsim.data.sets.batches import synthesize_batch
from tensorsim.data.sets.build import build_dataset
from tensorsim.data.sets.card import card
from tensorsim.data.sets.outputs import OutputConfig, in_decibels, resized, stored_map, stored_signal
from tensorsim.data.sets.people import finite_everywhere
from tensorsim.data.sets.plan import Plan, shared_out
from tensorsim.data.sets.recipe import DatasetRecipe, RadarView, SourceConfig, SplitConfig, StorageConfig
from tensorsim.data.sets.scene import Scene, kept_inside, part_of, seen_from, varied
from tensorsim.data.sets.synthesis import people_gate, synthesize, view_config
from tensorsim.data.sets.variations import Variation, VariationConfig, draw
from tensorsim.data.skeletons import Motion
from tensorsim.errors import TensorsimError, TensorsimWarning
from tensorsim.motion import ActivityGenerator
from tensorsim.pipeline import PoseToDoppler
from tests.data.sets.recipes import small_recipe


@pytest.mark.parametrize(
    ("option", "samples", "classes", "radars"), [("", 8, 2, 1), ("--large", 1200, 12, 3)]
)
def test_the_examples_are_recipes(
    option: str, samples: int, classes: int, radars: int, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    cli.main(["dataset", "example", *filter(None, [option])])
    (tmp_path / "r.yaml").write_text(capsys.readouterr().out)
    recipe = DatasetRecipe.from_yaml(tmp_path / "r.yaml")
    plan = Plan(recipe)
    assert (len(plan), len(plan.labels), len(recipe.radars)) == (samples, classes, radars)
    assert recipe.storage.format == "webdataset"


def test_yaml_and_back(tmp_path: Path) -> None:
    recipe = small_recipe(variations=VariationConfig(snr_db=None, people=(1, 3), bodies=("joints", "limbs")))
    recipe.to_yaml(tmp_path / "r.yaml")
    assert DatasetRecipe.from_yaml(tmp_path / "r.yaml") == recipe


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sorces: []", "got the key 'sorces'.*perhaps 'sources'"),
        ("sources: [{kind: generated}]", "SourceConfig.people: got none"),
        (
            "sources: [{kind: rendered, people: 2, path: a}]",
            "SourceConfig.path: got one for the kind 'rendered'",
        ),
        ("sources: [{kind: films, path: a, people: 3}]", "SourceConfig.people: got one for the kind 'films'"),
        ("sources: [{people: 1, classes: [flying]}]", "activity: got 'flying'"),
        (
            "sources: [{people: 1, classes: [walking, Walking]}]",
            r"got \['S8 Walking', 'S8 Walking'\], expected each class once",
        ),
        ("radars: [{preset: nothing}]", "got 'nothing', which is not a file"),
        ("radars: [{}, {}]", "got the names"),
        ("radars: [{name: front}, {name: Front}]", "expected ones that differ in more than capitals"),
        ("{radars: [{name: é}, {name: è}], storage: {format: mat}}", "English letters"),
        (
            f"{{radars: [{{name: {31 * 'a'}_1}}, {{name: {31 * 'a'}_2}}], storage: {{format: mat}}}}",
            "expected ones that differ in the first 31 characters",
        ),
        ("radars: [{name: a/b}]", "expected letters, digits"),
        ("radars: [{preset: ti-awr1843-array}]", "need one antenna pair"),
        ("outputs: {kinds: [point_cloud]}", "is no array"),
        ("outputs: {kinds: [doppler]}", "OutputConfig.kinds: got"),
        ("outputs: {kinds: [point_cloud, ridges]}", "outputs of an array"),
        ("outputs: {size: [3]}", "OutputConfig.size"),
        ("outputs: {size: [64, 64], rate_hz: 20.0}", "OutputConfig.rate_hz: got 20.0 together with a size"),
        ("sources: [{kind: keypoints, path: a}]", "SourceConfig.fps: got none for the kind 'keypoints'"),
        ("variations: {spacing_m: -1}", "VariationConfig.spacing_m: got -1"),
        ("split: {shares: [1.5, -0.5, 0.0]}", "SplitConfig.shares: got"),
        ("storage: {format: png}", "for the format png, expected picture"),
        ("storage: {shard_samples: 0}", "shard_samples: got 0"),
        ("split: {shares: [0.5, 0.4]}", "expected three numbers"),
        ("variations: {distance_m: [5, 2]}", "VariationConfig.distance_m: got"),
        ("variations: {mirror: 2}", "a probability"),
        ("variations: {bodies: [stick]}", "VariationConfig.bodies"),
        ("variations: {adc_bits: [4, 30]}", "VariationConfig.adc_bits: got"),
        ("variations: {real_receiver: -1}", "a probability"),
        ("variations: {denoisers: [perona]}", "weights of DnCNN: got 'perona'"),
        ("variations: {denoisers: [a/b.safetensors]}", "got 'a/b.safetensors', which is not a file"),
        ("processing: {denoiser: perona}", "weights of DnCNN: got 'perona'"),
        ("scene: {wall: {}}", "got a radar or a wall, expected them in radars"),
        ("scene: {sway: true}", "got sway, expected it in variations"),
        (
            "{radars: [{preset: ti-awr1843-array}], outputs: {kinds: [point_cloud]}, variations: {denoisers: [dncnn]}}",
            "got a denoiser of maps for point_cloud",
        ),
        ("seed: -1", "DatasetRecipe.seed"),
        ("duration_s: 0.001", "at least two moments"),
    ],
)
def test_what_is_refused_says_where(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "r.yaml").write_text(text)
    with pytest.raises(TensorsimError, match=message) as refused:
        DatasetRecipe.from_yaml(tmp_path / "r.yaml")
    assert "\n" not in str(refused.value)
    assert str(tmp_path / "r.yaml") in str(refused.value)


def test_nan_is_refused() -> None:
    with pytest.raises(TensorsimError, match=r"SplitConfig.shares: got \[nan, 0.5, 0.5\]"):
        SplitConfig(shares=(float("nan"), 0.5, 0.5))
    with pytest.raises(TensorsimError, match=r"VariationConfig.spacing_m: got nan"):
        VariationConfig(spacing_m=float("nan"))


def test_draws_follow_from_the_seed_and_not_from_other_ranges() -> None:
    config = VariationConfig(people=(1, 3))
    one = draw(config, 7)
    assert one == draw(config, 7)
    assert one != draw(config, 8)
    other = draw(replace(config, height_m=(1.0, 1.1)), 7)
    assert replace(other, height_m=one.height_m) == one
    assert Variation.of_row(one.row() | {"more": 1}) == one
    drawn = [draw(config, k) for k in range(400)]
    assert {len(list(filter(None, v.companions.split(",")))) for v in drawn} == {0, 1, 2}
    assert 0.4 < np.mean([v.mirrored for v in drawn]) < 0.6
    heights = [v.height_m for v in drawn if v.height_m is not None]
    assert min(heights) >= 1.55
    assert max(heights) <= 1.9
    assert max(heights) - min(heights) > 0.3


def test_shares_of_groups() -> None:
    part = shared_out([str(k) for k in range(1000)], (0.8, 0.1, 0.1), 0)
    assert np.bincount(part).tolist() == [800, 100, 100]
    assert np.bincount(shared_out(list("abcd"), (0.8, 0.1, 0.1), 0)).tolist() == [2, 1, 1]
    assert shared_out(["a"], (0.5, 0.5, 0.0), 0).tolist() == [0]
    named = dict(zip("abcdef", shared_out(list("abcdef"), (0.5, 0.5, 0.0), 3).tolist(), strict=True))
    other = dict(zip("fedcba", shared_out(list("fedcba"), (0.5, 0.5, 0.0), 3).tolist(), strict=True))
    assert named == other


def test_nobody_is_in_two_parts_not_even_as_a_companion() -> None:
    recipe = small_recipe(
        sources=(SourceConfig(classes=("walking",), people=12), SourceConfig(classes=("kicking",), people=3)),
        variations=VariationConfig(count=3, people=(2, 3)),
    )
    plan = Plan(recipe)
    assert len(plan) == 45
    part_of_person: dict[str, set[str]] = {}
    seen = set()
    for number in range(len(plan)):
        part, clip, count = plan.clip_of_sample(number)
        seen.add((clip, count))
        person = plan.clip(clip)[1].person
        part_of_person.setdefault(person, set()).add(part)
        for word in plan.variation(clip, count).companions.split(","):
            part_of_person.setdefault(plan._companion(person, part, int(word))[1].person, set()).add(part)
    assert len(seen) == 45
    assert all(len(parts) == 1 for parts in part_of_person.values())
    assert [shard.stop - shard.first for shard in plan.shards][:3] == [2, 2, 2]


def test_people_of_a_scene_walk_beside_one_another() -> None:
    recipe = small_recipe(
        duration_s=3.0,
        sources=(SourceConfig(classes=("walking",), people=6),),
        split=SplitConfig(shares=(1.0, 0.0, 0.0)),
        variations=VariationConfig(people=(3, 3)),
    )
    plan = Plan(recipe)
    for clip in range(6):
        scene = plan.scene(clip, "train", plan.variation(clip, 0))
        hips = mid_hips(scene.joints)[..., :2]
        start = hips[:, 0] - hips[:1, 0]
        assert torch.allclose(start, torch.tensor([[0.0, 0.0], [0.8, 0.0], [-0.8, 0.0]]), atol=1e-5)
        apart = [(hips[i] - hips[j]).norm(dim=-1).min() for i, j in ((0, 1), (0, 2), (1, 2))]
        assert min(apart) > 0.5  # they passed through one another


@pytest.mark.parametrize("side", [-1.2, 0.4])
def test_generated_people_are_beside_the_axis_as_the_manifest_says(side: float) -> None:
    plan = Plan(small_recipe(variations=VariationConfig(side_m=(side, side))))
    for clip in range(4):
        drawn = plan.variation(clip, 0)
        x = mid_hips(plan.scene(clip, "train", drawn).joints)[..., 0]
        assert drawn.side_m == side
        assert float(x.min() + x.max()) / 2 == pytest.approx(side, abs=0.1)


def test_maps_in_bytes_and_half_floats() -> None:
    magnitude = torch.rand(20, 30) + 1e-3
    stored = stored_map(magnitude, OutputConfig(rate_hz=None), 1.0)
    below = 20 * np.log10(magnitude.double().numpy() / float(magnitude.max()))
    assert np.abs(stored.array / 255.0 * 60 - 60 - below.clip(-60, 0)).max() <= 60 / 255 / 2 + 1e-6
    assert stored.peak == pytest.approx(float(magnitude.max()))
    half = stored_map(magnitude, OutputConfig(dtype="float16", rate_hz=None), 1.0).array
    assert half.dtype == np.float16
    assert np.abs(half.astype(np.float64) - below).max() < 0.05
    assert not in_decibels(torch.zeros(2, 2), OutputConfig()).array.any()


def test_cells_average_power() -> None:
    power = torch.rand(12, 30, dtype=torch.float64)
    assert torch.allclose(resized(power, 6, 10), power.reshape(6, 2, 10, 3).mean((1, 3)))
    magnitude = power.sqrt()
    by_rate = stored_map(magnitude, OutputConfig(dtype="float16", rate_hz=10.0), 1.0).array
    by_size = stored_map(magnitude, OutputConfig(dtype="float16", size=(12, 10)), 1.0).array
    assert (by_rate == by_size).all()


def test_signals_keep_their_phase() -> None:
    signal = torch.randn(4, 5, dtype=torch.complex64)
    stored = stored_signal(signal)
    back = torch.view_as_complex(torch.from_numpy(stored.array.astype(np.float32))) * stored.peak
    assert float((back - signal).abs().max()) < 2e-3 * float(signal.abs().max())


def test_a_radar_at_another_place_sees_what_one_at_the_origin_sees_of_moved_people() -> None:
    joints = torch.randn(2, 5, 14, 3, dtype=torch.float64) + torch.tensor([0.0, 4.0, 1.0])
    # From the left, looking to the right: what is far in x is far away, what is near in y is to the right.
    seen = seen_from(joints, -3.0, 4.0, -90.0)
    expected = torch.stack([4.0 - joints[..., 1], joints[..., 0] + 3.0, joints[..., 2]], dim=-1)
    assert torch.allclose(seen, expected)


def walk(seconds: float = 2.0) -> Motion:
    motion = ActivityGenerator().generate("walking", seed=3, duration_s=seconds, rate_hz=30.0)
    return Motion(motion.joints.float(), motion.valid, 30.0)


def test_variations_of_recorded_motion() -> None:
    from tensorsim.body.skeleton import body_height

    plain = draw(VariationConfig(heading_deg=(0.0, 0.0), mirror=0.0, side_m=(0.0, 0.0)), 1)
    motion = walk()
    changed = varied(motion, replace(plain, height_m=1.5, distance_m=3.0, speed=2.0))
    assert float(body_height(changed.joints[0]).median()) == pytest.approx(1.5, abs=1e-3)
    assert changed.joints[0, 0, (8, 11), 1].mean() == pytest.approx(3.0, abs=1e-6)
    assert changed.fps == 60.0
    turned = varied(motion, replace(plain, height_m=None, distance_m=3.0, heading_deg=90.0))
    still = varied(motion, replace(plain, height_m=None, distance_m=3.0))
    way, usual = (m.joints[0, -1, 8, :2] - m.joints[0, 0, 8, :2] for m in (turned, still))
    assert torch.allclose(way, torch.stack([-usual[1], usual[0]]), atol=1e-6)
    mirrored = varied(motion, replace(plain, height_m=None, distance_m=3.0, mirrored=True))
    assert torch.allclose(
        mirrored.joints[0, 0, 4], still.joints[0, 0, 7] * torch.tensor([-1.0, 1, 1]), atol=1e-6
    )


def test_a_short_motion_ends_with_nobody_and_a_long_one_is_cut() -> None:
    short = part_of(walk(0.5), 1.0, 60.0, 0.3)
    assert short.joints.shape == (1, 60, 14, 3)
    assert short.valid[0].tolist() == [True] * 30 + [False] * 30 or int(short.valid.sum()) in (29, 30, 31)
    first, last = part_of(walk(), 1.0, 60.0, 0.0), part_of(walk(), 1.0, 60.0, 1.0)
    assert bool(first.valid.all())
    assert not torch.allclose(first.joints, last.joints)


def test_whoever_leaves_or_comes_keeps_the_speed_until_then() -> None:
    """Absent frames, at the origin in placed motion, must not bend the curve next to them."""
    recipe = small_recipe(outputs=OutputConfig(dtype="float16", rate_hz=None))
    drawn = replace(draw(recipe.variations, 1), snr_db=None, speed=1.0, distance_m=3.0, height_m=None)
    recipe = replace(recipe, scene=SceneConfig(snr_db=None))
    motion = walk()
    valid = motion.valid.clone()
    valid[:, :12], valid[:, 48:] = False, False
    absent = Motion(finite_everywhere(motion._replace(valid=valid), "walk").joints, valid, 30.0)
    whole, seen = (part_of(varied(one, drawn), 2.0, 60.0, 0.0) for one in (motion, absent))
    whole = whole._replace(joints=whole.joints + (seen.joints - whole.joints)[:, 60:61, :1], valid=seen.valid)
    assert int(seen.valid.sum()) == pytest.approx(72, abs=2)
    assert (seen.joints - whole.joints)[seen.valid].abs().max() < 0.02
    maps = [synthesize(recipe, scene, drawn).arrays["front.doppler_time"] for scene in (seen, whole)]
    power, expected = (10 ** (found.astype(float) / 10) for found in maps)
    assert np.abs(power - expected).sum() / expected.sum() < 0.02
    assert (power.sum(0) < 1.2 * expected.sum(0) + 1e-3).all()


def test_people_are_kept_inside_by_the_least_move() -> None:
    scene = part_of(walk(), 1.0, 60.0, 0.0)
    near = scene._replace(joints=scene.joints - torch.tensor([0.0, 5.0, 0.0]))
    kept = kept_inside(near, VariationConfig(keep_m=(1.5, 7.0)))
    y = kept.joints[..., (8, 11), 1].mean(-1)
    assert float(y.min()) == pytest.approx(1.5, abs=1e-4)
    assert kept_inside(kept, VariationConfig(keep_m=(1.5, 7.0))).joints.equal(kept.joints)


def test_a_sample_is_the_map_of_the_stages() -> None:
    recipe = small_recipe(
        seed=1,  # nobody's feet alias
        outputs=OutputConfig(kinds=("doppler_time", "joints"), dtype="float16", rate_hz=None),
    )
    recipe = replace(
        recipe, variations=replace(recipe.variations, snr_db=None), scene=replace(recipe.scene, snr_db=None)
    )
    plan = Plan(recipe)
    variation = plan.variation(0, 0)
    scene = plan.scene(0, "train", variation)
    made = synthesize(recipe, scene, variation)
    stage = PoseToDoppler.from_config(view_config(recipe, recipe.radars[0], variation))
    maps = stage(scene.joints[None], scene.valid[None], scene.fps)
    expected = 20 * (maps.doppler_time[0] / maps.doppler_time.max()).clamp_min(1e-10).log10()
    assert np.abs(made.arrays["front.doppler_time"] - expected.detach().numpy()).max() < 0.2
    assert (made.arrays["front.joints"] == scene.joints.numpy()).all()


def test_signals_and_maps_of_a_sample_are_of_one_recording() -> None:
    kinds = ("if_signal", "profiles", "range_time", "range_time_mti", "doppler_time", "ridges", "picture")
    recipe = small_recipe(outputs=OutputConfig(kinds=kinds, dtype="float16", rate_hz=None))
    plan = Plan(recipe)
    variation = plan.variation(0, 0)
    scene = plan.scene(0, "train", variation)
    made = synthesize(recipe, scene, variation).arrays
    profiles = made["front.profiles"].astype(np.float64) @ np.array([1, 1j])
    signal = made["front.if_signal"].astype(np.float64) @ np.array([1, 1j])
    pulses, bins = profiles.shape
    assert signal.shape == (128, 400)
    assert pulses == 128
    range_time = made["front.range_time"].astype(np.float64)
    assert range_time.shape == (bins, pulses)
    below = 20 * np.log10(np.abs(profiles).T.clip(1e-9))
    strong = below > -30
    assert np.abs((range_time - below)[strong]).max() < 0.2
    spectrum = np.abs(np.fft.fft(signal * np.hamming(400))).max(1)
    assert np.corrcoef(spectrum, np.abs(profiles).max(1))[0, 1] > 0.999
    assert made["front.picture"].dtype == np.uint8
    other = synthesize(replace(recipe, outputs=OutputConfig(dtype="float16", rate_hz=None)), scene, variation)
    both = np.stack([made["front.doppler_time"], other.arrays["front.doppler_time"]]).astype(np.float64)
    assert np.abs(np.diff(both, axis=0)[0][(both > -15).all(0)]).mean() < 0.5


def test_the_gate_holds_everything_that_people_reflect() -> None:
    recipe = small_recipe(outputs=OutputConfig(dtype="float16", rate_hz=None))
    recipe = replace(
        recipe, variations=replace(recipe.variations, snr_db=None), scene=SceneConfig(snr_db=None)
    )
    plan = Plan(recipe)
    for clip in range(4):
        variation = plan.variation(clip, 0)
        scene = plan.scene(clip, "train", variation)
        gated, whole = (
            synthesize(replace(recipe, gate_people=gate), scene, variation) for gate in (True, False)
        )
        near, far = people_gate(view_config(recipe, recipe.radars[0], variation), scene)
        assert 0.5 <= near < far < 10.0
        power, expected = (10 ** (m.arrays["front.doppler_time"].astype(float) / 10) for m in (gated, whole))
        assert np.abs(power - expected).sum() / expected.sum() < 0.01


def test_walls_snr_and_bodies_vary() -> None:
    recipe = small_recipe()
    variation = replace(
        draw(recipe.variations, 0),
        wall_permittivity=4.0,
        wall_thickness_m=0.1,
        body="limbs",
        snr_db=12.0,
        sway=True,
    )
    scene = view_config(recipe, recipe.radars[0], variation).scene
    assert scene.wall == WallConfig((-0.1, 0.05, 1.5), (5.0, 0.1, 2.5), 4.0)
    assert (scene.body, scene.snr_db, scene.sway) == ("limbs", 12.0, True)


def test_one_noise_for_each_radar() -> None:
    recipe = small_recipe(radars=(RadarView("a", "through-wall"), RadarView("b", "through-wall")))
    plan = Plan(recipe)
    variation = replace(plan.variation(0, 0), snr_db=0.0)
    scene = plan.scene(0, "train", variation)
    made = synthesize(recipe, Scene(*scene), variation)
    assert (made.arrays["a.doppler_time"] != made.arrays["b.doppler_time"]).any()


@pytest.mark.parametrize(
    ("receivers", "message"),
    [
        (((0.01, 0.0, 1.0),), None),
        (((0.01, 0.0, 1.0), (0.0, 0.0, 1.0)), "expected an evenly spaced row along x, from left to right"),
    ],
)
def test_points_of_one_antenna_and_of_a_row_from_right_to_left(
    receivers: tuple[Vector, ...], message: str | None
) -> None:
    config = SimulationConfig().replace(scene__radar__rx_m=receivers)
    y = 3.0 - 0.1 * torch.arange(8).reshape(1, -1, 1)
    scene = Scene(torch.stack([0 * y, y, 1 + 0 * y], -1).expand(1, 8, 14, 3), torch.ones(1, 8).bool(), 30.0)
    outputs = OutputConfig(kinds=("point_cloud",), frames_per_s=10.0, points=4)
    if message is not None:
        with pytest.raises(TensorsimError, match=message):
            array_outputs(config, outputs, scene)
        return
    points = array_outputs(config, outputs, scene)["point_cloud"].array.reshape(-1, 4)
    found = points[~np.isnan(points[:, 0])]
    assert abs(found[:, 1].max() - 3.0) < 0.3
    assert (found[:, 2] == 0).all()


@pytest.mark.parametrize("mti", ["two-pulse", "high-pass"])
def test_an_array_tells_range_direction_and_speed(mti: Mti) -> None:
    outputs = OutputConfig(
        kinds=("range_doppler_angle", "point_cloud"), frames_per_s=4.0, beams=16, cube_size=(48, 32)
    )
    recipe = small_recipe(
        duration_s=0.3,
        sources=(SourceConfig(people=1, classes=("walking",)),),
        radars=(RadarView("array", "ti-awr1843-array"),),
        processing=replace(DatasetRecipe().processing, mti=mti),
        outputs=outputs,
        variations=VariationConfig(
            heading_deg=(0.0, 0.0), side_m=(0.0, 0.0), distance_m=(3.5, 3.5), snr_db=(20.0, 20.0)
        ),
    )
    plan = Plan(recipe)
    variation = plan.variation(0, 0)
    scene = plan.scene(0, "train", variation)
    hips = scene.joints[0, :6, (8, 11)].mean((0, 1))
    moved = scene._replace(joints=scene.joints + torch.tensor([1.8 - float(hips[0]), 0.0, 0.0]))
    distance = float(np.hypot(1.8, float(hips[1])))
    made = synthesize(recipe, moved, variation).arrays
    points = made["array.point_cloud"].reshape(-1, 4)
    there = points[~np.isnan(points[:, 0])]
    assert len(there) >= 3
    range_m, speed, sine, _ = np.median(there, axis=0)
    assert abs(range_m - distance) < 0.3
    assert abs(sine - 1.8 / distance) < 0.08
    assert 0.2 < speed < 2.0  # it approaches
    cube = made["array.range_doppler_angle"]
    assert cube.shape == (1, 48, 32, 16)
    _, _, doppler, beam = np.unravel_index(cube.argmax(), cube.shape)
    assert doppler >= 16
    assert abs((beam + 0.5) / 8 - 1 - 1.8 / distance) < 0.15


def test_joints_are_of_any_radar() -> None:
    """Also of an array, alone and beside what it gives."""
    recipe = small_recipe(
        radars=(RadarView("array", "ti-awr1843-array"),), outputs=OutputConfig(kinds=("joints",))
    )
    plan = Plan(recipe)
    variation = plan.variation(0, 0)
    scene = plan.scene(0, "train", variation)
    made = synthesize(recipe, scene, variation).arrays
    (batch,) = synthesize_batch(recipe, [(scene, variation)], torch.device("cpu"))
    assert set(made) == set(batch) == {"array.joints"}
    assert (made["array.joints"] == scene.joints.numpy()).all()
    assert (batch["array.joints"] == made["array.joints"]).all()


def test_a_size_takes_the_place_of_the_usual_rate() -> None:
    for rate_hz in (None, 32.0):  # the examples name the usual one
        assert OutputConfig(size=(64, 64), rate_hz=rate_hz).rate_hz is None
    assert replace(OutputConfig(), size=(64, 64)).rate_hz is None


def test_walls_that_do_not_attenuate() -> None:
    document = small_recipe().to_document() | {"scene": {"wall_attenuation": False}}
    recipe = DatasetRecipe.from_document(document)
    wall, free = recipe.simulation(RadarView("wall", "through-wall")), recipe.simulation(RadarView("free"))
    assert (wall.scene.wall_attenuation, wall.scene.wall is None) == (False, False)
    assert free.scene.wall is None
    alone = small_recipe(scene=SceneConfig(wall_attenuation=False), radars=(RadarView("free"),))
    assert alone.without_effect == ["scene.wall_attenuation"]


def test_classes_whose_pictures_have_one_folder_are_refused(tmp_path: Path) -> None:
    for name in ("C", "C++"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.npz").touch()
    recipe = small_recipe(sources=(SourceConfig("motion", str(tmp_path)),))
    assert Plan(recipe).labels == ("C", "C++")
    pictures = replace(recipe, storage=StorageConfig("png"), outputs=OutputConfig(kinds=("picture",)))
    with pytest.raises(TensorsimError, match=r"the classes 'C' and 'C\+\+', which would share a folder"):
        Plan(pictures)


def test_files_of_one_name_in_two_sources_are_different_people_and_samples(tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / name / "walk").mkdir(parents=True)
        np.savez(tmp_path / name / "walk" / "a.npz", joints_m=walk().joints.numpy(), fps=30.0)
    sources = tuple(SourceConfig("motion", str(tmp_path / name)) for name in ("one", "two"))
    plan = Plan(small_recipe(sources=sources))
    first, second = (plan.clip(k)[1] for k in (0, 1))
    assert first.name == second.name == "walk/a.npz"
    assert (first.person, second.person) == ("motion0/walk/a.npz", "motion1/walk/a.npz")
    assert plan.variation(0, 0).seed != plan.variation(1, 0).seed
    assert [len(clips) for clips in plan.parts.values()] == [1, 1, 0]


@pytest.mark.parametrize(
    ("people", "by", "expected"),
    [
        ("Ann,Ben", "person", "Split by person: nobody is in two parts."),
        ("Ann,", "person", "Not every clip of table has a name; without one each file counts as another"),
        ("Ann,", "source", "Split by source: no film, file or generated person is in two parts."),
        ("Ann,", "table", "Split by table: parts are those of the sources."),
    ],
)
def test_the_card_says_only_of_named_people_that_nobody_is_in_two_parts(
    people: str, by: Any, expected: str, tmp_path: Path
) -> None:
    first, second = people.split(",")
    table = f"path,label,person,split\na.npz,walk,{first},train\nb.npz,walk,{second},test\n"
    (tmp_path / "t.csv").write_text(table)
    sources = (SourceConfig(people=1), SourceConfig("table", str(tmp_path / "t.csv")))
    text = card(Plan(small_recipe(sources=sources, split=SplitConfig(by))), Counter(), 0, 0)
    assert expected in text
    assert ("nobody is in two parts." in text) == (people == "Ann,Ben")


def test_settings_of_walls_without_any_wall_are_named(tmp_path: Path) -> None:
    changes: dict[str, Any] = {
        "scene": SceneConfig(wall_echo=True),
        "variations": VariationConfig(wall_permittivity=(3.0, 6.0)),
    }
    free, wall = RadarView("free"), RadarView("wall", "through-wall")
    assert small_recipe(**changes, radars=(free, wall)).without_effect == []
    assert small_recipe(radars=(free,)).without_effect == []
    recipe = small_recipe(**changes, radars=(free,), sources=(SourceConfig("motion", str(tmp_path)),))
    with (
        pytest.warns(
            TensorsimWarning, match="scene.wall_echo, variations.wall_permittivity, which have no effect"
        ),
        pytest.raises(TensorsimError, match="got no clips"),
    ):
        build_dataset(recipe, tmp_path / "set", quiet=True)
