"""Labels of windows: where they lie, what they see, how sure they are."""

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import tensorsim as ts
from tensorsim.errors import TensorsimError
from tensorsim.recognition.timeline import (
    NOT_SURE,
    Window,
    label_windows,
    scene_probabilities,
    window_starts,
)
from tensorsim.summary import label_of
from tensorsim.types import RadarMaps

RADAR = ts.RadarConfig.through_wall()


class BrightHalf(nn.Module):
    """Two classes: power in the upper, and in the lower half of the picture."""

    num_classes = 2
    in_channels = 1

    def forward(self, pictures: Tensor) -> Tensor:
        upper, lower = pictures.squeeze(-3).chunk(2, dim=-2)
        return torch.stack([upper.mean((-2, -1)), lower.mean((-2, -1))], -1) * 20


def maps(columns: int, approaching_from: int) -> RadarMaps:
    """Receding motion, then approaching motion from a column on."""
    doppler_time = torch.zeros(256, columns)
    doppler_time[60, :approaching_from] = 1.0
    doppler_time[200, approaching_from:] = 1.0
    blank = torch.zeros(10, columns)
    indices = torch.zeros(1, columns, dtype=torch.int64)
    return RadarMaps(blank, blank, doppler_time, indices, indices.float(), torch.tensor(50.0))


def recognizer(temperature: float = 1.0) -> ts.recognition.ActivityRecognizer:
    network = BrightHalf()
    return ts.recognition.ActivityRecognizer(
        RADAR, network, size=64, class_names=("receding", "approaching"), temperature=temperature
    ).eval()


@pytest.mark.parametrize(
    ("duration_s", "expected"),
    [
        (2.0, [0.0]),
        (4.0, [0.0]),
        (4.9, [0.0]),
        (5.0, [0.0, 1.0]),
        (5.4, [0.0, 1.4]),
        (5.9, [0.0, 1.0, 1.9]),
        (6.4, [0.0, 1.0, 2.4]),
        (6.5, [0.0, 1.0, 2.0, 2.5]),
        (7.0, [0, 1, 2, 3]),
    ],
)
def test_windows_cover_the_scene(duration_s: float, expected: list[float]) -> None:
    assert window_starts(duration_s) == pytest.approx(expected)


def test_each_window_sees_its_own_part() -> None:
    windows = label_windows(recognizer(), maps(1000, 500), 10.0)
    assert [w.start_s for w in windows] == [0, 1, 2, 3, 4, 5, 6]
    assert [w.label for w in windows] == ["receding"] * 3 + [windows[3].label] + ["approaching"] * 3
    assert [w.end_s - w.start_s for w in windows] == [4.0] * 7
    np.testing.assert_allclose(windows[3].probabilities, (0.5, 0.5), atol=0.02)
    means = np.mean([w.probabilities for w in windows], axis=0)
    np.testing.assert_allclose(scene_probabilities(windows).numpy(), means, atol=1e-6)


def test_windows_count_by_the_power_of_their_motion() -> None:
    fell, still = Window(0.0, 4.0, "fall", (0.1, 0.9), 3.0), Window(4.0, 8.0, "turn", (0.7, 0.3), 1.0)
    assert scene_probabilities([fell, still]).tolist() == pytest.approx([0.25, 0.75])
    nothing = [window._replace(power=0.0) for window in (fell, still)]
    assert scene_probabilities(nothing).tolist() == pytest.approx([0.4, 0.6])
    scene = maps(800, 400)
    scene.doppler_time[:, 400:] *= 0.1
    first, *_, last = label_windows(recognizer(), scene, 8.0)
    assert (first.power, last.power) == pytest.approx((1.0, 0.01))


def test_a_short_scene_is_one_window() -> None:
    (window,) = label_windows(recognizer(), maps(100, 100), 2.5)
    assert (window.start_s, window.end_s, window.label) == (0.0, 2.5, "receding")


def test_temperature_makes_less_sure_and_keeps_the_label() -> None:
    scene = maps(100, 100)
    logits = recognizer()(scene)
    for temperature in (1.0, 4.0):
        expected = torch.softmax(logits / temperature, -1)
        torch.testing.assert_close(recognizer(temperature).probabilities(scene), expected)
        scripted = torch.jit.script(recognizer(temperature))
        torch.testing.assert_close(scripted.probabilities(scene), expected)
    best = float(torch.softmax(logits / 4.0, -1).max())
    (doubtful,) = label_windows(recognizer(4.0), scene, 4.0, least_probability=best + 0.01)
    (sure,) = label_windows(recognizer(4.0), scene, 4.0, least_probability=best - 0.01)
    assert (doubtful.label, sure.label) == (NOT_SURE, "receding")


def test_the_temperature_is_stored_with_the_weights(tmp_path) -> None:
    network = ts.recognition.SPGNet(2)
    own = ts.recognition.ActivityRecognizer(
        RADAR, network, size=32, class_names=("a", "b"), temperature=2.5, either_way=True
    )
    own.save_pretrained(tmp_path / "own.safetensors")
    again = ts.recognition.ActivityRecognizer.from_pretrained(RADAR, tmp_path / "own.safetensors")
    assert again.temperature == 2.5
    assert again.either_way


def test_the_other_way_round_counts_as_much() -> None:
    """Logits are the mean over a map and its mirror image, so the directions look alike, as the file states."""
    scene = maps(64, 20)
    plain = recognizer()(scene)
    both = ts.recognition.ActivityRecognizer(
        RADAR, BrightHalf(), size=64, class_names=("receding", "approaching"), either_way=True
    )
    turned = scene._replace(doppler_time=torch.cat([scene.doppler_time[:1], scene.doppler_time[1:].flip(0)]))
    torch.testing.assert_close(both(scene), (plain + recognizer()(turned)) / 2, atol=1e-3, rtol=0)
    torch.testing.assert_close(torch.jit.script(both)(scene), both(scene))
    with pytest.raises(TensorsimError, match="range-time maps have no reversed form"):
        ts.recognition.ActivityRecognizer(RADAR, BrightHalf(), "merged", either_way=True)


def test_labels_need_no_graph() -> None:
    """The weights of `from_pretrained` are trainable: each number of a graph would be a warning of torch."""
    asked, graphs = recognizer(), []
    asked.network.register_forward_hook(lambda *_: graphs.append(torch.is_grad_enabled()))
    label_windows(asked, maps(1000, 500), 10.0)
    assert graphs == [False] * 7


def test_bad_input_is_refused() -> None:
    with pytest.raises(TensorsimError, match="temperature: got 0"):
        recognizer(0.0)
    with pytest.raises(TensorsimError, match=r"expected those of one scene \(F, K\)"):
        label_windows(recognizer(), RadarMaps(*(x[None] for x in maps(10, 5))), 4.0)
    with pytest.raises(TensorsimError, match="duration_s: got 0"):
        label_windows(recognizer(), maps(10, 5), 0.0)


class Fixed(nn.Module):
    """Gives the same result for every picture."""

    num_classes = 3
    in_channels = 1

    def forward(self, pictures: Tensor) -> Tensor:
        return torch.tensor([1.0, 3.0, 0.0]).expand(*pictures.shape[:-3], 3)


def test_the_summary_has_the_label_and_every_probability() -> None:
    """softmax(1, 3, 0) = 0.1142, 0.8438, 0.0420; names in the order of the network's outputs."""
    names = ("sitting", "walking", "falling")
    known = ts.recognition.ActivityRecognizer(RADAR, Fixed(), size=64, class_names=names).eval()
    found = label_of(known, maps(400, 200), 4.0)
    assert found["label"] == "walking"
    assert found["probabilities"] == {"sitting": 0.1142, "walking": 0.8438, "falling": 0.042}
    assert [w["label"] for w in found["timeline"]] == ["walking"]
    assert found["timeline"][0]["probability"] == 0.8438
    unsure = label_of(known, maps(400, 200), 4.0, 0.9)
    assert unsure["label"] == NOT_SURE
    assert unsure["probabilities"] == found["probabilities"]
    assert label_of(None, maps(400, 200), 4.0) == {"label": None, "probabilities": None, "timeline": None}
