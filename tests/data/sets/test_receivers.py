"""Receivers and denoisers that are drawn for each sample, and what they do to its outputs."""

from dataclasses import replace

import numpy as np
import torch

from tensorsim.config import ReceiverConfig
from tensorsim.data.sets.outputs import OutputConfig
from tensorsim.data.sets.plan import Plan
from tensorsim.data.sets.recipe import RadarView, SourceConfig
from tensorsim.data.sets.synthesis import synthesize, view_config
from tensorsim.data.sets.variations import VariationConfig, draw
from tensorsim.enhance import map_denoiser
from tests.data.sets.recipes import small_recipe


def test_receivers_and_denoisers_vary() -> None:
    config = VariationConfig(
        phase_noise_dbc_hz=(-100.0, -80.0),
        iq_imbalance_db=(-1.0, 1.0),
        iq_phase_rad=(0.01, 0.02),
        dc_offset_db=(-20.0, 0.0),
        adc_bits=(6, 8),
        adc_headroom_db=(9.0, 12.0),
        real_receiver=0.5,
        denoisers=("none", "perona-malik"),
    )
    recipe = small_recipe(variations=config)
    drawn = [draw(config, k) for k in range(60)]
    assert {v.adc_bits for v in drawn} == {6, 7, 8}
    assert {v.real_receiver for v in drawn} == {True, False}
    assert {v.denoiser for v in drawn} == {"none", "perona-malik"}
    for variation in drawn[:5]:
        found = view_config(recipe, recipe.radars[0], variation)
        receiver = found.scene.receiver
        for name in (
            "phase_noise_dbc_hz",
            "iq_imbalance_db",
            "iq_phase_rad",
            "dc_offset_db",
            "adc_headroom_db",
        ):
            low, high = getattr(config, name)
            assert low <= getattr(receiver, name) == getattr(variation, name) <= high
        assert (receiver.adc_bits, receiver.real) == (variation.adc_bits, variation.real_receiver)
        assert found.processing.denoiser == variation.denoiser
        assert (found.processing.engine, found.processing.near_bins) == ("time", None)
    # What is not drawn stays that of the recipe.
    usual = VariationConfig()
    assert draw(usual, 3).receiver(ReceiverConfig.typical()) == ReceiverConfig.typical()
    assert view_config(recipe, recipe.radars[0], draw(usual, 3)).processing == recipe.processing


def test_the_denoiser_of_a_sample_cleans_its_maps() -> None:
    recipe = small_recipe(outputs=OutputConfig(dtype="float16", rate_hz=None))
    plan = Plan(recipe)
    variation = replace(plan.variation(0, 0), snr_db=-20.0)
    scene = plan.scene(0, "train", variation)
    plain, none, cleaned = (
        synthesize(recipe, scene, replace(variation, denoiser=name))
        .arrays["front.doppler_time"]
        .astype(float)
        for name in (None, "none", "perona-malik")
    )
    assert (plain == none).all()
    denoiser = map_denoiser("perona-malik")
    assert denoiser is not None
    expected = denoiser(torch.from_numpy(10 ** (plain / 20)))
    expected = 20 * (expected / expected.max()).log10().numpy()
    strong = expected > -40
    assert np.abs(cleaned - expected)[strong].max() < 0.1
    assert np.abs(cleaned - plain)[strong].max() > 1.0


def test_an_array_hears_with_its_receiver() -> None:
    outputs = OutputConfig(
        kinds=("range_doppler_angle",), dtype="float16", frames_per_s=4.0, beams=8, cube_size=(48, 32)
    )
    recipe = small_recipe(
        duration_s=0.3,
        sources=(SourceConfig(people=1, classes=("walking",)),),
        radars=(RadarView("array", "ti-awr1843-array"),),
        outputs=outputs,
        variations=VariationConfig(distance_m=(3.5, 3.5), snr_db=(40.0, 40.0)),
    )
    plan = Plan(recipe)
    variation = plan.variation(0, 0)
    scene = plan.scene(0, "train", variation)
    floors = [
        np.median(synthesize(recipe, scene, drawn).arrays["array.range_doppler_angle"].astype(float))
        for drawn in (variation, replace(variation, adc_bits=12), replace(variation, adc_bits=2))
    ]
    assert abs(floors[1] - floors[0]) < 1.0  # dB
    assert floors[2] > floors[0] + 3.0
