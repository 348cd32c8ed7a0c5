"""Every stage refuses what it cannot use: types, layouts, dtypes, values; quickly."""

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import tensorsim as ts
from tensorsim.body.skeleton import body_to_coco
from tensorsim.errors import (
    TensorsimError,
    check_choice,
    check_count,
    check_finite,
    check_mask,
    check_positive,
    check_shape,
    check_tensor,
)
from tensorsim.vision.lifting.videopose3d import VideoPose3D

RADAR = ts.RadarConfig.through_wall()
IF = torch.randn(64, RADAR.samples_per_chirp, dtype=torch.complex64)
PROFILES = torch.randn(64, 20, dtype=torch.complex64)
BODIES, FADE = torch.randn(2, 8, 14, 3), torch.ones(2, 8)

#: Stages by name: a call with one argument, and what it usually gets.
STAGES: dict[str, tuple[Callable[[Any], Any], Tensor]] = {
    "RangeProfile": (ts.radar.RangeProfile(RADAR), IF),
    "MovingTargetIndicator": (ts.radar.MovingTargetIndicator("mean"), PROFILES),
    "DopplerTimeMap": (ts.radar.DopplerTimeMap(RADAR), PROFILES),
    "ReceiverNoise": (ts.radar.ReceiverNoise(10.0), IF),
    "RidgeExtractor": (ts.radar.RidgeExtractor(), torch.rand(32, 5)),
    "EchoSynthesizer": (lambda x: ts.radar.EchoSynthesizer(RADAR)(x, torch.ones(2)), torch.ones(4, 2, 3)),
    "JointScatterers": (lambda x: ts.motion.JointScatterers()(x, FADE), BODIES),
    "Body13Scatterers": (lambda x: ts.motion.Body13Scatterers()(x, FADE), BODIES),
    "LimbScatterers": (lambda x: ts.motion.LimbScatterers(RADAR.tx_m, RADAR.rx_m)(x, FADE), BODIES),
    "Shadowing": (
        lambda x: ts.motion.Shadowing(ts.motion.JointScatterers(), RADAR.tx_m, RADAR.rx_m)(x, FADE), BODIES,
    ),
    "PoseResampler": (lambda x: ts.motion.PoseResampler(100.0)(x, 30.0), torch.randn(6, 14, 3)),
    "HRNet": (ts.vision.HRNet(18).eval(), torch.rand(1, 3, 64, 64)),
    "DnCNN": (ts.enhance.DnCNN(depth=2, channels=1).eval(), torch.rand(1, 8, 8)),
    "VideoPose3D": (VideoPose3D((3,), 8).eval(), torch.randn(4, 17, 2)),
    "SPGNet": (ts.recognition.SPGNet().eval(), torch.rand(1, 1, 32, 32)),
    "body_to_coco": (body_to_coco, torch.randn(14, 3)),
}  # fmt: skip

WRONG: dict[str, Callable[[Tensor], Any]] = {
    "nothing": lambda x: None,
    "text": lambda x: "positions",
    "a list": lambda x: x.tolist(),
    "a number": lambda x: 1.0,
    "an array": lambda x: x.numpy(),
    "a meta tensor": lambda x: x.to("meta"),
    "a sparse tensor": lambda x: x.to_sparse(),
    "integers": lambda x: torch.zeros(x.shape, dtype=torch.int64),
    "another kind": lambda x: x.real if x.is_complex() else x + 0j,
    "too few dimensions": lambda x: x.flatten()[0],
    "NaN": lambda x: torch.where(torch.arange(x.numel()).view(x.shape) == 3, torch.nan, x),
    "infinity": lambda x: torch.where(torch.arange(x.numel()).view(x.shape) == 3, torch.inf, x),
}


@pytest.mark.parametrize("stage", STAGES)
def test_stages_refuse_in_our_words(stage: str) -> None:
    run, usual = STAGES[stage]
    with torch.no_grad():
        run(usual)
        for name, change in WRONG.items():
            with pytest.raises(TensorsimError, match="got"):
                pytest.fail(f"{stage} took {name}: {run(change(usual))}")


def test_arrays_get_a_hint() -> None:
    with pytest.raises(
        TensorsimError, match=r"got ndarray, expected a tensor, as torch\.from_numpy gives it"
    ):
        ts.radar.RangeProfile(RADAR)(IF.numpy())


def test_shapes_and_masks_are_of_tensors() -> None:
    for check in (check_shape, check_mask):
        for other in (None, np.zeros(3)):
            with pytest.raises(TensorsimError, match=r"scores: got (NoneType|ndarray), expected a tensor"):
                check(other, [3], "scores")


def test_conjugates_and_half_precision() -> None:
    with pytest.raises(TensorsimError, match=r"expected x\.resolve_conj\(\)"):
        ts.radar.RangeProfile(RADAR)(IF.conj())
    with pytest.raises(TensorsimError, match=r"got dtype torch\.float16, expected .* float32 or float64"):
        ts.motion.JointScatterers()(BODIES.half(), FADE)
    with pytest.raises(TensorsimError, match=r"got torch\.float64 on cpu, expected torch\.float32 on cpu"):
        ts.vision.HRNet(18)(torch.rand(1, 3, 64, 64, dtype=torch.float64))


@pytest.mark.parametrize(
    ("layout", "fitting", "unfit"),
    [
        ("(..., M, 14 joints, 3) metres", [(1, 14, 3), (2, 5, 14, 3)], [(14, 3), (1, 14, 2), (1, 13, 3), ()]),
        ("(N, 3, H, W)", [(1, 3, 2, 2)], [(3, 2, 2), (1, 1, 3, 2, 2), (1, 4, 2, 2)]),
        ("(..., T)", [(0,), (2, 3)], [()]),
    ],
)
def test_layouts_are_read_as_written(
    layout: str, fitting: list[tuple[int, ...]], unfit: list[tuple[int, ...]]
) -> None:
    scripted = torch.jit.script(check_tensor)
    for check in (check_tensor, scripted):
        for shape in fitting:
            check(torch.zeros(shape), "x", layout)
        for shape in unfit:
            with pytest.raises(Exception, match="x: got shape"):
                check(torch.zeros(shape), "x", layout)
        with pytest.raises(Exception, match="x: got NaN or infinite values"):
            check(torch.full(fitting[-1], torch.nan), "x", layout)
        check(torch.full(fitting[-1], torch.nan), "x", layout, finite=False)


def test_large_finite_values_pass() -> None:
    check_finite(torch.full((10,), 3e38), "x")
    check_finite(torch.tensor([3e38, 3e38, -1.0]), "x")
    for bad in ([3e38, 3e38, torch.inf], [torch.inf, -torch.inf], [torch.nan, 0.0]):
        with pytest.raises(TensorsimError, match="x: got NaN or infinite values"):
            check_finite(torch.tensor(bad), "x")


def test_counts_without_end_are_refused_at_once() -> None:
    start = time.process_time()
    for make in (
        lambda: ts.enhance.DnCNN(depth=10**25),
        lambda: ts.enhance.DnCNN(channels=10**25),
        lambda: ts.radar.PathRidgeExtractor(count=10**25),
        lambda: ts.radar.PathRidgeExtractor(max_jump=10**25),
    ):
        with pytest.raises(TensorsimError, match="got"):
            make()
    assert time.process_time() - start < 1.0


def test_positive_numbers_are_numbers() -> None:
    for number in (3, 0.5, np.float32(2), np.int64(2), np.float64(2), np.array(2.0), torch.tensor(2.0)):
        check_positive(number, "x")
    for value in ("50", None, True, np.bool_(True), torch.tensor(True), [1.0], np.ones(2), 1j, torch.ones(2)):
        with pytest.raises(TensorsimError, match=r"(?s)^x: got .*, expected a positive finite number$"):
            check_positive(value, "x")  # type: ignore[arg-type]
    for number in (0, -1.0, math.inf, math.nan, np.float32("nan"), torch.tensor(-1.0)):
        with pytest.raises(TensorsimError, match=r"^x: got .*, expected a positive finite number$"):
            check_positive(number, "x")
    with pytest.raises(TensorsimError, match=r"^x: got '50', expected"):
        check_positive("50", "x")  # type: ignore[arg-type]


def test_choices_are_names() -> None:
    check_choice("a", {"a": 1}, "x")
    for value in ("c", None, 1, ["a"]):
        with pytest.raises(TensorsimError, match=r"^x: got .*, expected one of a, b$"):
            check_choice(value, {"a": 1, "b": 2}, "x")


def test_counts_are_integers_and_become_pythons() -> None:
    assert type(check_count(np.int64(3), "x", 3, 3)) is int
    for value in (True, 2.5, "2", 0, np.bool_(True), math.nan):
        with pytest.raises(TensorsimError, match=r"^x: got .*, expected an integer of at least 1$"):
            check_count(value, "x")
    with pytest.raises(TensorsimError, match=r"^x: got 7, expected an integer from 2 to 6$"):
        check_count(7, "x", 2, 6)
