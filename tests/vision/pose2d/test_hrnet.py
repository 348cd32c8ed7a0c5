import copy
import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.flop_counter import FlopCounterMode

from tensorsim.errors import TensorsimError
from tensorsim.vision.pose2d.hrnet import HRNet, HRNetConfig
from tests.networks import settled
from tests.stage import StageTester

TINY = HRNetConfig(width=4, blocks=1, modules=(1, 2, 2), bottlenecks=2, planes=4)
WITH_HEAD = replace(TINY, presence=5)


def make_network(config: HRNetConfig | int = TINY) -> HRNet:
    """A seeded net in evaluation mode whose normalisations are far from the identity."""
    torch.manual_seed(1)
    network = settled(HRNet(config))
    nn.init.normal_(network.final_layer.weight)
    return network


class TestHRNet(StageTester):
    batch_shapes = ((3,),)

    def make(self) -> nn.Module:
        return make_network()

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        return (torch.rand(*batch, 3, 64, 32, dtype=dtype, generator=torch.Generator().manual_seed(0)),)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        return [
            ((torch.zeros(3, 64, 32),), r"got shape \[3, 64, 32\], expected \(N, 3, H, W\)"),
            ((torch.zeros(1, 4, 64, 32),), "expected"),
            ((torch.zeros(1, 3, 64, 48),), "multiples of 32"),
            ((torch.zeros(1, 3, 0, 32),), "multiples of 32"),
            ((torch.zeros(1, 3, 64, 32, dtype=torch.uint8),), "floating"),
        ]


class TestHRNetWithPresence(TestHRNet):
    def make(self) -> nn.Module:
        network = make_network(WITH_HEAD)
        nn.init.normal_(network.presence.factor.weight, std=0.3)
        return network


def reference(state: dict[str, Tensor], images: Tensor) -> Tensor:
    """The published net as functions of its state dict: nested exactly as its names are."""

    def has(name: str) -> bool:
        return any(key.startswith(name + ".") for key in state)

    def conv_bn(x: Tensor, conv: str, bn: str, stride: int = 1) -> Tensor:
        weight = state[f"{conv}.weight"]
        x = F.conv2d(x, weight, stride=stride, padding=weight.shape[-1] // 2)
        mean, variance = state[f"{bn}.running_mean"], state[f"{bn}.running_var"]
        gain = state[f"{bn}.weight"] / torch.sqrt(variance + 1e-5)
        return (x - mean[:, None, None]) * gain[:, None, None] + state[f"{bn}.bias"][:, None, None]

    def exchange(x: Tensor, name: str, source: int, target: int) -> Tensor:
        if source == target:
            return x
        if source > target:
            x = conv_bn(x, f"{name}.0", f"{name}.1")
            for dim in (-2, -1):
                x = x.repeat_interleave(2 ** (source - target), dim)
            return x
        for k in range(target - source):
            x = conv_bn(x, f"{name}.{k}.0", f"{name}.{k}.1", stride=2)
            x = x.relu() if k < target - source - 1 else x
        return x

    rgb255 = images * 255
    x = (rgb255 - torch.tensor([123.675, 116.28, 103.53]).view(3, 1, 1)) / torch.tensor(
        [58.395, 57.12, 57.375]
    ).view(3, 1, 1)
    x = conv_bn(conv_bn(x, "conv1", "bn1", 2).relu(), "conv2", "bn2", 2).relu()
    i = 0
    while has(f"layer1.{i}"):
        block = f"layer1.{i}"
        y = conv_bn(x, f"{block}.conv1", f"{block}.bn1").relu()
        y = conv_bn(y, f"{block}.conv2", f"{block}.bn2").relu()
        y = conv_bn(y, f"{block}.conv3", f"{block}.bn3")
        if has(f"{block}.downsample"):
            x = conv_bn(x, f"{block}.downsample.0", f"{block}.downsample.1")
        x, i = (x + y).relu(), i + 1
    branches = [
        conv_bn(x, "transition1.0.0", "transition1.0.1").relu(),
        conv_bn(x, "transition1.1.0.0", "transition1.1.0.1", 2).relu(),
    ]
    for stage in (2, 3, 4):
        if stage > 2:
            new = f"transition{stage - 1}.{stage - 1}.0"
            branches.append(conv_bn(branches[-1], f"{new}.0", f"{new}.1", 2).relu())
        m = 0
        while has(f"stage{stage}.{m}"):
            name = f"stage{stage}.{m}"
            for b in range(stage):
                i = 0
                while has(f"{name}.branches.{b}.{i}"):
                    block = f"{name}.branches.{b}.{i}"
                    y = conv_bn(branches[b], f"{block}.conv1", f"{block}.bn1").relu()
                    y = conv_bn(y, f"{block}.conv2", f"{block}.bn2")
                    branches[b], i = (branches[b] + y).relu(), i + 1
            branches = [
                torch.stack(
                    [exchange(branches[s], f"{name}.fuse_layers.{t}.{s}", s, t) for s in range(stage)]
                )
                .sum(0)
                .relu()
                for t in range(stage)
                if has(f"{name}.fuse_layers.{t}")
            ]
            m += 1
    return F.conv2d(branches[0], state["final_layer.weight"], state["final_layer.bias"])


@pytest.mark.parametrize("config", [TINY, 18])
def test_equals_the_published_net_written_over_its_state_dict(config: HRNetConfig | int) -> None:
    network, images = make_network(config).double(), torch.rand(2, 3, 64, 96, dtype=torch.float64)
    with torch.no_grad():
        expected = reference(network.state_dict(), images)
        actual = network(images)
    assert actual.shape == (2, 17, 16, 24)
    assert expected.std() > 0.1
    torch.testing.assert_close(actual, expected, rtol=0, atol=1e-6 * float(expected.abs().max()))


@pytest.mark.parametrize(
    ("width", "parameters", "entries", "gmac"),
    [
        # A published count of 1.3 M and 0.54 G (times 2^30) belongs to W18-small for pose.
        (18, 1_284_961, 350, 0.571),
        (32, 28_536_113, 1754, 7.645),
        (48, 63_595_745, 1754, 15.692),
    ],
)
def test_size_of_the_published_variants(width: int, parameters: int, entries: int, gmac: float) -> None:
    network = HRNet(width).eval()
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        maps = network(torch.zeros(1, 3, 256, 192))
    assert maps.shape == (1, 17, 64, 48)
    assert sum(p.numel() for p in network.parameters()) == parameters
    assert len(network.state_dict()) == entries
    assert counter.get_total_flops() / 2e9 == pytest.approx(gmac, abs=6e-4)


@pytest.mark.parametrize("width", [32, 48])
def test_keys_and_shapes_of_the_published_checkpoints(shared_data: Path, width: int) -> None:
    with open(shared_data.parent / "specs" / f"keys_hrnet_w{width}_orig.tsv", newline="") as file:
        manifest = {
            key: [] if shape == "scalar" else [int(n) for n in shape.split("x")]
            for key, shape in csv.reader(file, delimiter="\t")
        }
    with torch.device("meta"):
        state = HRNet(width).state_dict()
    assert {key: list(value.shape) for key, value in state.items()} == manifest


NAMINGS = {
    "original.pth": lambda s: s,
    "checkpoint.pth": lambda s: {
        "epoch": 210,
        "best_state_dict": s,
        "state_dict": {f"module.{k}": v for k, v in s.items()},
    },
    "mmpose0.pth": lambda s: {"state_dict": _mmpose(s, "keypoint_head")},
    "mmpose1.pth": lambda s: {
        "meta": {"epoch": 210},
        "state_dict": {**_mmpose(s, "head"), "data_preprocessor.mean": torch.zeros(3)},
    },
}


def _mmpose(state: dict[str, Tensor], head: str) -> dict[str, Tensor]:
    return {
        f"{head}.{key}" if key.startswith("final_layer") else f"backbone.{key}": value
        for key, value in state.items()
    }


@pytest.mark.parametrize("name", [*NAMINGS, "own.safetensors"])
@pytest.mark.parametrize("config", [TINY, WITH_HEAD, 18])
def test_loads_every_published_naming(tmp_path: Path, name: str, config: HRNetConfig | int) -> None:
    network, images = make_network(config), torch.rand(1, 3, 64, 64)
    state = network.state_dict()
    if name.endswith(".safetensors"):
        save_file(state, tmp_path / name)
    else:
        torch.save(NAMINGS[name](state), tmp_path / name)
    loaded = HRNet.from_pretrained(tmp_path / name, input_size=(64, 64))
    assert not loaded.training
    assert loaded.config == network.config
    assert loaded.input_size == (64, 64)
    with torch.no_grad():
        assert torch.equal(loaded(images), network(images))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.pop("stage4.0.branches.3.0.conv1.weight"), "1 missing"),
        (lambda s: s.update({"incre_modules.0.weight": torch.zeros(1)}), "1 unexpected"),
        (lambda s: s.update({"conv2.weight": torch.zeros(64, 64, 1, 1)}), "another shape"),
        (lambda s: s.pop("final_layer.weight"), "expected those of an HRNet"),
        (lambda s: [s.pop(k) for k in list(s) if k.startswith("stage3.")], "expected those of an HRNet"),
    ],
)
def test_refuses_other_weights(tmp_path: Path, change: Any, message: str) -> None:
    state = dict(make_network().state_dict())
    change(state)
    torch.save(state, tmp_path / "weights.pth")
    with pytest.raises(TensorsimError, match=message):
        HRNet.from_pretrained(tmp_path / "weights.pth")


def test_refuses_another_variant_than_asked_for(tmp_path: Path) -> None:
    torch.save(make_network(18).state_dict(), tmp_path / "weights.pth")
    assert HRNet.from_pretrained(tmp_path / "weights.pth", width=18).config.width == 16
    with pytest.raises(TensorsimError, match="expected HRNet width 32"):
        HRNet.from_pretrained(tmp_path / "weights.pth", width=32)


def test_refuses_bad_configurations() -> None:
    for make, message in (
        (lambda: HRNet(33), r"got width 33, expected one of \[18, 32, 48\]"),
        (lambda: HRNet(TINY, input_size=(256, 190)), "multiples of 32"),
        (lambda: HRNetConfig(width=0), "integers >= 1"),
        (lambda: HRNetConfig(width=8, presence=-1), "presence >= 0"),
        (lambda: HRNetConfig(width=8, modules=(1, 1)), "three module counts"),  # type: ignore[arg-type]
    ):
        with pytest.raises(TensorsimError, match=message):
            make()


def test_presence_scales_whole_maps() -> None:
    """A factor for each map, by hand in float64, which is 1 before training."""
    plain, network = make_network(), make_network(WITH_HEAD)
    network.load_state_dict(network.state_dict() | plain.state_dict())
    images = torch.rand(2, 3, 64, 96)
    seen: list[Tensor] = []
    network.presence.register_forward_hook(lambda module, inputs, output: seen.extend(inputs))
    with torch.no_grad():
        maps = plain(images)
        torch.testing.assert_close(network(images), maps)
        nn.init.normal_(network.presence.factor.weight, std=0.3)
        found = network(images).double()
    features = seen[0].double()
    parts = [
        features[:, :, 4 * i : 4 * i + 4, 6 * j : 6 * j + 6].mean((-2, -1))
        for i in range(4)
        for j in range(4)
    ]
    x = torch.cat([torch.stack(parts, dim=-1).flatten(1), maps.double().amax((-2, -1))], dim=1)
    head = {name: value.double() for name, value in network.presence.state_dict().items()}
    x = (x @ head["hidden.weight"].T + head["hidden.bias"]).clamp_min(0)
    factor = (1.3 / (1 + (-(x @ head["factor.weight"].T + head["factor.bias"])).exp())).clamp(max=1.0)
    assert 0.2 < float((factor < 1.0).double().mean()) < 0.8
    torch.testing.assert_close(found, maps.double() * factor[..., None, None], rtol=1e-5, atol=1e-5)


def test_exports_with_a_free_batch() -> None:
    network = make_network()
    batch = torch.export.Dim("batch", min=1, max=64)
    program = torch.export.export(network, (torch.rand(2, 3, 64, 32),), dynamic_shapes={"crops": {0: batch}})
    images = torch.rand(5, 3, 64, 32)
    with torch.no_grad():
        torch.testing.assert_close(program.module()(images), network(images))


def test_scripted_takes_other_sizes_and_refuses_in_the_same_words() -> None:
    network = make_network()
    scripted = torch.jit.script(network)
    images = torch.rand(1, 3, 96, 160)
    with torch.no_grad():
        torch.testing.assert_close(scripted(images), network(images))
    with pytest.raises(Exception, match="multiples of 32"):
        scripted(images[..., :100])


def test_trains() -> None:
    network = copy.deepcopy(make_network()).train()
    network(torch.rand(2, 3, 64, 64)).square().mean().backward()
    missing = [
        name for name, p in network.named_parameters() if p.grad is None or not p.grad.isfinite().all()
    ]
    assert not missing
