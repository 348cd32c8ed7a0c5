"""What is exported to ONNX gives the same in ONNX Runtime, also for other batch sizes."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from torch import Tensor, nn

import tensorsim as ts
from tensorsim.geometry.boxes import non_maximum_suppression
from tensorsim.recognition import SPGNet, SPNet
from tensorsim.recognition.map_image import MapToImage
from tensorsim.vision.lifting import pose_search
from tensorsim.vision.lifting.pose_library import load_pose_library
from tensorsim.vision.lifting.temporal_lifter import TemporalPose

#: Stages and inputs; the first dimension of the first input may have another size.
STAGES: dict[str, tuple[nn.Module, Tensor, Tensor]] = {
    "map to picture": (
        MapToImage.doppler(ts.RadarConfig.through_wall(), size=32),
        torch.rand(2, 256, 40),
        torch.rand(5, 256, 40),
    ),
    "light recogniser": (SPGNet(3), torch.rand(2, 1, 32, 32), torch.rand(5, 1, 32, 32)),
    "recogniser": (SPNet(3), torch.rand(2, 1, 64, 64), torch.rand(5, 1, 64, 64)),
    "denoiser": (ts.enhance.DnCNN(depth=3), torch.rand(2, 1, 32, 32), torch.rand(5, 1, 32, 32)),
    "ridges": (ts.radar.RidgeExtractor(3), torch.rand(2, 256, 20), torch.rand(5, 256, 20)),
    "moving target indicator": (
        ts.export.ComplexPairs(ts.radar.MovingTargetIndicator()),
        torch.randn(2, 64, 20, 2),
        torch.randn(5, 64, 20, 2),
    ),
    "range profiles": (
        ts.export.ComplexPairs(ts.radar.RangeProfile(ts.RadarConfig.through_wall(), gate_m=(0.5, 8.0))),
        torch.randn(2, 20, 400, 2),
        torch.randn(5, 20, 400, 2),
    ),
    "Doppler-time map": (
        ts.export.ComplexPairs(ts.radar.DopplerTimeMap(ts.RadarConfig.through_wall())),
        torch.randn(2, 64, 20, 2),
        torch.randn(5, 64, 20, 2),
    ),
    "Doppler-time map of magnitudes": (
        ts.export.ComplexPairs(ts.radar.DopplerTimeMap(ts.RadarConfig.through_wall(), integration="paper")),
        torch.randn(2, 64, 20, 2),
        torch.randn(5, 64, 20, 2),
    ),
}


class Lifting(nn.Module):
    """A lifter for pictures of 360x640 at 30 frames per second."""

    def __init__(self, lifter: ts.vision.TemporalLifter) -> None:
        super().__init__()
        self.lifter = lifter

    def forward(self, keypoints: Tensor, scores: Tensor, boxes: Tensor, valid: Tensor) -> TemporalPose:
        return self.lifter(keypoints, scores, boxes, valid, 360, 640, 30.0)  # type: ignore[no-any-return]


def tracks(clips: int) -> tuple[Tensor, ...]:
    """Keypoints, scores, boxes and validity of a person in 20 frames of each clip."""
    generator = torch.Generator().manual_seed(clips)
    keypoints = 100 + 100 * torch.rand(clips, 1, 20, 17, 2, generator=generator)
    boxes = torch.cat([keypoints.amin(-2), keypoints.amax(-2)], -1)
    valid = torch.rand(clips, 1, 20, generator=generator) > 0.2
    return keypoints, torch.rand(clips, 1, 20, 17, generator=generator), boxes, valid


def pictures(count: int) -> tuple[Tensor]:
    """A person who walks, in this many pictures."""
    walk = ts.motion.ActivityGenerator().generate("walking", seed=1, duration_s=0.1 * count, rate_hz=10.0)
    return (ts.data.PersonRenderer(height=120, width=160)(walk.joints[:1], seed=2).frames,)


def placed_poses(clips: int) -> tuple[Tensor, Tensor]:
    """Joints and weights of four frames of each clip: poses of the pool, not quite."""
    generator = torch.Generator().manual_seed(clips)
    poses = load_pose_library()[: 28 * clips : 7].reshape(clips, 4, 14, 3)
    joints = 200 * torch.stack([poses[..., 0], -poses[..., 2]], dim=-1)
    weights = torch.rand(clips, 4, 14, generator=generator)
    return joints + 2 * torch.randn(joints.shape, generator=generator), weights


#: Shipped networks of the vision part: what makes them, inputs for any number of pictures or clips.
VISION: dict[str, tuple[Callable[[], nn.Module], Callable[[int], tuple[Tensor, ...]]]] = {
    "detector": (lambda: ts.vision.RTMDet.from_pretrained(input_size=160), pictures),
    "pose": (ts.vision.HRNet.from_pretrained, lambda n: (torch.rand(n, 3, 256, 192),)),
    "lifter": (lambda: Lifting(ts.vision.TemporalLifter.from_pretrained()), tracks),
    "nearest poses": (lambda: ts.vision.NearestPoseLifter(load_pose_library()[::7]), placed_poses),
    "VideoPose3D": (ts.vision.VideoPose3D, lambda n: (torch.rand(n, 50, 17, 2),)),
}
#: Shares of candidates are exponentials of some hundred times the errors of their fits, which are rounded.
TOLERANCE = {"nearest poses": 5e-4}


def run(path: Path, *inputs: Tensor) -> list[np.ndarray]:
    session = onnxruntime.InferenceSession(path)
    names = [there.name for there in session.get_inputs()]
    fed = {name: x.numpy() for name, x in zip(names, inputs, strict=True)}
    return session.run(None, fed)  # type: ignore[no-any-return]


@pytest.mark.slow
@pytest.mark.parametrize("name", VISION)
def test_networks_of_the_vision_part(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pose_search, "EXPORTED", 30000)  # so that there are two parts
    make, inputs_for = VISION[name]
    torch.manual_seed(0)
    stage, example = make().eval(), inputs_for(2)
    ts.export.to_onnx(stage, tmp_path / "m.onnx", example, {k: {0: "batch"} for k in range(len(example))})
    for inputs in (example, inputs_for(3)):
        with torch.no_grad():
            expected = stage(*inputs)
        expected = (expected,) if isinstance(expected, Tensor) else expected
        assert expected[0].any(), "something to compare"
        for one, truth in zip(run(tmp_path / "m.onnx", *inputs), expected, strict=True):
            apart = np.abs(one.astype(np.float64) - truth.double().numpy()).max()
            bound = TOLERANCE.get(name, 1e-5) * max(1.0, float(truth.double().abs().max()))
            assert apart < (bound if truth.is_floating_point() else 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", STAGES)
def test_onnx_runtime_gives_the_same(name: str, tmp_path: Path) -> None:
    stage, example, other = STAGES[name]
    stage.eval()
    ts.export.to_onnx(stage, tmp_path / "m.onnx", (example,), {0: {0: "batch"}})
    assert [path.name for path in tmp_path.iterdir()] == ["m.onnx"]
    for x in (example, other):
        with torch.no_grad():
            expected = stage(x)
        expected = (expected,) if isinstance(expected, Tensor) else expected
        for one, truth in zip(run(tmp_path / "m.onnx", x), expected, strict=True):
            # The Fourier transform of ONNX Runtime is not a fast one, and rounds more.
            assert np.abs(one - truth.numpy()).max() < 5e-5 * max(1.0, float(truth.abs().max()))


@pytest.mark.slow
def test_what_onnx_cannot_express_is_said_in_one_line(tmp_path: Path) -> None:
    stage = ts.export.ComplexPairs(ts.radar.RangeDopplerVideo(ts.RadarConfig.through_wall())).train()
    with pytest.raises(
        ts.TensorsimError, match="to_onnx: got a ComplexPairs that ONNX cannot express"
    ) as refused:
        ts.export.to_onnx(stage, tmp_path / "m.onnx", (torch.randn(1, 64, 20, 2),))
    assert "\n" not in str(refused.value)
    assert stage.training
    assert not list(tmp_path.iterdir())


def test_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ts.TensorsimError, match="is a folder, expected a file"):
        ts.export.to_onnx(nn.Linear(1, 1), tmp_path, (torch.zeros(1, 1),))


def test_a_dynamic_dimension_needs_two(tmp_path: Path) -> None:
    with pytest.raises(ts.TensorsimError, match="got 1 for the dynamic dimension batch, expected at least 2"):
        ts.export.to_onnx(nn.Linear(1, 1), tmp_path / "m.onnx", (torch.zeros(1, 1),), {0: {0: "batch"}})


def test_an_example_is_a_tuple_and_has_the_dynamic_dimensions(tmp_path: Path) -> None:
    linear, example = nn.Linear(2, 2), torch.zeros(3, 2)
    with pytest.raises(ts.TensorsimError, match="got a tensor as example, expected a tuple of the inputs"):
        ts.export.to_onnx(linear, tmp_path / "m.onnx", example)  # type: ignore[arg-type]
    for dynamic in ({1: {0: "batch"}}, {0: {2: "batch"}}, {0: {-2: "batch"}}):
        with pytest.raises(
            ts.TensorsimError, match=r"dimension -?\d of input \d for batch, expected one of the example"
        ):
            ts.export.to_onnx(linear, tmp_path / "m.onnx", (example,), dynamic)


def test_pairs_stand_for_complex_numbers() -> None:
    x = torch.randn(2, 64, 20, dtype=torch.complex64)
    mti = ts.radar.MovingTargetIndicator()
    pairs = ts.export.ComplexPairs(mti)(torch.view_as_real(x))
    assert torch.view_as_complex(pairs).equal(mti(x))


class Suppression(nn.Module):
    """Boxes of three classes without their duplicates."""

    def forward(self, boxes: Tensor, scores: Tensor, labels: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        return non_maximum_suppression(boxes, scores, labels, valid, 0.5, 12)


def many_boxes(pictures: int) -> tuple[Tensor, ...]:
    """Boxes, scores (with equal ones), classes and validity; the last picture has none."""
    generator = torch.Generator().manual_seed(pictures)
    corner = 50 * torch.rand(pictures, 80, 2, generator=generator)
    boxes = torch.cat([corner, corner + 5 + 40 * torch.rand(pictures, 80, 2, generator=generator)], -1)
    scores = torch.randint(1, 40, (pictures, 80), generator=generator) / 40
    valid = torch.rand(pictures, 80, generator=generator) > 0.2
    valid[-1] = False
    return boxes, scores, torch.randint(0, 3, (pictures, 80), generator=generator), valid


@pytest.mark.slow
def test_duplicates_of_several_classes_are_suppressed(tmp_path: Path) -> None:
    dynamic = {k: {0: "batch"} for k in range(4)}
    ts.export.to_onnx(Suppression(), tmp_path / "m.onnx", many_boxes(2), dynamic)
    for inputs in (many_boxes(2), many_boxes(4)):
        index, found = run(tmp_path / "m.onnx", *inputs)
        expected, there = (x.numpy() for x in Suppression()(*inputs))
        assert (found == there).all()
        assert found[0].sum() == 12
        assert not found[-1].any()
        assert (index[found] == expected[there]).all()
