"""The output of each shipped network for a fixed picture: a slip in a layer, an axis or a file shows here."""

import hashlib
from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

import tensorsim as ts
from tensorsim import registry
from tensorsim.recognition import SPGNet
from tensorsim.vision.detection.acf_features import aggregate_channels
from tests.networks import keypoints_to_lift


def wave(*shape: int) -> Tensor:
    """A picture in [0, 1] without a random generator: a sine whose frequency varies."""
    k = torch.arange(torch.Size(shape).numel(), dtype=torch.float64)
    return (0.5 + 0.5 * torch.sin(0.37 * k + 3 * torch.sin(0.0113 * k))).view(shape).float()


def detector_logits(network: ts.vision.RTMDet) -> Tensor:
    logits, distances = network.dense(network.preprocess(wave(1, 3, 96, 128)))
    return torch.cat([part.flatten()[::97] for part in (*logits, *distances)])


def tree_sums(network: ts.vision.AcfDetector) -> Tensor:
    network.cascade = -1e9  # every window passes
    channels = aggregate_channels(wave(1, 3, 144, 96))[0]
    corners = torch.tensor([24 * row + column for row in range(5) for column in (0, 4, 8)])
    return network.pass_cascade(channels, corners)[1]


#: The numbers of each class that are compared.
LOOK: dict[str, Callable[[torch.nn.Module], Tensor]] = {
    "SPGNet": lambda network: network(wave(1, 1, 32, 32)),
    "SPNet": lambda network: network(wave(1, 1, 64, 64)),
    "DnCNN": lambda network: network.noise(wave(24, 40)).flatten()[::96],  # type: ignore[operator]
    "DIATRadHARNet": lambda network: network(wave(1, 1, 32, 32)),
    "HRNet": lambda network: network(wave(1, 3, 64, 64)).flatten()[::443],
    "RTMDet": detector_logits,  # type: ignore[dict-item]
    "AcfDetector": tree_sums,  # type: ignore[dict-item]
    "VideoPose3D": lambda network: network(2 * wave(9, 17, 2) - 1).flatten()[::19],
    "CPM": lambda network: network(wave(1, 3, 64, 64)).flatten()[::43],
    "RangeRate": lambda stage: stage.network(4 * wave(1, 40, 102) - 2).flatten()[::7],  # type: ignore[operator, union-attr]
    "TemporalLifter": lambda lifter: lifter(*keypoints_to_lift(20)).joints.flatten()[::41],
}

#: First numbers and root mean square of all, by the first digits of the file's SHA-256.
EXPECTED: dict[str, tuple[list[float], float]] = {
    "0cb3d5256781bc55": ([-4.94989, -4.75653, -1.56357, -2.89981, -5.54331, -4.7583], 3.935),  # SPGNet
    "35b55ab8f8f7d4ee": ([-0.380488, 4.76282, 0.17326, -0.221057, -0.869639, -0.686033], 1.4774),  # SPNet
    "7a15296264b6a721": ([0.74892, 1.13028, 0.24339, 0.36871, 1.25796, 0.71812], 0.76663),  # DnCNN
    "75eaa2bcc250a341": ([-5.40386, -4.03063, -3.6764, -3.53946, -3.70424, -3.56611], 16.125),  # RTMDet
    "da7cf4552d24e8c3": ([-0.638164, 2.84223, -0.745937, -0.708206], 1.5446),  # DIATRadHARNet
    "e9b7667250ee4172": ([-0.0478059, 2.02712, 0.667224, -0.286124, -0.325381], 0.97411),  # DIATRadHARNet
    "de6eab974f533543": (
        [3.07035, -0.99288, -0.901084, -0.76005, -1.01738, -0.58401],
        1.482,
    ),  # DIATRadHARNet
    "582163bbda351c77": (
        [7.42362e-05, -0.888501, 0.0310593, -0.106276, -0.44495, 0.0878863],
        0.38585,
    ),  # TemporalLifter
    "e7324e970727521c": (
        [-1.4883, -1.50713, 1.26521, -0.705567, 1.9214, -0.542786],
        1.3274,
    ),  # RangeRate
    "5f5f7cebae014e45": (
        [0.00710835, -0.888452, 0.0814337, 0.185155, 0.0518079, -0.359967],
        0.49223,
    ),  # VideoPose3D
    "93748dc3d607aa66": (
        [0.0306699, 0.0346969, 0.0620893, 0.0761456, 0.0555329, 0.0548647],
        0.052116,
    ),  # CPM
    "58e51ecca587dec2": ([-6.42517, -5.66322, -6.21195, -6.08765, -5.14814, -4.02888], 5.2342),  # AcfDetector
    "8b568a3398249cdf": (
        [-0.0013377, -0.00151439, -0.00136878, -0.00206947, -0.00169849, -0.00174332],
        0.0016432,
    ),  # HRNet
}


@pytest.mark.parametrize(
    "entry", [entry for entry in registry.shipped() if entry.network], ids=lambda e: e.name
)
def test_outputs_are_those_of_the_file(entry: registry.ModelEntry) -> None:
    rooms = (ts.vision, ts.enhance, ts.recognition)
    (kind,) = (getattr(room, entry.network) for room in rooms if hasattr(room, entry.network))
    with torch.no_grad():
        values = LOOK[entry.network](kind.from_pretrained(entry.name)).double().flatten()
    digest = hashlib.sha256(entry.path.read_bytes()).hexdigest()[:16]
    first, rms = [float(f"{v:.6g}") for v in values[:6]], float(values.square().mean().sqrt())
    line = f'"{digest}": ({first}, {rms:.5g}),  # {entry.network}'
    assert digest in EXPECTED, (
        f"{entry.file} is new: once its card's figures are measured, add this line: {line}"
    )
    torch.testing.assert_close(
        torch.tensor([*first, rms]),
        torch.tensor([*EXPECTED[digest][0], EXPECTED[digest][1]]),
        rtol=2e-3,
        atol=2e-4 * rms,
    )


def test_no_values_of_files_that_are_gone() -> None:
    there = {hashlib.sha256(entry.path.read_bytes()).hexdigest()[:16] for entry in registry.shipped()}
    assert set(EXPECTED) <= there


def spgnet_by_hand(state: dict[str, Tensor], pictures: Tensor) -> Tensor:
    """SPGNet (s2p6) from its weights alone, written as the paper draws it."""

    def conv_norm(x: Tensor, name: str, stride: int = 1, groups: int = 1) -> Tensor:
        weight = state[f"{name}.0.weight"]
        x = F.conv2d(x, weight, None, stride, weight.shape[-1] // 2, groups=groups)
        scale = state[f"{name}.1.weight"] / torch.sqrt(state[f"{name}.1.running_var"] + 1e-5)
        shift = state[f"{name}.1.bias"] - state[f"{name}.1.running_mean"] * scale
        return x * scale[:, None, None] + shift[:, None, None]

    def two_levels(x: Tensor, name: str, stride: int, project: bool) -> Tensor:
        o1 = conv_norm(conv_norm(x, f"{name}.enter").relu(), f"{name}.first", stride, 6).relu()
        o2 = conv_norm(o1, f"{name}.second", 1, 6).relu()
        fused = conv_norm(torch.cat([o1, o2], 1), f"{name}.fuse")
        if stride == 2:
            shallow = conv_norm(x, f"{name}.skip.0", 2, x.shape[1])
            x = conv_norm(shallow, f"{name}.skip.1")
        elif project:
            x = conv_norm(x, f"{name}.skip")
        return (x + fused).relu()

    x = pictures - state["mean"][:, None, None]
    x = conv_norm(conv_norm(x, "body.0").relu(), "body.1").relu()
    index = 2
    for blocks in (4, 8, 3):
        for block in range(blocks):
            x = two_levels(x, f"body.{index}", 2 if block == 0 else 1, False)
            index += 1
    x = conv_norm(x, f"body.{index}").relu().mean((2, 3))
    x = x @ state["fc1.weight"].T
    x = (x - state["norm.running_mean"]) / torch.sqrt(state["norm.running_var"] + 1e-5)
    x = (x * state["norm.weight"] + state["norm.bias"]).relu()
    return x @ state["fc2.weight"].T


def test_spgnet_is_the_network_of_its_paper() -> None:
    network = SPGNet.from_pretrained().double()
    pictures = wave(3, 1, 32, 32).double()
    with torch.no_grad():
        expected = spgnet_by_hand(network.state_dict(), pictures)
        torch.testing.assert_close(network(pictures), expected, rtol=1e-9, atol=1e-9)
        # Its pieces matter: the order of the two levels, and the mean.
        swapped = dict(network.state_dict())
        weight = swapped["body.2.fuse.0.weight"]
        swapped["body.2.fuse.0.weight"] = torch.cat(weight.chunk(2, 1)[::-1], 1)
        assert float((spgnet_by_hand(swapped, pictures) - expected).abs().max()) > 1e-3
