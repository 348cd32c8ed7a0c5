"""Every shipped stage fits its slot; what does not fit is refused with a sentence."""

import inspect
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import tensorsim as ts
from tensorsim.protocols import SLOTS, check_detections, check_part, is_pose_estimator
from tensorsim.types import Detections

SHIPPED = [
    ("detector", lambda: ts.vision.RTMDet("tiny")),
    ("tracker", ts.vision.GNNTracker),
    ("pose", lambda: ts.vision.TopDownPose(ts.vision.HRNet(18))),
    ("network", lambda: ts.vision.HRNet(18)),
    ("lifter", ts.vision.NearestPoseLifter),
    ("smoother", ts.vision.KalmanSmoother),
    ("scatterers", ts.motion.JointScatterers),
    ("scatterers", lambda: ts.motion.LimbScatterers((0.0, 0.0, 1.0), (0.1, 0.0, 1.0))),
    ("scatterers", ts.motion.Body13Scatterers),
    ("denoiser", lambda: ts.enhance.MapDenoiser(ts.enhance.DnCNN(3))),
    (
        "recognizer",
        lambda: ts.recognition.ActivityRecognizer(ts.RadarConfig.free_space(), ts.recognition.SPNet()),
    ),
]


@pytest.mark.parametrize(("slot", "make"), SHIPPED, ids=lambda value: value if isinstance(value, str) else "")
def test_shipped_stages_fit(slot: str, make: Any) -> None:
    part = make()
    assert check_part(part, slot) is part
    scripted = torch.jit.script(part)
    assert check_part(scripted, slot) is scripted


def test_every_slot_has_a_shipped_stage_and_a_docstring() -> None:
    assert {slot for slot, _ in SHIPPED} == set(SLOTS)
    for protocol in SLOTS.values():
        assert protocol.__doc__
        assert inspect.getdoc(protocol.__call__)


class LikeTorchvision(nn.Module):
    """A detector with the annotations that those of torchvision have."""

    def forward(
        self, images: list[Tensor], targets: list[dict[str, Tensor]] | None = None
    ) -> tuple[dict[str, Tensor], list[dict[str, Tensor]]]:
        return {}, [{"boxes": images[0]}]


class Own(nn.Module):
    """Unannotated, so only the number of its arguments is known."""

    def forward(self, images, boxes, valid):  # type: ignore[no-untyped-def]
        return boxes, valid


@pytest.mark.parametrize(
    ("part", "slot", "message"),
    [
        (
            (nn.Identity(), 3),
            "detector",
            r"detector: got a tuple, expected a module called as detector\(images\)",
        ),
        (ts.vision.RTMDet, "detector", "got the class RTMDet, expected an instance"),
        (LikeTorchvision(), "detector", r"which returns tuple\[dict\[str, Tensor\], .* -> Detections"),
        (
            Own(),
            "detector",
            r"got Own\(images, boxes, valid\), expected a module called as detector\(images\)",
        ),
        (ts.motion.JointScatterers(), "denoiser", r"expected a module called as denoiser\(maps\) -> Tensor"),
        (ts.vision.KalmanSmoother(), "pose", r"which returns Tensor, .* -> tuple\[Tensor, Tensor\]"),
    ],
)
def test_wrong_parts_are_refused(part: Any, slot: str, message: str) -> None:
    with pytest.raises(ts.TensorsimError, match=message):
        check_part(part, slot)


def test_own_modules_pass_as_what_they_are_called_like() -> None:
    assert check_part(Own(), "pose")
    assert is_pose_estimator(Own())
    assert is_pose_estimator(ts.vision.TopDownPose(ts.vision.HRNet(18)))
    assert not is_pose_estimator(ts.vision.HRNet(18))
    assert check_part(nn.Sequential(nn.Conv2d(3, 17, 1)), "network")
    assert check_part(nn.Identity(), "detector")


def test_results_of_detectors_are_checked() -> None:
    check_detections(Detections(*torch.zeros(4, 1)))
    with pytest.raises(ts.TensorsimError, match="it returned a list of dict, expected Detections"):
        check_detections([{"boxes": torch.zeros(1, 4)}])
    with pytest.raises(ts.TensorsimError, match=r"boxes in torch\.float16, expected float32 or float64"):
        check_detections(Detections(*torch.zeros(4, 1).half()))
