"""Weights by name: every entry, fetching with resume and verification, refusals."""

import dataclasses
import hashlib
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch

import tensorsim
from tensorsim import cli, registry
from tensorsim.enhance import DnCNN
from tensorsim.errors import TensorsimError
from tensorsim.model_files import manifest
from tensorsim.registry import PUBLISHED, ModelEntry
from tensorsim.vision import HRNet, RTMDet
from tensorsim.weights import save_weights
from tests.networks import keypoints_to_lift, people_to_move
from tests.stage import assert_same

CONTENT = bytes(range(256)) * 16384


class Server(ThreadingHTTPServer):
    """Serves CONTENT at any path, with ranges; ``break_after`` bytes of the first answer it hangs up."""

    break_after: int | None = None
    ranges: list[str | None]


class Handler(BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:
        asked = self.headers.get("Range")
        self.server.ranges.append(asked)
        start = int(asked.removeprefix("bytes=").split("-")[0]) if asked else 0
        self.send_response(206 if asked else 200)
        self.send_header("Content-Length", str(len(CONTENT) - start))
        self.send_header("Accept-Ranges", "bytes")
        self.send_header("ETag", '"one"')
        if asked:
            self.send_header("Content-Range", f"bytes {start}-{len(CONTENT) - 1}/{len(CONTENT)}")
        self.end_headers()
        body = CONTENT[start:]
        if self.server.break_after is not None:
            body, self.server.break_after = body[: self.server.break_after], None
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[Server]:
    server = Server(("127.0.0.1", 0), Handler)
    server.ranges = []
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture
def entry(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModelEntry:
    monkeypatch.setattr(registry, "cache_dir", lambda: tmp_path)
    return ModelEntry(
        "test-net",
        "HRNet",
        "test-net.pth",
        "MIT",
        "nobody",
        "none",
        "none",
        hashlib.sha256(CONTENT).hexdigest()[:8],
        f"http://127.0.0.1:{server.server_port}/test-net.pth",
    )


def test_a_name_is_fetched_once(entry: ModelEntry, server: Server) -> None:
    assert registry.fetch(entry, quiet=True).read_bytes() == CONTENT
    registry.fetch(entry, quiet=True)
    assert len(server.ranges) == 1


def test_an_interrupted_download_goes_on(entry: ModelEntry, server: Server) -> None:
    server.break_after = 2_000_000
    with pytest.raises(TensorsimError, match=r"test-net: could not fetch http://.*give the path of a copy"):
        registry.fetch(entry, quiet=True)
    assert not entry.path.exists()
    assert registry.fetch(entry, quiet=True).read_bytes() == CONTENT
    # It resumed where it had stopped.
    assert server.ranges[0] is None
    assert server.ranges[-1] is not None
    assert int(server.ranges[-1].removeprefix("bytes=").rstrip("-")) > 0


def test_another_content_is_refused_and_removed(entry: ModelEntry) -> None:
    wrong = dataclasses.replace(entry, sha256="0" * 8)
    with pytest.raises(TensorsimError, match=r"expected 00000000\.\.\.; it was removed"):
        registry.fetch(wrong, quiet=True)
    assert not wrong.path.exists()


@pytest.mark.parametrize("digits", [8, 64])
def test_the_cache_is_verified_by_the_whole_digest(entry: ModelEntry, server: Server, digits: int) -> None:
    entry = dataclasses.replace(entry, sha256=hashlib.sha256(CONTENT).hexdigest()[:digits])
    path = registry.fetch(entry, quiet=True)
    path.write_bytes(CONTENT[:-1] + b"?")
    with pytest.raises(TensorsimError, match=r"has SHA-256 .* it was removed, fetch it again"):
        registry.fetch(entry, quiet=True)
    assert registry.fetch(entry, quiet=True).read_bytes() == CONTENT
    assert len(server.ranges) == 2
    assert ("weak" in entry.assurance) == (digits == 8)


def test_digest_of_the_blind_denoiser_is_that_of_the_copy_at_hand(shared_data: Path) -> None:
    """The copy whose accuracy on standard pictures is the published one (tests/enhance/test_dncnn.py)."""
    content = (shared_data / "weights" / "dncnn_gray_blind.pth").read_bytes()
    assert registry.find("dncnn-gray-blind").sha256 == hashlib.sha256(content).hexdigest()


def test_offline_says_what_to_do(entry: ModelEntry) -> None:
    # Port 9 of this machine does not answer.
    offline = dataclasses.replace(entry, url="http://127.0.0.1:9/test-net.pth")
    with pytest.raises(
        TensorsimError, match=r"could not fetch http://127.0.0.1:9.*save it as .*test-net.pth"
    ):
        registry.fetch(offline, quiet=True)


def test_a_cache_that_cannot_be_made_and_an_error_without_words_are_said(
    entry: ModelEntry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gdown.download", Mock(side_effect=TimeoutError()))
    with pytest.raises(TensorsimError, match=r"could not fetch .* \(TimeoutError: TimeoutError\)"):
        registry.fetch(entry, quiet=True)
    (tmp_path / "file").touch()
    monkeypatch.setattr(registry, "cache_dir", lambda: tmp_path / "file")
    with pytest.raises(TensorsimError, match=r"could not fetch .* \(FileExistsError: "):
        registry.fetch(entry, quiet=True)


def test_names_and_paths_are_told_apart(tmp_path: Path) -> None:
    # A path is used as it is, even if nothing is there: the loader then reports that.
    assert registry.locate(tmp_path / "weights.pth", "HRNet") == tmp_path / "weights.pth"
    assert registry.locate("weights.pth", "HRNet") == Path("weights.pth")
    with pytest.raises(
        TensorsimError, match=r"weights of HRNet: got 'hrnet-w32-coc'.*perhaps 'hrnet-w32-coco'"
    ):
        HRNet.from_pretrained("hrnet-w32-coc")
    with pytest.raises(
        TensorsimError, match="weights of RTMDet: got 'hrnet-w32-coco', expected a path or one of"
    ):
        RTMDet.from_pretrained("hrnet-w32-coco")


@pytest.mark.parametrize("entry", PUBLISHED, ids=lambda entry: entry.name)
def test_published_entries_are_complete(entry: ModelEntry) -> None:
    assert entry.url is not None
    assert entry.url.startswith("https://")
    assert entry.url.endswith(f"/{entry.file}")
    # The makers put the head of the digest into the name.
    assert (len(entry.sha256) == 8 and entry.sha256 in entry.file) or len(entry.sha256) == 64
    assert entry.licence in ("Apache-2.0", "MIT")
    for text in (entry.source, entry.metrics, entry.preprocessing):
        assert len(text) > 10


def test_names_are_unique() -> None:
    names = [entry.name for entry in registry.entries()]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("entry", registry.shipped(), ids=lambda entry: entry.name)
def test_shipped_entries_are_in_order(entry: ModelEntry) -> None:
    assert registry.verify(entry) == entry.sha256
    assert entry.licence
    assert entry.path.with_suffix(".md").is_file(), "a weight has a card"


#: Files of networks; another one holds poses.
NETWORKS = tuple(entry for entry in registry.shipped() if entry.network)

#: What each network of a shipped file is shown, by its class or the name of the file.
SHOWN = {
    "RTMDet": (1, 3, 96, 128),
    "AcfDetector": (1, 3, 160, 96),
    "HRNet": (1, 3, 64, 64),
    "CPM": (1, 3, 64, 64),
    "VideoPose3D": (9, 17, 2),
    "DnCNN": (2, 24, 40),
    "SPNet": (2, 1, 64, 64),
    "SPGNet": (2, 1, 32, 32),
    "DIATRadHARNet": (2, 1, 32, 32),
}


@pytest.mark.parametrize("entry", NETWORKS, ids=lambda entry: entry.name)
def test_shipped_networks_load_run_and_script(entry: ModelEntry) -> None:
    rooms = (tensorsim.vision, tensorsim.enhance, tensorsim.recognition)
    (room,) = (room for room in rooms if hasattr(room, entry.network))
    network = getattr(room, entry.network).from_pretrained(entry.name)
    assert not network.training
    if entry.default:
        default = getattr(room, entry.network).from_pretrained().state_dict()
        assert all(torch.equal(value, default[key]) for key, value in network.state_dict().items())
    if entry.network == "TemporalLifter":
        arguments = keypoints_to_lift(12)
    elif entry.network == "RangeRate":
        arguments = people_to_move(12)
    else:
        shape = SHOWN[entry.network]
        arguments = (torch.rand(shape, generator=torch.Generator().manual_seed(0)),)
    with torch.no_grad():
        assert_same(torch.jit.script(network)(*arguments), network(*arguments), atol=1e-5)


def test_shipped_files_are_small() -> None:
    sizes = {entry.name: entry.path.stat().st_size for entry in registry.shipped()}
    assert sum(sizes.values()) <= 55e6
    assert sizes["temporal-lifter-small"] <= 4e6
    assert sizes["rtmdet-person-small"] <= 5e6
    assert sizes["hrnet-pose-small"] <= 10e6


def test_at_most_one_default_per_network() -> None:
    defaults = [entry.network for entry in registry.shipped() if entry.default]
    assert len(set(defaults)) == len(defaults)


def test_input_size_travels_with_the_weights(tmp_path: Path) -> None:
    from tensorsim.vision.pose2d.hrnet import HRNetConfig

    config = HRNetConfig(width=4, blocks=1, modules=(1, 1, 1), bottlenecks=1, planes=4)
    path = tmp_path / "small.safetensors"
    save_weights(HRNet(config), path, {"input_size": "128x96"})
    assert HRNet.from_pretrained(path).input_size == (128, 96)
    assert HRNet.from_pretrained(path, input_size=(64, 64)).input_size == (64, 64)
    named = tmp_path / "net_384x288.safetensors"
    save_weights(HRNet(config), named, {})
    assert HRNet.from_pretrained(named).input_size == (384, 288)


def test_saved_weights_come_back(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = DnCNN(depth=4, channels=8).train()
    network(torch.rand(2, 16, 16))
    save_weights(network, tmp_path / "net.safetensors", {"kind": "test"})
    back = DnCNN.from_pretrained(tmp_path / "net.safetensors")
    images = torch.rand(3, 20, 20)
    torch.testing.assert_close(back(images), network.eval()(images), rtol=1e-2, atol=1e-3)
    assert [file.name for file in tmp_path.iterdir()] == ["net.safetensors"]
    # Statistics keep their precision.
    norm = next(layer for layer in network.model if isinstance(layer, torch.nn.BatchNorm2d))
    there = next(layer for layer in back.model if isinstance(layer, torch.nn.BatchNorm2d))
    assert torch.equal(norm.running_var, there.running_var)


def test_what_float16_cannot_hold_is_refused(tmp_path: Path) -> None:
    layer = torch.nn.Linear(1, 1)
    torch.nn.init.constant_(layer.weight, 1e6)
    with pytest.raises(TensorsimError, match="weight has values that float16 cannot hold"):
        save_weights(layer, tmp_path / "net.safetensors", {})
    assert list(tmp_path.iterdir()) == []


def test_commands(capsys: pytest.CaptureFixture[str]) -> None:
    cli.main(["models", "list"])
    listed = capsys.readouterr().out
    assert all(entry.name in listed and entry.licence in listed for entry in registry.entries())
    assert all(entry["name"] in listed for entry in manifest())
    cli.main(["models", "verify"])
    verified = capsys.readouterr().out
    assert all(f"ok    {entry['name']}: {entry['sha256']}" in verified for entry in manifest())
    with pytest.raises(SystemExit) as stop:
        cli.main(["models", "fetch", "rtmdet-m-persn"])
    assert stop.value.code == 2
    assert "perhaps 'rtmdet-m-person'" in capsys.readouterr().err
