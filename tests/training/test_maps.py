import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

import tensorsim as ts
from tensorsim.errors import TensorsimError
from tensorsim.evaluation.clips import ActivityClip
from tensorsim.evaluation.films import true_keypoints
from tensorsim.motion.activities import ActivityGenerator
from tensorsim.radar.presets import PRESETS
from tensorsim.radar.synthesis.echo import EchoSynthesizer
from tensorsim.recognition.map_image import MapToImage, scaled
from tensorsim.training.film_errors import FilmErrors, Watched
from tensorsim.training.maps import (
    MapMaker,
    MapSettings,
    MapStore,
    MotionMaker,
    build_maps,
    from_bytes,
    one_person_many_ways,
    to_bytes,
)

SMALL = MapSettings(size=28, duration_s=1.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("maps")
    build_maps(folder, 1, ("through-wall",), SMALL, quiet=True)
    return folder


def test_bytes_keep_a_fifth_of_a_decibel() -> None:
    power = 10 ** torch.linspace(-10, 0, 401)
    error_db = 10 * (from_bytes(to_bytes(power)) / power).log10()
    assert float(error_db.abs().max()) <= 0.2 + 1e-4
    assert from_bytes(to_bytes(torch.zeros(3))).tolist() == [0, 0, 0]


def test_the_spectra_of_echo_and_noise_mix(tmp_path: Path) -> None:
    """``A + 2 s B + s^2 C`` of one pixel: |S + s N|^2 of numbers that point alike, apart, or at right angles."""
    (tmp_path / "settings.json").write_text(json.dumps(asdict(replace(SMALL, size=1))))
    for person, cross in enumerate((127, -127, 0)):
        content = {
            "signal": torch.full((1, 1, 1), 255, dtype=torch.uint8),
            "cross": torch.full((1, 1, 1), cross, dtype=torch.int8),
            "noise": torch.full((1, 1), 255, dtype=torch.uint8),
            "gain_db": torch.zeros(1),
        }
        save_file(content, tmp_path / f"free-space-{person:05d}.safetensors")
    store = MapStore(tmp_path)
    found = [float(store.power("free-space", person, 0, 20.0)) for person in range(3)]
    assert found == pytest.approx([1.1**2, 0.9**2, 1 + 0.1**2])


def difference_db(folder: Path, scene: str, activity: int, snr_db: float) -> Tensor:
    """The stored picture against the radar chain itself with another draw of the noise, down to 40 dB."""
    radar, wall = PRESETS[scene].radar, PRESETS[scene].wall
    people = one_person_many_ways(12, torch.Generator().manual_seed(0))
    motion = ActivityGenerator().generate(torch.arange(12), people=people, duration_s=1.0, rate_hz=240.0)
    positions = ts.motion.PoseResampler(radar.prf_hz)(motion.joints[activity : activity + 1], 240.0)
    echo = EchoSynthesizer(radar, wall, multipath=wall is not None)
    simulator = ts.radar.RadarSimulator(radar, echo=echo, snr_db=snr_db)
    torch.manual_seed(1)
    maps = simulator(positions, torch.tensor(ts.JOINT_RCS_M2, dtype=torch.float64))
    store = MapStore(folder)
    expected = MapToImage.doppler(radar, size=store.settings.size).average(maps.doppler_time.square())[0]
    found = store.power(scene, 0, activity, snr_db)
    ratio_db = 10 * (found / found.mean() / (expected / expected.mean())).log10()
    return ratio_db[expected > 1e-4 * expected.max()]


@pytest.mark.filterwarnings("ignore:positions. some scatterer has a radial speed")
@pytest.mark.parametrize("snr_db", [50.0, 10.0, -5.0])
def test_pictures_are_those_of_the_simulator(folder: Path, snr_db: float) -> None:
    for activity in (5, 7, 9):
        difference = difference_db(folder, "through-wall", activity, snr_db)
        assert abs(float(difference.mean())) < 0.3
        assert float(difference.abs().median()) < 1.0


def test_any_ratio_from_three_pictures() -> None:
    """``sum |S + s N|^2 = A + 2 s B + s^2 C`` holds for pictures, and C's root bounds B."""
    maker = MapMaker("through-wall", SMALL)
    generator = torch.Generator().manual_seed(0)
    echo, noise = torch.randn(2, 128, 200, dtype=torch.complex64, generator=generator)
    s = 0.3

    def picture(profiles: torch.Tensor) -> torch.Tensor:
        return maker.picture(torch.cat(list(maker.spectra(profiles))).abs().square().sum(0))

    spectra = [torch.cat(list(maker.spectra(x))) for x in (echo, noise)]
    cross = maker.picture((spectra[0] * spectra[1].conj()).real.sum(0))
    a, c = picture(echo), picture(noise)
    torch.testing.assert_close(picture(echo + s * noise), a + 2 * s * cross + s**2 * c, rtol=1e-4, atol=0)
    assert bool((cross.square() <= a * c * (1 + 1e-6)).all())


@pytest.mark.parametrize("settings", [MapSettings(size=32), MapSettings(size=64, duration_s=20.0)])
def test_few_columns_of_long_clips_see_every_pulse(settings: MapSettings) -> None:
    frames = MapMaker("free-space", settings).frames
    assert frames.hop == frames.length


def test_empty_scene_is_noise(folder: Path) -> None:
    store = MapStore(folder)
    assert float(store.power("through-wall", 0, 0, None).max()) == 0
    loud, quiet = (scaled(store.power("through-wall", 0, 0, snr), "db", 40.0) for snr in (10.0, 50.0))
    torch.testing.assert_close(loud, quiet, rtol=0, atol=1e-5)
    assert float(loud.mean()) > 0.7


def test_one_body_many_ways() -> None:
    people = one_person_many_ways(5, torch.Generator().manual_seed(3))
    for field in ("height_m", "mass_kg", "female", "left_handed"):
        assert len(getattr(people, field).unique()) == 1, field
    assert all(len(torch.as_tensor(p).unique()) == 1 for p in people.proportions)
    for field in ("speed_m_s", "heading_rad", "gait_phase"):
        assert len(getattr(people, field).unique()) == 5, field


def test_goes_on_where_it_stopped(folder: Path) -> None:
    path = folder / "through-wall-00000.safetensors"
    before, content = path.stat().st_mtime_ns, path.read_bytes()
    build_maps(folder, 1, ("through-wall",), SMALL, quiet=True)
    assert path.stat().st_mtime_ns == before
    path.unlink()
    build_maps(folder, 1, ("through-wall",), SMALL, quiet=True)
    assert path.read_bytes() == content, "a person of a seed is always the same"
    assert MapStore(folder).people == {"free-space": [], "through-wall": [0]}
    assert not list(folder.glob("*.tmp"))


def test_refuses_what_does_not_belong(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(TensorsimError, match="got maps of"):
        build_maps(folder, 1, ("through-wall",), MapSettings(size=14), quiet=True)
    assert json.loads((folder / "settings.json").read_text())["size"] == 28
    with pytest.raises(TensorsimError, match=r"no settings\.json"):
        MapStore(tmp_path)
    with pytest.raises(TensorsimError, match="got 'garden', expected one of"):
        MapMaker("garden", SMALL)
    with pytest.raises(TensorsimError, match="expected positive numbers"):
        MapSettings(size=0)


@pytest.mark.slow
def test_free_space_pictures_are_those_of_the_simulator(tmp_path: Path) -> None:
    """As for the other scene; here only the range bins near the body are worked out, in closed form."""
    build_maps(tmp_path, 1, ("free-space",), MapSettings(size=84, duration_s=1.0), quiet=True)
    difference = difference_db(tmp_path, "free-space", 7, 20.0)
    assert abs(float(difference.mean())) < 0.3
    assert float(difference.abs().median()) < 1.0


@pytest.fixture(scope="module")
def errors() -> FilmErrors:
    """Errors of networks that see a walking person as it is."""
    clip = ActivityClip("S8 Walking", "0", 7, 1.0)
    return FilmErrors({"film": Watched.of(clip, true_keypoints(clip))})


def test_motion_that_a_camera_saw(errors: FilmErrors) -> None:
    """Empty stays empty; a walking person is at the same place within the store's span of speeds."""
    settings = replace(MapSettings.of_films(0, errors), size=28, duration_s=1.0)
    assert settings.motion_hz == 30.0
    maker = MapMaker("through-wall", settings)
    movers = (MotionMaker(settings, errors), MotionMaker(replace(settings, films="")))
    seen, true = (maker.pictures(mover(0)) for mover in movers)
    assert int(seen["signal"][0].max()) == 0
    assert bool((seen["signal"][1:].flatten(1).amax(1) == 255).all())
    assert not torch.equal(seen["signal"][7], true["signal"][7])
    fastest = [(from_bytes(x["signal"][7]) > 1e-2).any(1).nonzero().flatten() for x in (seen, true)]
    assert abs(float(fastest[0].double().mean() - fastest[1].double().mean())) < 3
    for other, given in ((settings, None), (replace(settings, films="0123"), errors), (SMALL, errors)):
        with pytest.raises(TensorsimError, match="errors of different films"):
            MotionMaker(other, given)


def test_nobody_adds_nothing() -> None:
    """A person present for half of the time has an echo only then."""
    maker = MapMaker("through-wall", replace(SMALL, motion_hz=30.0))
    noise = maker.noise(128, torch.Generator().manual_seed(0))
    walk = ActivityClip("S8 Walking", "0", 7, 1.0).joints(30.0)
    echo, _ = maker.echo_pictures(walk, torch.arange(30) < 15, noise)
    assert float(echo[:, 17:].sum()) < 1e-3 * float(echo[:, :11].sum())


@pytest.mark.parametrize("content", ["{", "[]", '{"filmed": false}', '{"size": "large"}'])
def test_other_settings_are_refused(content: str, tmp_path: Path) -> None:
    (tmp_path / "settings.json").write_text(content)
    for read in (lambda: MapStore(tmp_path), lambda: build_maps(tmp_path, 0, ("through-wall",), SMALL)):
        with pytest.raises(TensorsimError, match=r"settings\.json: not the settings of a store of maps"):
            read()


def test_stores_of_before_are_read(tmp_path: Path) -> None:
    stated = asdict(SMALL)
    del stated["films"]
    (tmp_path / "settings.json").write_text(json.dumps(stated))
    build_maps(tmp_path, 0, ("through-wall",), SMALL, quiet=True)
    assert MapStore(tmp_path).settings == SMALL
