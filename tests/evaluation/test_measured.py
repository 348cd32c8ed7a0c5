"""The experiments on measured sets: on small folders of their layout, and quickly on the real ones."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from tensorsim import cli
from tensorsim.errors import TensorsimError
from tensorsim.evaluation.measured import glasgow, motions, radhar, report, run, sense2gol
from tensorsim.evaluation.measured.ablation import ablation_table
from tensorsim.evaluation.measured.run import SETTINGS, few, lda_logits
from tensorsim.evaluation.measured.sets import SETS
from tensorsim.evaluation.measured.training import fit_pictures, predict, shift
from tensorsim.radar.measured_sensors import MEASURED_SENSORS
from tensorsim.recognition import DIATRadHARNet
from tensorsim.recognition.confusion import confusion


def write_folder(folder: Path, clips: int, seed: int) -> Path:
    """Random sets of the layout that the README of the measured sets gives."""
    rng = np.random.default_rng(seed)
    for name in ("glasgow_cfar_masks", "kmkim_cw24_iq", "radhar_points"):
        (folder / name).mkdir(parents=True)
    labels = np.arange(6).repeat(clips).astype(np.int8)
    masks = rng.random((6 * clips, 256, 256)) < 0.05
    masks[:, 126:130] = True
    np.savez(
        folder / "glasgow_cfar_masks" / "masks.npz", dt_packed=np.packbits(masks, axis=-1), label=labels,
        classes=np.array(glasgow.CLASSES),
    )  # fmt: skip
    labels = np.arange(5).repeat(clips).astype(np.int8)
    np.savez(
        folder / "kmkim_cw24_iq" / "clips.npz", label=labels,
        iq=(2090 + 100 * rng.normal(size=(5 * clips, 2, 1920))).astype(np.int16),
        classes=np.array(["walk", "run", "stride", "creep", "empty"]),
    )  # fmt: skip
    dt = (rng.random((5 * clips, 16, 60)) < 0.1) * np.uint8(120)
    np.savez(folder / "radhar_points" / "maps.npz", dt=dt, label=labels, classes=np.array(radhar.CLASSES))
    return folder


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> tuple[Path, Path]:
    root = tmp_path_factory.mktemp("measured")
    return write_folder(root / "train", 3, 0), write_folder(root / "test", 2, 1)


def words(folders, out: Path, *more: str) -> list[str]:
    train, test = map(str, folders)
    return ["evaluate", "measured", "--train", train, "--test", test, "--out", str(out), "--quiet", *more]


def test_every_experiment_is_run_and_written(folders, tmp_path, capsys):
    cli.main(words(folders, tmp_path, "--sets", "radhar_points", "--clips", "2", "--steps", "3"))
    results = json.loads((tmp_path / "measured.json").read_text())
    assert list(results) == ["radhar_points"]
    row = results["radhar_points"]
    assert set(row) == {"classes", "simulation_only_subset", *SETTINGS}
    assert row["classes"] == 5
    assert row["simulation_only_subset"]["classes"] == ["boxing", "squats", "walk"]
    assert all(0 <= row[name] <= 1 for name in SETTINGS)
    for setting in SETTINGS:
        with (tmp_path / f"confusion_radhar_points_{setting}.csv").open() as file:
            rows = list(csv.reader(file))
        counts = np.array([[int(x) for x in line[1:]] for line in rows[1:]])
        assert counts.sum(1).tolist() == [2] * 5
        assert np.trace(counts) / counts.sum() == pytest.approx(row[setting])
    assert (tmp_path / "calibration_radhar_points.csv").is_file()
    assert DIATRadHARNet.from_pretrained(tmp_path / "measured_radhar.safetensors").num_classes == 5
    assert "| radhar_points | 5 |" in capsys.readouterr().out


def test_quick_takes_the_shipped_weights(folders, tmp_path, capsys):
    cli.main(words(folders, tmp_path, "--quick"))
    results = json.loads((tmp_path / "measured.json").read_text())
    assert list(results) == [s.name for s in SETS]
    for row in results.values():
        assert 0 <= row["simulation_only"] <= 1
        assert [row[name] for name in SETTINGS[1:]] == [None] * 4
    assert "glasgow_cfar_masks" in capsys.readouterr().out


def test_shipped_weights_know_measured_clips(shared_data, tmp_path):
    """Simulation alone on the recordings given for development; floors below the figures of the cards."""
    folder = shared_data / "measured"
    if not folder.is_dir():
        pytest.skip("no measured sets beside the checkout")
    cli.main(words((folder, folder), tmp_path, "--quick"))
    results = json.loads((tmp_path / "measured.json").read_text())
    floors = {"glasgow_cfar_masks": (0.7, 0.85), "kmkim_cw24_iq": (0.8, 0.88), "radhar_points": (0.5, 0.7)}
    for name, (least, least_subset) in floors.items():
        assert results[name]["simulation_only"] > least
        assert results[name]["simulation_only_subset"]["accuracy"] > least_subset


def test_ablation_leaves_out_each_effect_and_keeps_its_trainings(folders, tmp_path, capsys, monkeypatch):
    options = ("--ablation", "--sets", "kmkim_cw24_iq", "--clips", "1", "--steps", "1", "--repeats", "2")
    cli.main(words(folders, tmp_path, *options))
    text = (tmp_path / "ablation_kmkim_cw24_iq.md").read_text()
    assert all(f"| {name} |" in text for name in SETS[1].effect_names)
    assert text in capsys.readouterr().out
    assert len(list((tmp_path / "results").iterdir())) == 2 * (1 + len(SETS[1].effect_names))

    # A second run trains what is missing: here one of the seeds of one effect.
    sorted((tmp_path / "results").glob("kmkim_cw24_iq-beam-*"))[0].unlink()
    trained = []
    alone = run.Experiment.simulation_alone

    def counted(self, seed, without=None):
        trained.append(without)
        return alone(self, seed, without)

    monkeypatch.setattr(run.Experiment, "simulation_alone", counted)
    cli.main(words(folders, tmp_path, *options))
    assert trained == ["beam"]
    assert (tmp_path / "ablation_kmkim_cw24_iq.md").read_text() == text


def test_other_test_clips_in_the_same_folder_are_told_apart(tmp_path):
    tested = set()
    for seed in (0, 0, 1):
        shutil.rmtree(tmp_path / "sets", ignore_errors=True)
        write_folder(tmp_path / "sets", 2, seed)
        tested.add(run.Experiment(SETS[2], tmp_path / "sets", tmp_path / "sets", tmp_path).tested)
    assert len(tested) == 2


def test_ablation_table_by_hand(folders, tmp_path):
    experiment = run.Experiment(SETS[1], folders[0], folders[1], tmp_path)
    rows = {"": [[0.6, 0.8], [0.7, 0.9]], "beam": [[0.5, 0.8], [0.5, 1.0]]}
    lines = ablation_table(experiment, rows).splitlines()
    assert lines[2:] == [
        "| (nothing left out) | 65.0 % (60.0 to 70.0) |  | 85.0 % (80.0 to 90.0) |  |",
        "| beam | 50.0 % (50.0 to 50.0) | +15.0 | 90.0 % (80.0 to 100.0) | -5.0 |",
    ]


@pytest.mark.parametrize("measured", SETS, ids=lambda s: s.name)
def test_every_effect_changes_the_pictures(measured):
    """No switch of an ablation is dead: without the effect, some clip changes."""
    whole, _ = measured.simulate(2, 0, quiet=True)
    for name in measured.effect_names:
        assert not torch.equal(whole, measured.simulate(2, 0, quiet=True, without=name)[0]), name


@pytest.mark.parametrize(("hz", "gain"), [(2.0, 0.77), (3.0, 0.39), (5.0, 0.08)])
def test_smoother_of_the_paper_dims_quick_limbs(hz, gain):
    """Gains of the Rauch-Tung-Striebel smoother with the paper's noises at 30 fps, here at the rate of the knots."""
    time = torch.arange(600, dtype=torch.float64) / motions.KNOT_HZ
    joints = torch.sin(2 * torch.pi * hz * time)[None, :, None, None].expand(1, 600, 14, 3)
    smooth = motions.smooth_as_paper(joints)
    middle = slice(200, 400)
    assert float(smooth[0, middle].std() / joints[0, middle].std()) == pytest.approx(gain, abs=0.05)


@pytest.mark.parametrize(
    ("hz", "seen_hz"), [(100.0, 100.0), (-190.0, -190.0), (290.0, -210.0), (-410.0, 90.0)]
)
def test_half_the_pulse_rate_wraps_what_is_beyond_half_of_the_axis(hz, seen_hz):
    """Of 1000 pulses a second every second one sees +-250 Hz; both tones have their level."""
    time = torch.arange(400, dtype=torch.float64) / 1000
    tone = torch.exp(2j * torch.pi * hz * time).expand(3, 400)
    expected = torch.exp(2j * torch.pi * seen_hz * time).expand(3, 400)
    torch.testing.assert_close(motions.at_half_the_pulse_rate(tone), expected, rtol=0, atol=1e-9)


def test_without_a_test_folder_the_last_clips_of_each_class_are_tested(folders, tmp_path):
    labels = torch.tensor([0] * 10 + [1] * 4 + [0] * 10)
    early, late = run.split(labels)
    assert late.tolist() == [*range(18, 24), 13]
    assert sorted([*early.tolist(), *late.tolist()]) == list(range(24))
    with pytest.raises(TensorsimError, match="class 1: got one clip"):
        run.split(torch.tensor([0, 0, 1]))
    options = ("--train", str(folders[0]), "--out", str(tmp_path), "--sets", "radhar_points", "--quiet")
    cli.main(["evaluate", "measured", *options, "--clips", "1", "--steps", "1"])
    with (tmp_path / "confusion_radhar_points_lda.csv").open() as file:
        counts = [[int(x) for x in line[1:]] for line in list(csv.reader(file))[1:]]
    assert np.array(counts).sum(1).tolist() == [1] * 5  # of three each


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (("--clips", "0"), "--clips: got 0"),
        (("--quick", "--ablation"), "cannot be combined"),
        (("--repeats", "2"), "--repeats: got 2 without --ablation"),
        (("--quick", "--clips", "20"), "--clips: got 20 with --quick, which trains nothing"),
        (("--quick", "--seed", "1"), "--seed: got 1 with --quick"),
        (("--train", "nowhere"), "nowhere: no such folder"),
    ],
)
def test_bad_requests_are_refused(folders, tmp_path, capsys, more, message):
    with pytest.raises(SystemExit) as stop:
        cli.main(words(folders, tmp_path, *more))
    assert stop.value.code == 2
    assert message in capsys.readouterr().err


def test_clips_to_learn_from_are_not_tested(folders, tmp_path, monkeypatch, capsys):
    """The same folder may be given where nothing is learnt from it; otherwise it is refused before any simulation."""
    same = (folders[0], folders[0])
    with monkeypatch.context() as patch:
        patch.setattr(
            run.Experiment, "quick", lambda self: {"simulation_only": torch.zeros(len(self.test), 5)}
        )
        cli.main(words(same, tmp_path, "--quick", "--sets", "radhar_points"))
    monkeypatch.setattr(run.Experiment, "full", None)
    with pytest.raises(SystemExit):
        cli.main(words(same, tmp_path, "--sets", "radhar_points"))
    assert "radhar_points: got the same clips to train on and to test on" in capsys.readouterr().err


def test_matrices_of_an_earlier_run_are_removed(tmp_path):
    labels, logits = torch.arange(5), torch.eye(5)
    report.write(tmp_path, "radhar_points", SETS[2], dict.fromkeys(SETTINGS, logits), labels)
    (tmp_path / "confusion_radhar_points_own.csv").write_text("")
    report.write(tmp_path, "radhar_points", SETS[2], {"simulation_only": logits}, labels)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "calibration_radhar_points.csv",
        "confusion_radhar_points_own.csv",
        "confusion_radhar_points_simulation_only.csv",
    ]


def test_damaged_folders_are_refused(tmp_path):
    (tmp_path / "radhar_points").mkdir()
    with pytest.raises(TensorsimError, match=r"maps\.npz: no such file"):
        SETS[2].load(tmp_path)
    np.savez(tmp_path / "radhar_points" / "maps.npz", other=np.zeros(3))
    with pytest.raises(TensorsimError, match="cannot be read as the measured clips of radhar_points"):
        SETS[2].load(tmp_path)


def changed(folder: Path, out: Path, measured, **arrays) -> Path:
    """A folder with a measured set of which some arrays are others."""
    with np.load(folder / measured.name / measured.file) as file:
        content = {name: file[name] for name in file.files}
    (out / measured.name).mkdir(parents=True, exist_ok=True)
    np.savez(out / measured.name / measured.file, **(content | arrays))
    return out


@pytest.mark.parametrize("measured", SETS, ids=lambda s: s.name)
def test_labels_are_those_of_the_classes_of_the_file(folders, tmp_path, measured):
    expected, labels = measured.load(folders[0])
    with np.load(folders[0] / measured.name / measured.file) as file:
        names, label = file["classes"], file["label"]
    turned = changed(folders[0], tmp_path, measured, classes=names[::-1], label=len(names) - 1 - label)
    shown, found = measured.load(turned)
    assert torch.equal(found, labels)
    assert torch.equal(shown, expected)


@pytest.mark.parametrize("measured", SETS, ids=lambda s: s.name)
def test_clips_that_are_not_those_of_the_set_are_refused(folders, tmp_path, measured):
    with np.load(folders[0] / measured.name / measured.file) as file:
        clips, label, names = file[measured.array], file["label"], file["classes"]
    for arrays, message in (
        ({measured.array: clips[..., ::2]}, f"{measured.array}: got shape .* expected"),
        ({measured.array: clips[1:]}, "a clip for each label"),
        ({"label": label + 1}, "label: got int8 .* expected an integer from 0 to"),
        ({"label": label.astype(float)}, "label: got float64"),
        ({"classes": np.array([*names[:-1], "flying"])}, "classes: got 'flying', expected some of"),
        ({"classes": names[:1]}, "label: .* from 0 to 0"),
    ):
        with pytest.raises(TensorsimError, match=message):
            measured.load(changed(folders[0], tmp_path, measured, **arrays))


def test_one_class_is_refused_before_training(folders, tmp_path, monkeypatch):
    one = changed(folders[0], tmp_path, SETS[2], label=np.zeros(15, np.int8))
    experiment = run.Experiment(SETS[2], one, one, tmp_path, clips=1, steps=1, quiet=True)
    monkeypatch.setattr(run, "fit_pictures", None)
    with pytest.raises(TensorsimError, match="radhar_points: got clips of one class"):
        experiment.full()


@pytest.mark.parametrize("measured", SETS, ids=lambda s: s.name)
def test_simulation_is_seeded_and_shaped_like_the_measured(folders, measured):
    shown, labels = measured.simulate(1, 7, quiet=True)
    real, _ = measured.load(folders[0])
    assert shown.shape[1:] == real.shape[1:]
    assert labels.tolist() == list(range(len(measured.classes)))
    again, _ = measured.simulate(1, 7, quiet=True)
    assert torch.equal(shown, again)
    assert not torch.equal(shown, measured.simulate(1, 8, quiet=True)[0])


def test_walkers_before_the_glasgow_radar_come_and_go():
    masks = glasgow.Glasgow(glasgow.Effects()).simulate(0, 2, torch.Generator().manual_seed(0)).float()
    # Rows: approaching above the middle, receding below; both in 10 s of walking to and fro.
    assert float(masks[:, 45:60].mean()) > 0.02
    assert float(masks[:, 70:85].mean()) > 0.02
    assert float(masks[:, :20].mean()) < 0.05


def test_runners_come_at_their_doppler():
    signal = sense2gol.Sense2Gol(sense2gol.Effects(image=False, unrest=False))
    maps = signal.simulate(1, 4, torch.Generator().manual_seed(1))
    hz = (torch.arange(64) - 32) * 3000 / 128
    strongest = hz[maps[:, :, 4:9].argmax(1)]
    assert float(strongest.max()) < -150  # towards is negative
    assert float(strongest.min()) > -560


def test_mains_of_the_maps_equal_scipy():
    """Bursts: mean removed, Hamming window, 128 points, decibels."""
    from scipy.signal import get_window

    iq = torch.randn(1, 2, 256, generator=torch.Generator().manual_seed(0)) * 50
    signal = (iq[0, 0] + 1j * iq[0, 1]).numpy().astype(complex)
    burst = signal[128:] - signal[128:].mean()
    spectrum = np.fft.fftshift(np.fft.fft(burst * get_window("hamming", 128, fftbins=False)))
    expected = 10 * np.log10(np.abs(spectrum) ** 2 + 1)
    np.testing.assert_allclose(sense2gol.doppler_maps(iq)[0, :, 1].numpy(), expected, atol=1e-3)


def test_few_takes_as_many_of_each_class_spread_over_the_files():
    labels = torch.tensor([0] * 30 + [1] * 5 + [2] * 12)
    chosen = few(labels, 10)
    assert labels[chosen].bincount().tolist() == [10, 5, 10]
    assert len(chosen.unique()) == len(chosen)
    assert {0, 29, 30, 34, 35, 46} <= set(chosen.tolist())


def test_figures_by_hand():
    logits = torch.tensor([[2.0, 1.0, 0.0], [0.0, 1.0, 2.0], [0.0, 3.0, 1.0], [1.0, 0.0, 2.0]])
    labels = torch.tensor([0, 1, 1, 2])
    assert report.accuracy(logits, labels) == 0.75
    # Among classes 0 and 1 all three are right.
    assert report.subset_accuracy(logits, labels, [0, 1]) == 1.0
    assert confusion(logits, labels).tolist() == [[1, 0, 0], [0, 1, 1], [0, 0, 1]]


def test_lda_separates_what_is_linear():
    generator = torch.Generator().manual_seed(0)
    shown, labels = torch.rand(60, 1, 8, 8, generator=generator), torch.arange(60) % 3
    shown = shown + 0.3 * labels.view(-1, 1, 1, 1)
    logits = lda_logits(shown[:40], labels[:40], shown[40:], 4)
    assert logits.shape == (20, 4)
    assert report.accuracy(logits, labels[40:]) > 0.9
    assert bool((logits[:, 3] == -100).all())


def test_training_learns_and_repeats(capsys):
    generator = torch.Generator().manual_seed(0)
    shown, labels = torch.rand(40, 1, 8, 16, generator=generator), torch.arange(40) % 2
    shown[labels == 1, :, 2:4] += 1.0
    logits = []
    for _ in range(2):
        torch.manual_seed(1)
        layers = torch.nn.Conv2d(1, 4, 3, padding=1), torch.nn.ReLU(), torch.nn.Flatten()
        net = torch.nn.Sequential(*layers, torch.nn.Linear(4 * 8 * 16, 2))
        fit_pictures(
            net, shown, labels, steps=30, augment=lambda x, g: shift(x, 2, -1, g), batch=16,
            quiet=len(logits) == 0,
        )  # fmt: skip
        assert ("30/30" in capsys.readouterr().err) == (len(logits) == 1)
        logits.append(predict(net, shown))
    assert torch.equal(*logits)
    assert report.accuracy(logits[0], labels) > 0.95


def test_sensors_have_the_axes_of_the_measured_sets():
    scene = MEASURED_SENSORS["radhar-iwr1443"].radar
    assert scene.range_resolution_m == pytest.approx(0.0436)
    # Sixteen bins of 0.6147 m/s to either side of 0: lambda / (2 16 T).
    wavelength = 299_792_458 / (scene.carrier_hz + scene.bandwidth_hz / 2)
    assert wavelength * scene.prf_hz / (2 * 16) == pytest.approx(0.6147)
    glasgow_radar = MEASURED_SENSORS["glasgow-ancortek"].radar
    for radar in (scene, glasgow_radar):  # ranges count from between the antennas, which is at x = 0
        assert np.add(radar.tx_m, radar.rx_m).tolist() == [0.0, 0.0, 2.0]
    assert glasgow_radar.range_resolution_m == pytest.approx(0.375, rel=1e-3)
    assert glasgow_radar.prf_hz == 2 * glasgow.RADAR.prf_hz == 1000
