"""Samples in one pass of the radar chain are those made one by one."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

import tensorsim as ts
from tensorsim.data.sets.batches import _config_of_all, _profiles, synthesize_batch
from tensorsim.data.sets.outputs import OutputConfig
from tensorsim.data.sets.pair_outputs import scatterers
from tensorsim.data.sets.plan import Plan
from tensorsim.data.sets.recipe import DatasetRecipe, RadarView, SourceConfig
from tensorsim.data.sets.synthesis import synthesize, view_of
from tensorsim.data.sets.variations import VariationConfig
from tensorsim.errors import TensorsimError
from tensorsim.pipeline.maps import PoseToDoppler
from tests.data.sets.recipes import small_recipe

CPU = torch.device("cpu")
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


def samples(recipe: DatasetRecipe) -> list[Any]:
    plan = Plan(recipe)
    drawn = []
    for number in range(len(plan)):
        part, clip, count = plan.clip_of_sample(number)
        variation = plan.variation(clip, count)
        drawn.append((plan.scene(clip, part, variation), variation))
    return drawn


@pytest.mark.parametrize(
    "changes",
    [
        {"outputs": OutputConfig(kinds=("doppler_time", "picture", "joints"), picture_size=32)},
        {"outputs": OutputConfig(kinds=("range_time", "range_time_mti", "ridges"))},
        {
            "variations": VariationConfig(
                people=(1, 2), bodies=("joints", "limbs"), sway=0.5, snr_db=(0.0, 30.0)
            )
        },
        {"variations": VariationConfig(denoisers=("none", "perona-malik"), adc_bits=(3, 4))},
        {"variations": VariationConfig(wall_thickness_m=(0.1, 0.3), snr_db=None), "gate_people": False},
    ],
    ids=["gated", "ranges", "groups", "receivers", "walls"],
)
def test_a_batch_is_its_samples(changes: dict[str, Any]) -> None:
    views = (RadarView("front", "through-wall"), RadarView("left", "through-wall", -3.0, 3.5, -90.0))
    recipe = small_recipe(radars=views, **changes)
    drawn = samples(recipe)
    for device in DEVICES:
        for arrays, (scene, variation) in zip(
            synthesize_batch(recipe, drawn, torch.device(device)), drawn, strict=True
        ):
            expected = synthesize(recipe, scene, variation).arrays
            assert arrays.keys() == expected.keys()
            for name, array in expected.items():
                # Sums in another order may round a grey level up in place of down.
                apart = np.abs(arrays[name].astype(np.float64) - array)
                assert np.nanmax(apart) <= (0.0 if name.endswith("joints") else 1.0), name
                assert np.nanmean(apart > 0) < 1e-3, name


@pytest.mark.parametrize("preset", ["through-wall", "free-space"])
def test_profiles_of_a_batch_are_those_of_its_samples(preset: str) -> None:
    recipe = small_recipe(seed=1, radars=(RadarView("front", preset),))  # nobody's feet alias
    views = [view_of(recipe, recipe.radars[0], *sample) for sample in samples(recipe)]
    assert len({view.config.processing.range_gate_m for view in views}) == 4

    def seen(stage: PoseToDoppler, of: list[Any]) -> tuple[torch.Tensor, torch.Tensor]:
        joints, valid = (torch.stack([getattr(v.scene, name) for v in of]) for name in ("joints", "valid"))
        return scatterers(stage, joints, valid, of[0].scene.fps)

    stage = PoseToDoppler.from_config(_config_of_all(views))
    together = _profiles(stage.simulator, *seen(stage, views), views)
    widths = set()
    for profiles, view in zip(together, views, strict=True):
        stage = PoseToDoppler.from_config(view.config)
        torch.manual_seed(view.noise_seed)
        alone = stage.simulator.profiles(*seen(stage, [view]))[0]
        width = alone.shape[1]
        widths.add(width)
        assert (profiles[:, :width] - alone).abs().max() <= 1e-5 * alone.abs().max()
        assert not profiles[:, width:].any()
    assert max(widths) == together.shape[2] > min(widths)


def test_simulated_maps_are_the_same_in_batches() -> None:
    recipe = small_recipe(sources=(SourceConfig(classes=("walking", "sitting down"), people=4),))
    one, three = (list(ts.data.SimulatedMaps(recipe, None, rounds=2, batch=n)) for n in (1, 3))
    assert [sample["id"] for sample in one] == [sample["id"] for sample in three]
    assert len(one) == 16
    for a, b in zip(one, three, strict=True):
        assert a["label"] == b["label"]
        assert (a["map"] - b["map"]).abs().max() <= 1 / 255 + 1e-6
        assert (a["map"] != b["map"]).float().mean() < 1e-3


def test_one_that_fails_does_not_take_the_others_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    maps = ts.data.SimulatedMaps(small_recipe(), None, rounds=1, batch=4)
    whole = {sample["id"]: sample["map"] for sample in maps}
    usual, calls = maps.plan.scene, []

    def scene(*arguments: Any) -> Any:
        calls.append(arguments)
        found = usual(*arguments)
        if len(calls) == 1:
            raise TensorsimError("nobody in it")
        if len(calls) == 3:  # 60 m/s
            away = torch.arange(found.joints.shape[1]).float()
            return found._replace(joints=found.joints + away[:, None, None] * torch.tensor([0.0, 1.0, 0.0]))
        return found

    monkeypatch.setattr(maps.plan, "scene", scene)
    left = {sample["id"]: sample["map"] for sample in maps}
    assert list(left) == ["00000001-0", "00000003-0"]
    for name, map_ in left.items():
        assert (map_ - whole[name]).abs().max() <= 1 / 255 + 1e-6


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"batch": 0}, "SimulatedMaps.batch: got 0, expected at least 1"),
        ({"device": "quantum"}, "'quantum' is not usable here"),
    ],
)
def test_settings_that_make_no_sense(options: dict[str, Any], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        ts.data.SimulatedMaps(small_recipe(), **options)


def test_signals_come_from_the_receiver_as_well() -> None:
    kinds = ("if_signal", "range_time", "doppler_time")
    recipe = small_recipe(outputs=OutputConfig(kinds=kinds, dtype="float16", rate_hz=None))
    scene, drawn = samples(recipe)[0]
    ideal = synthesize(recipe, scene, replace(drawn, snr_db=60.0)).arrays
    made = synthesize(recipe, scene, replace(drawn, snr_db=60.0, adc_bits=2, adc_headroom_db=6.0)).arrays
    levels = np.unique(made["front.if_signal"])
    assert len(levels) == 4  # of two bits
    assert len(np.unique(ideal["front.if_signal"])) > 1000
    assert (made["front.doppler_time"] != ideal["front.doppler_time"]).mean() > 0.5
    (batched,) = synthesize_batch(recipe, [(scene, replace(drawn, snr_db=60.0, adc_bits=2))], CPU)
    alone = synthesize(recipe, scene, replace(drawn, snr_db=60.0, adc_bits=2)).arrays
    assert all((batched[name] == alone[name]).all() for name in alone)
