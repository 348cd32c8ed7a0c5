"""Weight files: safe, verified, complete."""

import hashlib
import importlib
import io
import os
import pickle
import re
import sys
import types
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tensorsim import weights
from tensorsim.errors import TensorsimError
from tensorsim.weights import load_state_dict, load_strict

FORMATS = [pytest.param(True, id="zip"), pytest.param(False, id="legacy")]


def tensors() -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(1)
    half = torch.randn(5, generator=generator).half()
    count = torch.tensor(7)
    return OrderedDict(a=torch.randn(3, 4, generator=generator), b=half, c=count)


def same(actual: dict[str, Tensor], expected: dict[str, Tensor]) -> bool:
    return list(actual) == list(expected) and all(
        torch.equal(actual[k], expected[k]) and actual[k].dtype == expected[k].dtype for k in expected
    )


def save(content: Any, path: Path, zip_format: bool = True) -> Path:
    torch.save(content, path, _use_new_zipfile_serialization=zip_format)
    return path


def named_by_hash(path: Path, pattern: str) -> Path:
    digest = hashlib.sha256(path.read_bytes()).hexdigest()[:8]
    return path.rename(path.with_name(pattern.format(digest)))


class Code:
    """Pickles as a call that leaves a file behind."""

    def __init__(self, path: Path, how: str = "os.system") -> None:
        self.path, self.how = path, how

    def __reduce__(self) -> Any:
        if self.how == "os.system":
            return os.system, (f"touch {self.path}",)
        if self.how == "eval":
            return eval, (f"open({str(self.path)!r}, 'w').close()",)
        return open, (str(self.path), "w")


# ---- reading ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("zip_format", FORMATS)
@pytest.mark.parametrize("suffix", [".pth", ".pt", ".bin"])
def test_reads_a_bare_state_dict(tmp_path: Path, suffix: str, zip_format: bool) -> None:
    assert same(load_state_dict(save(tensors(), tmp_path / f"w{suffix}", zip_format)), tensors())


def test_reads_safetensors(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    save_file(tensors(), tmp_path / "w.safetensors")
    assert same(dict(sorted(load_state_dict(tmp_path / "w.safetensors").items())), tensors())


@pytest.mark.parametrize("zip_format", FORMATS)
def test_reads_a_module_with_metadata_and_parameters(tmp_path: Path, zip_format: bool) -> None:
    net = nn.Sequential(nn.Conv2d(2, 3, 3), nn.BatchNorm2d(3))
    expected = {k: v.clone() for k, v in net.state_dict().items()}
    read = load_state_dict(save(net.state_dict(keep_vars=True), tmp_path / "w.pth", zip_format))
    assert same(read, expected)
    assert not any(v.requires_grad for v in read.values())


@pytest.mark.parametrize("zip_format", FORMATS)
def test_reads_an_openmmlab_container_with_training_logs(
    tmp_path: Path, zip_format: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A stand-in for mmengine's HistoryBuffer, which pickles its statistics methods through builtins.getattr.
    buffers = types.ModuleType("mmengine.logging.history_buffer")

    class HistoryBuffer:
        def __init__(self) -> None:
            self.history, self.methods = np.arange(4.0), {"min": self.minimum}

        def minimum(self) -> float:
            return float(self.history.min())

    HistoryBuffer.__module__ = buffers.__name__
    HistoryBuffer.__qualname__ = "HistoryBuffer"
    buffers.HistoryBuffer = HistoryBuffer  # type: ignore[attr-defined]
    for name in ("mmengine", "mmengine.logging"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    monkeypatch.setitem(sys.modules, buffers.__name__, buffers)

    state = tensors()
    state["data_preprocessor.mean"] = torch.zeros(3)
    state["data_preprocessor.std"] = torch.ones(3)
    container = {
        "meta": {"epoch": 300, "classes": ("person",)},
        "state_dict": state,
        "message_hub": {"log": HistoryBuffer(), "lr": np.float64(0.1), "steps": {1, 2}},
        "ema_state_dict": {"steps": torch.tensor(3), "module.a": torch.zeros(1)},
    }
    path = save(container, tmp_path / "w.pth", zip_format)
    for name in list(sys.modules):
        if name.startswith("mmengine"):
            monkeypatch.delitem(sys.modules, name)
    assert same(load_state_dict(path), tensors())
    assert not any(name.startswith("mmengine") for name in sys.modules)


def test_reads_the_official_denoiser(shared_data: Path) -> None:
    path = shared_data / "weights" / "dncnn_gray_blind.pth"
    read = load_state_dict(path)
    assert same(read, torch.load(path, weights_only=True, map_location="cpu"))
    assert len(read) == 40


# ---- the hash in the name --------------------------------------------------------------------------------


@pytest.mark.parametrize("pattern", ["net_20220902_112414-{}.pth", "net-{}_20220909.pth", "hrnet_w32-{}.pth"])
def test_verifies_the_hash_in_the_name(tmp_path: Path, pattern: str) -> None:
    path = named_by_hash(save(tensors(), tmp_path / "w.pth"), pattern)
    assert same(load_state_dict(path), tensors())
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(TensorsimError, match="SHA-256 begins with"):
        load_state_dict(path)


@pytest.mark.parametrize("name", ["net-20220909.pth", "net_deadbeef.pth", "net-deadbeef0.pth", "net-abc.pth"])
def test_other_names_carry_no_hash(tmp_path: Path, name: str) -> None:
    assert same(load_state_dict(save(tensors(), tmp_path / name)), tensors())


# ---- what is refused -------------------------------------------------------------------------------------


@pytest.mark.parametrize("zip_format", FORMATS)
@pytest.mark.parametrize("how", ["os.system", "eval", "open"])
@pytest.mark.parametrize("place", ["top", "in the weights", "beside the weights"])
def test_never_runs_code(tmp_path: Path, how: str, place: str, zip_format: bool) -> None:
    trace = tmp_path / "trace"
    code: Any = Code(trace, how)
    content = {
        "top": code,
        "in the weights": {**tensors(), "d": code},
        "beside the weights": {"state_dict": tensors(), "hook": code},
    }[place]
    path = save(content, tmp_path / "w.pth", zip_format)
    with pytest.raises(TensorsimError, match="which is code and not weights"):
        load_state_dict(path)
    assert not trace.exists()


def test_the_test_above_can_fail(tmp_path: Path) -> None:
    path = save(Code(tmp_path / "trace"), tmp_path / "w.pth")
    torch.load(path, weights_only=False)
    assert (tmp_path / "trace").exists()


def test_a_pickle_without_torchs_format_runs_no_code(tmp_path: Path) -> None:
    path = tmp_path / "w.pth"
    path.write_bytes(pickle.dumps(Code(tmp_path / "trace"), protocol=2))
    with pytest.raises(TensorsimError, match="which is code and not weights"):
        load_state_dict(path)
    assert not (tmp_path / "trace").exists()


def test_placeholders_cannot_reach_real_objects(tmp_path: Path) -> None:
    class Chain:
        def __reduce__(self) -> Any:
            return getattr, (np.ndarray, "__class__")

    path = save({"state_dict": tensors(), "log": Chain()}, tmp_path / "w.pth")
    assert same(load_state_dict(path), tensors())
    with pytest.raises(TensorsimError, match="expected tensors by name"):
        load_state_dict(save({"state_dict": {"a": Chain()}}, tmp_path / "v.pth"))


#: Names that published files refer to, and what a pickle that is read makes of them.
REAL = [
    ("collections", "OrderedDict"), ("torch", "Size"), ("torch", "device"), ("torch", "float16"),
    ("torch._utils", "_rebuild_tensor_v2"), ("torch._utils", "_rebuild_parameter"),
]  # fmt: skip
PLACEHOLDERS = [
    ("mmengine.logging.history_buffer", "HistoryBuffer"), ("mmcv.utils", "ConfigDict"), ("numpy", "dtype"),
    ("numpy.core.multiarray", "scalar"), ("numpy._core.multiarray", "_reconstruct"), ("datetime", "datetime"),
    ("_codecs", "encode"), ("collections", "defaultdict"),
    *[("builtins", name) for name in ("getattr", "set", "frozenset", "slice", "range", "complex", "bytearray")],
]  # fmt: skip
REFUSED = [
    ("os", "system"), ("posix", "system"), ("nt", "system"), ("subprocess", "Popen"), ("sys", "exit"),
    ("torch", "load"), ("torch", "compile"), ("torch._utils", "_import_dotted_name"), ("torch.jit", "load"),
    ("torch.storage", "_load_from_bytes"), ("torch._utils", "_rebuild_device_tensor_from_numpy"),
    ("importlib", "import_module"), ("pickle", "loads"), ("operator", "attrgetter"), ("functools", "partial"),
    ("runpy", "run_path"), ("shutil", "rmtree"), ("tensorsim.weights", "load_state_dict"), ("mmenginex", "f"),
    *[("builtins", n) for n in ("eval", "exec", "open", "compile", "__import__", "setattr", "globals", "print")],
]  # fmt: skip


def test_names_in_a_pickle_are_those_of_weights_and_of_their_logs() -> None:
    reader = weights._TensorUnpickler(io.BytesIO(b"."))
    for module, name in REAL:
        found = reader.find_class(module, name)
        real = getattr(importlib.import_module(module), name)
        assert getattr(found, "func", found) is real, "torch's own function, in a call made for this file"
    for module, name in PLACEHOLDERS:
        found = reader.find_class(module, name)
        assert issubclass(found, weights._Placeholder)
        assert isinstance(found("anything", of="it")("again"), weights._Placeholder)
    for module, name in REFUSED:
        with pytest.raises(TensorsimError, match="which is code and not weights; it was not run"):
            reader.find_class(module, name)


def test_refuses_a_pickled_module_and_a_script(tmp_path: Path) -> None:
    with pytest.raises(TensorsimError, match=r"refers to torch\.nn\.modules\.linear\.Linear"):
        load_state_dict(save(nn.Linear(2, 2), tmp_path / "w.pth"))
    torch.jit.save(torch.jit.script(nn.Linear(2, 2)), str(tmp_path / "s.pt"))
    with pytest.raises(TensorsimError, match="is a TorchScript program"):
        load_state_dict(tmp_path / "s.pt")


@pytest.mark.parametrize("zip_format", FORMATS)
@pytest.mark.parametrize("part", [0.0, 0.1, 0.5, 0.99])
def test_refuses_truncated_pickles(tmp_path: Path, part: float, zip_format: bool) -> None:
    path = save(tensors(), tmp_path / "w.pth", zip_format)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * part)])
    with pytest.raises(TensorsimError, match="damaged or not a file of weights"):
        load_state_dict(path)


@pytest.mark.parametrize("part", [0.0, 0.1, 0.99])
def test_refuses_truncated_safetensors(tmp_path: Path, part: float) -> None:
    from safetensors.torch import save

    data = save(tensors())
    (tmp_path / "w.safetensors").write_bytes(data[: int(len(data) * part)])
    with pytest.raises(TensorsimError, match="damaged or not a safetensors file"):
        load_state_dict(tmp_path / "w.safetensors")


def test_refuses_what_is_no_weight_file(tmp_path: Path) -> None:
    with pytest.raises(TensorsimError, match="no such file"):
        load_state_dict(tmp_path / "missing.pth")
    with pytest.raises(TensorsimError, match=r"got the suffix '\.npz'"):
        load_state_dict(tmp_path / "w.npz")
    (tmp_path / "text.pth").write_text("these are no weights\n")
    with pytest.raises(TensorsimError, match="damaged or not a file of weights"):
        load_state_dict(tmp_path / "text.pth")
    for content, message in [
        ({}, "got no tensors"),
        ({"state_dict": {"data_preprocessor.mean": torch.zeros(3)}}, "got no tensors"),
        ({"epoch": 3, "a": torch.zeros(1)}, "got a int under 'epoch'"),
        ([torch.zeros(1)], "got a list, expected a dict of tensors"),
    ]:
        with pytest.raises(TensorsimError, match=message):
            load_state_dict(save(content, tmp_path / "w.pth"))


def test_one_file_does_not_change_how_the_next_is_read(tmp_path: Path) -> None:
    good = save({"a": nn.Parameter(torch.ones(2))}, tmp_path / "good.pth")
    # After a function is named (GLOBAL), BUILD gives it the state of a partial that calls something else.
    for name in ("_rebuild_tensor_v2", "_rebuild_parameter"):
        state = b"(ccollections\nOrderedDict\n)}Ntb"
        bad = tmp_path / "bad.pth"
        bad.write_bytes(b"ctorch._utils\n" + name.encode() + b"\n" + state + b".")
        with pytest.raises(TensorsimError, match=r"bad\.pth"):
            load_state_dict(bad)
        assert same(load_state_dict(good), {"a": torch.ones(2)})


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
def test_values_that_no_training_leaves_are_refused(tmp_path: Path, suffix: str) -> None:
    from safetensors.torch import save_file

    path = tmp_path / f"w{suffix}"
    for content, message in [
        ({"a": torch.tensor([1.0, float("nan")])}, "a has NaN or infinite values"),
        ({"a": torch.tensor([1.0, float("inf")]).half()}, "a has NaN or infinite values"),
        ({"norm.running_var": torch.tensor([1.0, -1.0])}, r"norm\.running_var has negative values"),
    ]:
        save(content, path) if suffix == ".pth" else save_file(content, path)
        with pytest.raises(TensorsimError, match=message):
            load_state_dict(path)


def test_a_memo_without_end_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "w.pth"
    path.write_bytes(b"\x80\x02}r\x00\x00\x00\x40.")  # LONG_BINPUT 2**30 would fill 16 GB with zeros
    with pytest.raises(TensorsimError, match=r"w\.pth: a pickle with a memo of 1073741824 entries"):
        load_state_dict(path)


def test_bombs_are_refused_before_they_are_unpacked(tmp_path: Path) -> None:
    whole = save({"a": torch.zeros(1_000_000)}, tmp_path / "w.pth")
    bomb = tmp_path / "bomb.pth"
    with zipfile.ZipFile(whole) as source, zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as packed:
        for record in source.infolist():
            packed.writestr(record.filename, source.read(record))
    with pytest.raises(TensorsimError, match=r"bomb\.pth: it unpacks from \d+ to 400\d+ bytes"):
        load_state_dict(bomb)
    repeated = save({"a": torch.zeros(1).expand(10**12)}, tmp_path / "r.pth")
    with pytest.raises(TensorsimError, match=r"a of shape .* has more values than are stored"):
        load_state_dict(repeated)


# ---- loading completely or not at all --------------------------------------------------------------------


class Shared(nn.Module):
    """Two names for one convolution, as in RTMDet's head."""

    def __init__(self) -> None:
        super().__init__()
        self.first, self.second = nn.Conv2d(1, 2, 1), nn.Conv2d(1, 2, 1)
        self.second.weight = self.first.weight


def random_state(module: nn.Module) -> dict[str, Tensor]:
    state = {k: torch.randn(v.shape) for k, v in module.state_dict().items()}
    if isinstance(module, Shared):
        state["second.weight"] = state["first.weight"].clone()
    return state


def test_load_strict_copies() -> None:
    for module in (nn.Linear(2, 3), Shared()):
        state = random_state(module)
        load_strict(module, state, "here")
        assert same(dict(module.state_dict()), state)


def test_load_strict_takes_a_shared_tensor_under_either_name() -> None:
    for absent in ("first.weight", "second.weight"):
        module = Shared()
        state = random_state(module)
        expected = state.pop(absent)
        load_strict(module, state, "here")
        assert torch.equal(module.first.weight, expected)
        assert module.first.weight is module.second.weight


def test_load_strict_refuses_and_changes_nothing() -> None:
    module = Shared()
    before = {k: v.clone() for k, v in module.state_dict().items()}
    good = random_state(module)
    for change, message in [
        ({"first.bias": None}, r"1 missing \(first\.bias\)"),
        ({"first.weight": None, "second.weight": None}, r"1 missing \(first\.weight\)"),
        ({"third.bias": torch.zeros(1)}, r"1 unexpected \(third\.bias\)"),
        ({"first.bias": torch.zeros(3)}, r"1 of another shape \(first\.bias: \[3\] for \[2\]\)"),
        ({"first.bias": torch.zeros(2, dtype=torch.int64)}, r"1 of another kind \(first\.bias: torch\.int64"),
        ({"second.weight": torch.zeros(2, 1, 1, 1)}, r"1 shared with unequal values \(first\.weight\)"),
        ({f"x{i}": torch.zeros(1) for i in range(9)}, r"9 unexpected \(x0, x1, x2, \.\.\.\)"),
    ]:
        state = {k: v for k, v in {**good, **change}.items() if v is not None}
        with pytest.raises(TensorsimError, match="file.pth: not the weights of this Shared: .*" + message):
            load_strict(module, state, "file.pth")
        assert same(dict(module.state_dict()), before)


def test_messages_are_one_line(tmp_path: Path) -> None:
    path = save(tensors(), tmp_path / "w.pth")
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(TensorsimError) as error:
        load_state_dict(path)
    assert re.fullmatch(r"[^\n]+", str(error.value))
