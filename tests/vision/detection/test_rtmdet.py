"""RTMDet: published keys, closed-form decoding, weight files, parity with ONNX Runtime on real pictures."""

import json
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tensorsim.errors import TensorsimError
from tensorsim.vision.detection.rtmdet import RTMDet
from tensorsim.vision.detection.rtmdet_layers import RTMDET_SIZES
from tensorsim.weights import save_weights
from tests.stage import StageTester, assert_same

# Parameters and state-dict entries of the published networks (those of x follow from the size table).
PUBLISHED = {
    "nano-person": (994_423, 698),
    "tiny": (4_896_168, 476),
    "s": (8_886_924, 512),
    "m": (24_709_188, 692),
    "l": (52_315_804, 872),
    "x": (94_855_572, 1052),
    "m-person": (24_663_447, 692),
}
#: Counts of our own, golden from here on.
OURS = {"small-person": (2_174_775, 476)}


def enliven(detector: RTMDet, seed: int = 0) -> RTMDet:
    """Random statistics, and a head that finds things: fresh weights find nothing anywhere."""
    generator = torch.Generator().manual_seed(seed)
    for module in detector.modules():
        if isinstance(module, nn.BatchNorm2d):
            for tensor in (module.weight.data, module.running_var):
                tensor.copy_(torch.rand(tensor.shape, generator=generator) + 0.5)
            for tensor in (module.bias.data, module.running_mean):
                tensor.copy_(torch.randn(tensor.shape, generator=generator) * 0.1)
        elif isinstance(module, nn.Conv2d):
            spread = module.weight[0].numel() ** -0.5
            module.weight.data.copy_(torch.randn(module.weight.shape, generator=generator) * spread * 1.5)
            if module.bias is not None:
                module.bias.data.zero_()
    for i in range(3):
        detector.bbox_head.rtm_cls[i].weight.data.mul_(5.0)  # scores far apart
        detector.bbox_head.rtm_cls[i].bias.data.fill_(-1.0)
        detector.bbox_head.rtm_reg[i].bias.data.fill_(0.3 if detector.exp_on_reg else 1.5)
    return detector.eval()


def pictures(batch: int, height: int, width: int, seed: int = 0) -> Tensor:
    """Seeded uint8 images with structure at several scales."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.zeros(batch, 3, height, width)
    for cells in (2, 5, 11):
        noise = torch.rand(batch, 3, cells, cells, generator=generator)
        x = x + nn.functional.interpolate(noise, size=(height, width), mode="bilinear")
    return (x * 85).to(torch.uint8)


class TestRTMDet(StageTester):
    batch_shapes = ((3,),)
    gradient_arguments = ()  # images are rounded to 8 bits; `dense` has its own test below

    def make(self) -> nn.Module:
        settings = {"score_threshold": 0.5, "nms_iou": 0.25, "max_detections": 8, "input_size": 64}
        return enliven(RTMDet("nano-person", **settings))

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        return (pictures(batch[0], 50, 70).to(dtype) / 255,)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        good = pictures(1, 50, 70) / 255
        return [
            ((good[0],), r"images: got shape \[3, 50, 70\], expected \(B, 3, H, W\)"),
            ((good[:, :1],), r"images: got shape \[1, 1, 50, 70\], expected \(B, 3, H, W\)"),
            ((good[:0],), "images: got an empty tensor"),
            ((good[..., :0],), "images: got an empty tensor"),
            ((good.long(),), "images: got dtype"),
            ((good * 255,), r"images: got values from .* expected RGB in \[0, 1\]"),
            ((good.where(good > 0.5, float("nan")),), r"expected RGB in \[0, 1\]"),
            ((good - 2,), r"expected RGB in \[0, 1\]"),
        ]

    def test_the_inputs_say_something(self) -> None:
        with torch.no_grad():
            found = self.make()(*self.inputs((3,), torch.float32))
        assert found.valid.any(1).all()
        assert not found.valid.all()

    def test_scripted_refuses_with_the_same_words(self) -> None:
        scripted = torch.jit.script(self.make())
        for args, message in self.bad_inputs():
            with pytest.raises(torch.jit.Error, match=message):
                scripted(*args)

    def test_scripted_takes_other_sizes_without_tensorsim(self, tmp_path: Path) -> None:
        module, images = self.make(), pictures(2, 90, 40)
        torch.jit.script(module).save(str(tmp_path / "detector.pt"))
        torch.save((images, tuple(module(images))), tmp_path / "expected.pt")
        program = (
            "import sys, torch\n"
            "images, expected = torch.load('expected.pt')\n"
            "for a, b in zip(torch.jit.load('detector.pt')(images), expected, strict=True):\n"
            "    torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-4)\n"
            "assert expected[3].any() and 'tensorsim' not in sys.modules\n"
        )
        subprocess.run([sys.executable, "-W", "ignore", "-c", program], cwd=tmp_path, check=True)

    @pytest.mark.slow
    def test_exports(self) -> None:  # with a dynamic batch
        module = self.make()
        (images,) = self.inputs((3,), torch.float32)
        batch = torch.export.Dim("batch", min=1, max=16)
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            program = torch.export.export(module, (images,), dynamic_shapes=({0: batch},)).module()
            assert_same(program(images), module(images), atol=1e-6)
            assert_same(program(images[:2]), module(images[:2]), atol=1e-6)

    def test_bytes_equal_floats(self) -> None:
        images = pictures(3, 50, 70)
        with torch.no_grad():
            assert_same(self.make()(images), self.make()(images / 255))

    def test_takes_values_up_to_half_a_range_outside(self) -> None:
        """Interpolation overshoots; what goes further is no RGB in [0, 1]."""
        module, images = self.make(), torch.zeros(1, 3, 8, 8)
        for value, refused in ((1.5, 1.5625), (-0.5, -0.5625)):
            images[0, 0, 0, 0] = value
            assert module.preprocess(images).shape == (1, 3, 64, 64)
            images[0, 0, 0, 0] = refused
            with pytest.raises(TensorsimError, match=f"got values from .*{refused}.* expected RGB"):
                module.preprocess(images)

    def test_dense_is_differentiable(self) -> None:
        module = self.make().double()
        x = torch.randn(1, 3, 32, 32, dtype=torch.float64, requires_grad=True)

        def dense(x: Tensor) -> tuple[Tensor, ...]:
            logits, distances = module.dense(x)
            return (*logits, *distances)

        assert torch.autograd.gradcheck(dense, (x,), fast_mode=True)


# ---- the published networks ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fresh() -> dict[str, RTMDet]:
    with torch.device("meta"):
        return {variant: RTMDet(variant).eval() for variant in RTMDET_SIZES}


@pytest.mark.parametrize("variant", RTMDET_SIZES)
def test_counts_are_the_published_ones(fresh: dict[str, RTMDet], variant: str) -> None:
    detector = fresh[variant]
    counts = sum(p.numel() for p in detector.parameters()), len(detector.state_dict())
    assert counts == (PUBLISHED | OURS)[variant]


@pytest.mark.parametrize("variant", [v for v in PUBLISHED if v != "x"])
def test_keys_and_shapes_are_the_published_ones(
    fresh: dict[str, RTMDet], variant: str, shared_data: Path
) -> None:
    manifest = shared_data.parent / "specs" / f"keys_rtmdet_{variant.replace('-', '_')}.tsv"
    expected = dict(line.split("\t") for line in manifest.read_text().splitlines())
    shapes = {k: "x".join(map(str, v.shape)) or "scalar" for k, v in fresh[variant].state_dict().items()}
    assert shapes == expected


@pytest.mark.parametrize("variant", RTMDET_SIZES)
def test_batch_norm_is_that_of_the_configurations(fresh: dict[str, RTMDet], variant: str) -> None:
    norms = [m for m in fresh[variant].modules() if isinstance(m, nn.BatchNorm2d)]
    assert {(m.eps, m.momentum) for m in norms} == {(1e-5, 0.1)}


@pytest.mark.parametrize("variant", RTMDET_SIZES)
def test_levels_share_convolutions_and_not_norms(fresh: dict[str, RTMDet], variant: str) -> None:
    head = fresh[variant].bbox_head
    for towers in (head.cls_convs, head.reg_convs):
        if variant == "nano-person":
            assert towers[0][0].depthwise_conv.conv is not towers[1][0].depthwise_conv.conv
        else:
            assert towers[0][1].conv is towers[1][1].conv is towers[2][1].conv
            assert towers[0][1].bn is not towers[1][1].bn
    if variant != "nano-person":
        assert head.cls_convs[0][0].conv is not head.reg_convs[0][0].conv


@pytest.mark.parametrize(
    ("variant", "exponent"),
    [(v, v in ("m", "l", "x", "m-person", "small-person")) for v in RTMDET_SIZES],
)
def test_distances_of_a_variant(fresh: dict[str, RTMDet], variant: str, exponent: bool) -> None:
    detector, raw = fresh[variant], torch.full((1, 4, 1, 1), 2.0)

    class Constant(nn.Module):
        def forward(self, x: Any) -> Any:
            return [raw] * 3, [raw] * 3

    head, detector.bbox_head = detector.bbox_head, Constant()
    try:
        _, distances = detector.dense(torch.zeros(1, 3, 32, 32, device="meta"))
    finally:
        detector.bbox_head = head
    value = float(np.exp(2.0)) if exponent else 2.0
    assert [float(d[0, 0]) for d in distances] == pytest.approx([8 * value, 16 * value, 32 * value])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"variant": "nano"}, "variant: got 'nano', expected one of nano-person, small-person, tiny"),
        ({"score_threshold": -0.1}, "score_threshold: got -0.1"),
        ({"score_threshold": float("nan")}, "score_threshold: got nan"),
        ({"nms_iou": 1.5}, "nms_iou: got 1.5"),
        ({"max_detections": 0}, "max_detections: got 0"),
        ({"nms_pre": 0}, "nms_pre: got 0"),
        ({"input_size": 100}, "input_size: got 100, expected a positive multiple of 32"),
        ({"input_size": 0}, "input_size: got 0"),
    ],
)
def test_refuses_settings(options: dict[str, Any], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        RTMDet(**options)


def test_default_settings_follow_the_variant(fresh: dict[str, RTMDet]) -> None:
    def settings(d: RTMDet) -> tuple[float, ...]:
        return d.score_threshold, d.nms_iou, d.max_detections, d.nms_pre, d.input_size

    assert settings(fresh["nano-person"]) == (0.05, 0.6, 100, 1000, 320)
    assert settings(fresh["m-person"]) == (0.05, 0.6, 100, 1000, 640)
    assert settings(fresh["tiny"]) == (0.001, 0.65, 300, 30000, 640)


# ---- conventions of input and decoding -------------------------------------------------------------------


def test_the_network_sees_normalised_bgr() -> None:
    detector = RTMDet(input_size=64)
    image = torch.zeros(1, 3, 64, 32, dtype=torch.uint8)
    image[:, 0], image[:, 1], image[:, 2] = 10, 20, 30  # red, green, blue
    x = detector.preprocess(image)
    blue_green_red = [(30 - 103.53) / 57.375, (20 - 116.28) / 57.12, (10 - 123.675) / 58.395]
    padding = [(114 - 103.53) / 57.375, (114 - 116.28) / 57.12, (114 - 123.675) / 58.395]
    assert x[0, :, 5, 5].tolist() == pytest.approx(blue_green_red, rel=1e-5)
    assert x[0, :, 5, 40].tolist() == pytest.approx(padding, rel=1e-5)


def quiet(classes: int, side: int = 320) -> tuple[list[Tensor], list[Tensor]]:
    """Dense predictions of nothing, to be written into."""
    sizes = [side // stride for stride in (8, 16, 32)]
    return [torch.full((1, classes, n, n), -20.0) for n in sizes], [torch.ones(1, 4, n, n) for n in sizes]


def test_select_decodes_one_cell() -> None:
    detector = RTMDet()
    logits, distances = quiet(1)
    logits[1][0, 0, 3, 5] = 1.0  # stride 16, row 3, column 5: the point (80, 48)
    distances[1][0, :, 3, 5] = torch.tensor([8.0, 16.0, 24.0, 32.0])
    found = detector.select(logits, distances, 320, 640)  # letterboxed by one half
    assert found.valid[0].tolist() == [True] + [False] * 99
    assert found.boxes[0, 0].tolist() == [144, 64, 208, 160]
    assert float(found.scores[0, 0]) == pytest.approx(1 / (1 + np.exp(-1.0)))
    assert (found.boxes[0, 1:] == 0).all()
    assert (found.scores[0, 1:] == 0).all()


def test_select_clips_and_drops_boxes_turned_inside_out() -> None:
    detector = RTMDet()
    logits, distances = quiet(1)
    logits[2][0, 0, 0, 0], logits[2][0, 0, 9, 9] = 2.0, 1.0
    distances[2][0, :, 0, 0] = torch.tensor([50.0, 50.0, 40.0, 400.0])
    distances[2][0, :, 9, 9] = torch.tensor([-5.0, 10.0, 5.0, 10.0])  # no width
    found = detector.select(logits, distances, 320, 320)
    assert found.valid[0].sum() == 1
    assert found.boxes[0, 0].tolist() == [0, 0, 40, 320]


def test_select_is_multi_label_and_suppresses_per_class() -> None:
    detector = RTMDet("tiny", input_size=320, score_threshold=0.3)
    logits, distances = quiet(80)
    for cell, label, score in [(0, 7, 3.0), (0, 2, 2.0), (1, 7, 1.0), (2, 5, -3.0)]:
        logits[0][0, label, 10, 10 + cell] = score
        distances[0][0, :, 10, 10 + cell] = 60.0
    found = detector.select(logits, distances, 320, 320)
    assert found.labels[0][found.valid[0]].tolist() == [7, 2]
    assert found.boxes[0, 0].tolist() == found.boxes[0, 1].tolist() == [20, 20, 140, 140]


def test_settings_limit_the_detections() -> None:
    images = pictures(2, 60, 60)

    def count(**options: Any) -> int:
        settings = {"score_threshold": 0.25, "nms_iou": 0.6, "input_size": 64, **options}
        return int(enliven(RTMDet("nano-person", **settings))(images).valid.sum())

    everything = count()
    assert count(max_detections=2) <= 4 < everything
    assert count(nms_pre=1) <= 6 < everything
    assert count(nms_iou=0.1) < everything
    assert count(score_threshold=0.9) < everything


# ---- weight files ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", ["nano-person", "tiny"])
@pytest.mark.parametrize("kind", ["pth", "safetensors", "safetensors model", "onnx"])
def test_from_pretrained_restores_the_network(tmp_path: Path, variant: str, kind: str) -> None:
    from safetensors.torch import save_file, save_model

    detector, path = enliven(RTMDet(variant)), tmp_path / f"weights.{kind.split()[0]}"
    state = detector.state_dict()
    if kind == "pth":
        extra = {"data_preprocessor.mean": torch.zeros(3, 1, 1), "data_preprocessor.std": torch.ones(3, 1, 1)}
        torch.save({"meta": {}, "state_dict": {**state, **extra}}, path)
    elif kind == "safetensors":
        save_file({key: value.clone() for key, value in state.items()}, path)
    elif kind == "safetensors model":  # stores a shared tensor once
        save_model(detector, str(path))
    else:
        save_onnx(detector, path)
    loaded = RTMDet.from_pretrained(path, nms_iou=0.7)
    assert loaded.variant == variant
    assert not loaded.training
    assert loaded.nms_iou == 0.7
    x = torch.randn(2, 3, 64, 96)
    with torch.no_grad():
        assert_same(loaded.dense(x), detector.dense(x), atol=1e-5 if kind == "onnx" else 0.0)


def save_onnx(detector: RTMDet, path: Path) -> None:
    """Through torch's tracing exporter, as mmdeploy does: it folds batch norms and renames what it folds."""
    pytest.importorskip("onnx")

    class Dense(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.backbone, self.neck, self.bbox_head = detector.backbone, detector.neck, detector.bbox_head

        def forward(self, x: Tensor) -> tuple[list[Tensor], list[Tensor]]:
            return self.bbox_head(self.neck(self.backbone(x)))

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter is deprecated upstream
        torch.onnx.export(Dense().eval(), (torch.zeros(1, 3, 32, 32),), str(path), dynamo=False)


def test_from_pretrained_refuses_other_networks(tmp_path: Path) -> None:
    state = RTMDet().state_dict()
    with pytest.raises(TensorsimError, match="no such file"):
        RTMDet.from_pretrained(tmp_path / "missing.onnx")
    torch.save(state, tmp_path / "nano.pth")
    with pytest.raises(TensorsimError, match="not the weights of this RTMDet"):
        RTMDet.from_pretrained(tmp_path / "nano.pth", variant="tiny")
    with pytest.raises(TensorsimError, match="variant: got 'huge'"):
        RTMDet.from_pretrained(tmp_path / "nano.pth", variant="huge")
    torch.save({**state, "bbox_head.rtm_cls.0.weight": torch.zeros(7, 64, 1, 1)}, tmp_path / "seven.pth")
    with pytest.raises(TensorsimError, match="got 8 channels in the stem and 7 classes"):
        RTMDet.from_pretrained(tmp_path / "seven.pth")
    torch.save({"conv0.weight": torch.zeros(1)}, tmp_path / "other.pth")
    with pytest.raises(TensorsimError, match=r"got no backbone\.stem\.0"):
        RTMDet.from_pretrained(tmp_path / "other.pth")
    torch.save({k: v for k, v in state.items() if "out_convs.2" not in k}, tmp_path / "part.pth")
    with pytest.raises(TensorsimError, match=r"12 missing \(neck\.out_convs\.2\."):
        RTMDet.from_pretrained(tmp_path / "part.pth")
    save_weights(nn.Linear(1, 1), tmp_path / "pose.safetensors", {"input_size": "256x192"})
    with pytest.raises(
        TensorsimError, match=r"pose\.safetensors: got a file that cannot be read as weights of RTMDet"
    ):
        RTMDet.from_pretrained(tmp_path / "pose.safetensors")
    (tmp_path / "text.onnx").write_text("this is no network")
    with pytest.raises(TensorsimError, match="damaged or not an ONNX file"):
        RTMDet.from_pretrained(tmp_path / "text.onnx")


def test_from_pretrained_refuses_other_onnx_networks(tmp_path: Path, shared_data: Path) -> None:
    nano = shared_data / "weights" / "rtmdet_nano_person.onnx"
    with pytest.raises(TensorsimError, match="got 123 convolutions, expected"):
        RTMDet.from_pretrained(nano, variant="tiny")
    with pytest.raises(TensorsimError):
        RTMDet.from_pretrained(shared_data / "weights" / "simplepose_coco17_256x192.onnx")
    (tmp_path / "part.onnx").write_bytes(nano.read_bytes()[:2_000_000])
    with pytest.raises(TensorsimError, match="damaged or not an ONNX file"):
        RTMDet.from_pretrained(tmp_path / "part.onnx")


# ---- real pictures ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=[320, 640])
def real(request: pytest.FixtureRequest, shared_data: Path) -> tuple[RTMDet, Any, int]:
    """The published network here and in ONNX Runtime, at one input size."""
    runtime = pytest.importorskip("onnxruntime")
    path = shared_data / "weights" / "rtmdet_nano_person.onnx"
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1
    session = runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    return RTMDet.from_pretrained(path, input_size=request.param), session, request.param


def reference(session: Any, image: np.ndarray, side: int) -> np.ndarray:
    """(n, 5) boxes and scores by OpenCV, NumPy and ONNX Runtime; ``image`` is BGR uint8."""
    import cv2

    height, width = image.shape[:2]
    scale = min(side / height, side / width)
    new_height, new_width = int(height * scale + 0.5), int(width * scale + 0.5)
    canvas = np.full((side, side, 3), 114, np.uint8)
    canvas[:new_height, :new_width] = cv2.resize(image, (new_width, new_height))
    mean, std = np.array([103.53, 116.28, 123.675]), np.array([57.375, 57.12, 58.395])
    x = ((canvas - mean) / std).astype(np.float32).transpose(2, 0, 1)[None]
    found = session.run(["dets"], {"input": np.ascontiguousarray(x)})[0][0]
    found[:, [0, 2]] *= width / new_width
    found[:, [1, 3]] *= height / new_height
    return found


def detect(detector: RTMDet, image: np.ndarray) -> np.ndarray:
    """(n, 5) boxes and scores of a BGR uint8 image."""
    with torch.no_grad():
        found = detector(torch.from_numpy(image[..., ::-1].copy()).permute(2, 0, 1)[None])
    return torch.cat([found.boxes, found.scores.unsqueeze(-1)], -1)[found.valid].numpy()


def assert_parity(actual: np.ndarray, expected: np.ndarray) -> None:
    """Every detection above 0.3 of one is in the other: boxes within 0.1 pixel, scores within 0.001."""
    assert (actual[:, 4] > 0.3).sum() == (expected[:, 4] > 0.3).sum()
    for some, others in ((actual, expected), (expected, actual)):
        for detection in some[some[:, 4] > 0.3]:
            difference = np.abs(others - detection)
            assert ((difference[:, :4].max(1) < 0.1) & (difference[:, 4] < 1e-3)).any(), detection


def test_parity_with_onnx_runtime_on_photographs(real: tuple[RTMDet, Any, int], shared_data: Path) -> None:
    import cv2

    detector, session, side = real
    for path in sorted((shared_data / "coco" / "images").glob("*.jpg")):
        image = cv2.imread(str(path))
        assert_parity(detect(detector, image), reference(session, image, side))


def test_parity_with_onnx_runtime_on_videos(real: tuple[RTMDet, Any, int], shared_data: Path) -> None:
    import cv2

    detector, session, side = real
    videos = sorted((shared_data / "video").iterdir())
    assert len(videos) >= 5
    people = 0
    for path in videos:
        video = cv2.VideoCapture(str(path))
        for i in range(46):
            image = video.read()[1]
            if i % 15 == 0:
                actual = detect(detector, image)
                people += int((actual[:, 4] > 0.3).sum())
                assert_parity(actual, reference(session, image, side))
    assert people >= 15


def test_finds_every_annotated_person(real: tuple[RTMDet, Any, int], shared_data: Path) -> None:
    import cv2

    detector = real[0]
    annotations = json.loads((shared_data / "coco" / "test_coco.json").read_text())
    # Two of the 14 people are specks without a single annotated keypoint.
    people = [a for a in annotations["annotations"] if a["num_keypoints"] > 0]
    assert len(people) == 12
    names = {image["id"]: image["file_name"] for image in annotations["images"]}
    for person in people:
        found = detect(detector, cv2.imread(str(shared_data / "coco" / "images" / names[person["image_id"]])))
        x, y, width, height = person["bbox"]
        x1, y1 = np.maximum(found[:, 0], x), np.maximum(found[:, 1], y)
        x2, y2 = np.minimum(found[:, 2], x + width), np.minimum(found[:, 3], y + height)
        overlap = np.maximum(x2 - x1, 0) * np.maximum(y2 - y1, 0)
        area = (found[:, 2] - found[:, 0]) * (found[:, 3] - found[:, 1])
        iou = overlap / (area + width * height - overlap)
        assert iou[found[:, 4] > 0.3].max() > 0.5, person["id"]
