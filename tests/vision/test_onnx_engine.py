"""Networks in ONNX Runtime and OpenVINO answer as in torch, for any number of images, and are exported once."""

import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch
from torch import nn

import tensorsim as ts
from tensorsim.device import multiplies_bfloat16
from tensorsim.errors import TensorsimError
from tensorsim.render.crops import rendered_crops
from tensorsim.vision.onnx_engine import OnnxDetector, OnnxEngine, OnnxPose, Runtime, import_failure
from tensorsim.vision.pose2d.heatmaps import HeatmapDecoder


@pytest.fixture(autouse=True)
def _cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))


def exported(tmp_path: Path) -> list[Path]:
    return sorted((tmp_path / "hub" / "tensorsim" / "engines").glob("*.onnx"))


@pytest.mark.parametrize("runtime", ["onnxruntime", "openvino"])
@torch.no_grad()
def test_pose_network_answers_as_in_torch_and_is_exported_once(tmp_path: Path, runtime: Runtime) -> None:
    network = ts.vision.HRNet.from_pretrained()
    crops = torch.rand(3, 3, *network.input_size)
    for _ in range(2):
        found = OnnxPose(network, runtime)(crops)
        assert torch.allclose(found, network(crops), atol=1e-4)
        assert len(exported(tmp_path)) == 1
    assert OnnxPose(network, runtime)(crops[:0]).shape[0] == 0
    again = pickle.loads(pickle.dumps(OnnxPose(network, runtime)))
    assert torch.allclose(again(crops[:1]), found[:1], atol=1e-5)


@pytest.mark.parametrize("runtime", ["onnxruntime", "openvino"])
@torch.no_grad()
def test_detector_answers_as_in_torch(runtime: Runtime) -> None:
    detector = ts.vision.RTMDet.from_pretrained()
    images = torch.randint(0, 256, (2, 3, 90, 160), dtype=torch.uint8)
    ours, expected = OnnxDetector(detector, runtime)(images), detector(images)
    assert torch.equal(ours.valid, expected.valid)
    dense = detector.preprocess(images)
    logits, distances = detector.dense(dense)
    for found, wanted in zip(OnnxDetector(detector, runtime).engine(dense), logits + distances, strict=True):
        assert float((found - wanted).abs().max()) < 1e-4 * float(wanted.abs().max())


@pytest.mark.parametrize("shape", [(720, 1280), (97, 41), (300, 500)])
def test_pictures_are_prepared_to_the_bit_as_in_torch(shape: tuple[int, int]) -> None:
    detector = ts.vision.RTMDet.from_pretrained()
    images = torch.randint(0, 256, (2, *shape, 3), dtype=torch.uint8).permute(0, 3, 1, 2)
    assert torch.equal(OnnxDetector(detector).preprocess(images), detector.preprocess(images))
    floats = images[:1] / 255
    assert torch.equal(OnnxDetector(detector).preprocess(floats), detector.preprocess(floats))
    with pytest.raises(TensorsimError, match="images"):
        OnnxDetector(detector).preprocess(images[0])
    with pytest.raises(TensorsimError, match="images"):
        OnnxDetector(detector).preprocess(images[:, :2])
    with pytest.raises(TensorsimError, match="images: got an empty tensor"):
        OnnxDetector(detector).preprocess(images[:, :, :0])


def test_other_sizes_and_gradients_are_of_the_network_itself() -> None:
    network = nn.Conv2d(3, 17, 3, stride=4)
    engine = OnnxEngine(network, (8, 8))
    larger, images = torch.rand(1, 3, 16, 12), torch.rand(1, 3, 8, 8, requires_grad=True)
    assert torch.equal(engine(larger)[0], network(larger))
    engine(images)[0].sum().backward()
    assert images.grad is not None


def test_other_weights_are_another_file_and_damage_is_repaired(tmp_path: Path) -> None:
    with torch.no_grad():
        network = nn.Conv2d(3, 4, 3).eval()
        images = torch.rand(2, 3, 8, 9)
        OnnxEngine(network, (8, 9))(images)
        network.bias.add_(1.0)
        found = OnnxEngine(network, (8, 9))(images)
        assert len(exported(tmp_path)) == 2
        for path in exported(tmp_path):
            path.write_bytes(b"damaged")
        assert torch.allclose(OnnxEngine(network, (8, 9))(images)[0], found[0])
        assert torch.allclose(found[0], network(images), atol=1e-5)
        assert OnnxEngine(network, (8, 9))(images.double().float())[0].dtype == torch.float32


@pytest.mark.parametrize(
    ("runtime", "package"),
    [("onnxruntime", "onnxruntime"), ("openvino-bfloat16", "openvino")],
)
def test_without_the_library_it_says_what_to_do(
    monkeypatch: pytest.MonkeyPatch, runtime: Runtime, package: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(
        TensorsimError, match=f"--engine {package}: .*; install it with `pip install {package}`"
    ):
        OnnxPose(nn.Identity(), runtime)


def test_a_library_that_does_not_load_is_not_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    broken = "raise RuntimeError('libfast.so: \\n cannot be opened')"
    (tmp_path / "broken_engine.py").write_text(broken)
    monkeypatch.syspath_prepend(tmp_path)
    assert import_failure("broken_engine") == "libfast.so: cannot be opened"
    assert import_failure("math") is None


@pytest.mark.parametrize(
    "do", ["print(onnx_engine.import_failure('openvino'))", "import openvino; print(None)"]
)
def test_openvino_is_imported_without_its_telemetry(do: str) -> None:
    """Also in a process that only loads a pickled engine."""
    code = f"import sys; from tensorsim.vision import onnx_engine; {do};"
    code += "print([name for name, module in sys.modules.items() if 'openvino_telemetry' in name and module])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["None", "[]"]


@torch.no_grad()
def test_openvino_answers_several_threads_at_a_time() -> None:
    network = ts.vision.HRNet.from_pretrained()
    crops = torch.rand(6, 3, *network.input_size)
    engine = OnnxPose(network, "openvino")
    with ThreadPoolExecutor(3) as pool:
        found = torch.cat(list(pool.map(engine, crops.split(1))))
    assert torch.allclose(found, network(crops), atol=1e-4)


def test_first_calls_of_several_threads_in_openvino_end() -> None:
    # In a process of its own, because only the first calls of a process can block each other.
    script = """
import sys, threading
from concurrent.futures import ThreadPoolExecutor
import numpy as np
from torch import nn
from tensorsim.vision.onnx_engine import _opened
run, together = _opened(nn.Conv2d(3, 4, 3), (8, 9), "openvino", 8), threading.Barrier(8)
def first(images):
    together.wait()
    return run(images)
sys.setswitchinterval(1e-6)
with ThreadPoolExecutor(8) as pool:
    list(pool.map(first, np.zeros((8, 1, 3, 8, 9), np.float32)))
"""
    subprocess.run([sys.executable, "-c", script], check=True, timeout=60)


@torch.no_grad()
def test_in_bfloat16_keypoints_stay_where_they_are() -> None:
    network = ts.vision.HRNet.from_pretrained()
    crops = rendered_crops(network.input_size, people=3, seed=100)
    plain, found = network(crops), OnnxPose(network, "openvino-bfloat16")(crops)
    off = float((found - plain).abs().max()) / float(plain.abs().max())
    assert off < 0.05
    # On processors without instructions for bfloat16 it is in float32.
    assert (off > 1e-4) == multiplies_bfloat16(torch.device("cpu"))
    decode = HeatmapDecoder()
    (expected, scores), (points, _) = decode(plain), decode(found)
    away = (points - expected).norm(dim=-1)[scores > 0.3]
    assert away.median() < 0.1
    assert away.quantile(0.98) < 0.5


@torch.no_grad()
def test_in_8_bits_keypoints_stay_where_they_are(tmp_path: Path) -> None:
    network = ts.vision.HRNet.from_pretrained()
    # Other people than those whose ranges were taken.
    crops = rendered_crops(network.input_size, people=2, seed=100)
    plain, small = network(crops), OnnxPose(network, "int8")(crops)
    decode = HeatmapDecoder()
    (expected, scores), (found, _) = decode(plain), decode(small)
    away = (found - expected).norm(dim=-1)[scores > 0.3]
    assert away.quantile(0.9) < 0.5
    assert float((small - plain).abs().max()) > 1e-3  # it is another network
    assert [path.stat().st_size < 5e6 for path in exported(tmp_path)] == [True]
    OnnxPose(network)(crops[:1])
    assert len(exported(tmp_path)) == 2


def test_rendered_crops_show_people() -> None:
    crops = rendered_crops((64, 48), people=2, poses=3)
    assert crops.shape[1:] == (3, 64, 48)
    assert 2 <= crops.shape[0] <= 6
    assert crops.min() >= 0
    assert crops.max() <= 1
    assert torch.equal(crops, rendered_crops((64, 48), people=2, poses=3))
    assert not torch.equal(crops[0], crops[-1])
