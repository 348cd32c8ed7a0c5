"""Weight files: read without running code in them, and loaded completely or not at all.

A ``.pth`` file is a pickle, that is, a program. Here it is read by an unpickler that can only build tensors and
containers, so that files from any source are safe to open.
"""

import functools
import hashlib
import io
import os
import pickle
import re
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import torch
from torch import Tensor, nn

from tensorsim.errors import TensorsimError, first_line
from tensorsim.files import check_pickle_memo, complete_file

PICKLE_SUFFIXES = (".pth", ".pt", ".bin")

# Published files are called `...-HASH8.pth` or `...-HASH8_DATE.pth`; HASH8 is the first 8 digits of the SHA-256.
_HASH_IN_NAME = re.compile(r"-([0-9a-f]{8})(?:_\d{8})?$")
_DATE = re.compile(r"(?:19|20)\d\d(?:0[1-9]|1[0-2])(?:0[1-9]|[12]\d|3[01])")

# The types in a weight file. Only these names in a pickle are resolved to real objects.
_TENSOR_PARTS = {
    ("collections", "OrderedDict"): OrderedDict,
    ("torch", "Size"): torch.Size,
    ("torch", "device"): torch.device,
}
_TENSOR_FUNCTIONS: dict[tuple[str, str], Callable[..., Any]] = {
    ("torch._utils", "_rebuild_tensor_v2"): torch._utils._rebuild_tensor_v2,
    ("torch._utils", "_rebuild_parameter"): torch._utils._rebuild_parameter,
}

# Published checkpoints also contain training logs (mmengine's message hub, NumPy scalars). Their objects are read as
# placeholders that do nothing; names from other packages are refused.
_LOG_PACKAGES = ("mmengine", "mmcv", "numpy", "collections", "datetime", "_codecs")
_LOG_BUILTINS = ("getattr", "set", "frozenset", "slice", "range", "complex", "bytearray")

# Largest ratio of unpacked to packed size of a checkpoint; files written by torch have about 1.
_MAX_COMPRESSION = 20


class _Placeholder:
    """Stands in for an object stored beside the weights: accepts any call from a pickle and does nothing."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        pass

    def __call__(self, *args: Any, **kwargs: Any) -> "_Placeholder":
        return self

    def __setstate__(self, state: Any) -> None:
        pass

    def __setitem__(self, key: Any, value: Any) -> None:
        pass

    def append(self, value: Any) -> None:
        pass

    def extend(self, values: Any) -> None:
        pass

    def add(self, value: Any) -> None:
        pass


class _TensorUnpickler(pickle.Unpickler):
    """An unpickler that builds tensors and containers, and imports nothing."""

    def __init__(self, file: IO[bytes], **options: Any) -> None:
        check_pickle_memo(file)
        super().__init__(file, **options)

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _TENSOR_PARTS:
            return _TENSOR_PARTS[module, name]
        if (module, name) in _TENSOR_FUNCTIONS:
            # A pickle can set the state of what it names: let that be a partial made for it, not torch's own function.
            return functools.partial(_TENSOR_FUNCTIONS[module, name])
        if module == "torch" and isinstance(getattr(torch, name, None), torch.dtype):
            return getattr(torch, name)
        package = module.partition(".")[0]
        if package in _LOG_PACKAGES or (module in ("builtins", "__builtin__") and name in _LOG_BUILTINS):
            return type(name, (_Placeholder,), {})
        raise TensorsimError(f"it refers to {module}.{name}, which is code and not weights; it was not run")


def load_state_dict(path: str | os.PathLike[str]) -> dict[str, Tensor]:
    """Read the tensors of a weight file, on the CPU.

    Args:
        path: ``.pth``, ``.pt`` or ``.bin`` (torch's zip format or its older one; a bare state dict or a
            container with a ``state_dict``), or ``.safetensors``. If the name ends in eight hexadecimal
            digits as published files do (``-HASH8.pth``, ``-HASH8_DATE.pth``), the file's SHA-256 must
            begin with them.

    Returns:
        Tensors by name, without the ``data_preprocessor.*`` entries that OpenMMLab stores beside the weights.

    Raises:
        TensorsimError: no such file, another suffix, a wrong hash, a damaged file, a pickle that asks for
            anything but tensors (it is not run), a file without tensors, values that are not finite.
    """
    path = Path(path)
    if path.suffix not in (*PICKLE_SUFFIXES, ".safetensors"):
        expected = ", ".join((*PICKLE_SUFFIXES, ".safetensors"))
        raise TensorsimError(f"{path}: got the suffix {path.suffix!r}, expected a weight file ({expected})")
    if not path.is_file():
        raise TensorsimError(f"{path}: no such file, expected weights")
    # Hash and tensors come from a single read, so that what was verified is what is loaded.
    data = path.read_bytes()
    _verify_hash_in_name(path, data)
    content = _read_safetensors(path, data) if path.suffix == ".safetensors" else _read_pickle(path, data)

    if isinstance(content, dict) and isinstance(content.get("state_dict"), dict):
        content = content["state_dict"]
    if not isinstance(content, dict):
        raise TensorsimError(f"{path}: got a {type(content).__name__}, expected a dict of tensors by name")
    tensors: dict[str, Tensor] = {}
    for key, value in content.items():
        if not isinstance(key, str) or not isinstance(value, Tensor):
            raise TensorsimError(
                f"{path}: got a {type(value).__name__} under {key!r}, expected tensors by name"
            )
        if not key.startswith("data_preprocessor."):
            tensors[key] = value.detach()
    if not tensors:
        raise TensorsimError(f"{path}: got no tensors, expected weights")
    _check_values(path, tensors)
    return tensors


def read_metadata(path: str | os.PathLike[str]) -> dict[str, str]:
    """The metadata in the header of a ``.safetensors`` file; {} for any other file.

    Raises:
        TensorsimError: a damaged file.
    """
    path = Path(path)
    if path.suffix != ".safetensors" or not path.is_file():
        return {}
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            return file.metadata() or {}
    except (SafetensorError, ValueError) as error:
        raise TensorsimError(f"{path}: damaged or not a safetensors file ({error})") from error


def input_size_of(path: Path) -> tuple[int, int] | None:
    """(height, width) of the images that weights were trained on, from the header (``"128x96"``) or from the name of
    a published file (``...384x288...``); None if neither states it.

    Raises:
        TensorsimError: a damaged file.
    """
    stated = re.search(r"(\d+)x(\d+)", read_metadata(path).get("input_size", ""))
    found = stated or re.search(r"(?<!\d)(\d{3})x(\d{3})(?!\d)", path.stem)
    return (int(found[1]), int(found[2])) if found else None


def load_strict(module: nn.Module, state_dict: dict[str, Tensor], source: str | os.PathLike[str]) -> None:
    """Copy weights into a module, or refuse and leave it unchanged.

    Every key and shape must match. A tensor that a module lists under several names (a shared convolution)
    may be given under one of them, as safetensors stores it, or under several with equal values.

    Args:
        module: receives the weights.
        state_dict: tensors by name.
        source: their file, for the message.

    Raises:
        TensorsimError: lists keys that are missing, unexpected, or of the wrong shape or kind.
    """
    expected = module.state_dict(keep_vars=True)
    aliases: dict[int, list[str]] = {}
    for key, tensor in expected.items():
        aliases.setdefault(id(tensor), []).append(key)

    problems = []
    missing = [keys[0] for keys in aliases.values() if not any(key in state_dict for key in keys)]
    unexpected = [key for key in state_dict if key not in expected]
    for title, keys in (("missing", missing), ("unexpected", unexpected)):
        if keys:
            problems.append(f"{len(keys)} {title} ({_some(keys)})")
    common = [key for key in expected if key in state_dict]
    differ = [key for key in common if state_dict[key].shape != expected[key].shape]
    if differ:
        shapes = [f"{key}: {list(state_dict[key].shape)} for {list(expected[key].shape)}" for key in differ]
        problems.append(f"{len(differ)} of another shape ({_some(shapes)})")
    kinds = [k for k in common if state_dict[k].is_floating_point() != expected[k].is_floating_point()]
    if kinds:
        dtypes = [f"{key}: {state_dict[key].dtype} for {expected[key].dtype}" for key in kinds]
        problems.append(f"{len(kinds)} of another kind ({_some(dtypes)})")
    shared = [[key for key in keys if key in state_dict] for keys in aliases.values() if len(keys) > 1]
    unequal = [keys[0] for keys in shared if any(not _equal(state_dict, keys[0], key) for key in keys[1:])]
    if unequal:
        problems.append(f"{len(unequal)} shared with unequal values ({_some(unequal)})")
    if problems:
        raise TensorsimError(
            f"{source}: not the weights of this {type(module).__name__}: " + ", ".join(problems)
        )
    # Not strict: further names of a tensor already given may be absent.
    module.load_state_dict(state_dict, strict=False)


def save_weights(module: nn.Module, path: str | os.PathLike[str], metadata: dict[str, str]) -> None:
    """Write the weights of a module as ``.safetensors`` for shipping: parameters in float16, buffers as they are.

    A tensor that the module lists under several names is stored under the first. The file appears only when complete.

    Args:
        module: its state dict is written.
        path: ends in ``.safetensors``.
        metadata: strings stored in the header, in addition to ``module.metadata``, if there is any.

    Raises:
        TensorsimError: a parameter that float16 cannot hold.
    """
    from safetensors.torch import save_file

    path = Path(path)
    parameters = {id(parameter) for parameter in module.parameters()}
    stored: dict[str, Tensor] = {}
    seen: set[int] = set()
    for key, tensor in module.state_dict(keep_vars=True).items():
        if id(tensor) in seen:
            continue
        seen.add(id(tensor))
        value = tensor.detach().cpu().contiguous()
        if id(tensor) in parameters and value.is_floating_point():
            value = value.half()
            if not bool(torch.isfinite(value).all()):
                raise TensorsimError(f"{path}: {key} has values that float16 cannot hold")
        stored[key] = value
    with complete_file(path) as scratch:
        save_file(stored, scratch, {**getattr(module, "metadata", {}), **metadata})


def _check_values(path: Path, tensors: dict[str, Tensor]) -> None:
    """Refuse values that trained weights cannot have: not finite, negative variances, fewer stored than the shape."""
    for key, value in tensors.items():
        if value.numel() * value.element_size() > value.untyped_storage().nbytes():
            raise TensorsimError(
                f"{path}: {key} of shape {list(value.shape)} has more values than are stored"
            )
        if value.is_floating_point() and not bool(torch.isfinite(value.float()).all()):
            raise TensorsimError(f"{path}: {key} has NaN or infinite values, expected finite weights")
        if key.endswith("running_var") and bool((value < 0).any()):
            raise TensorsimError(f"{path}: {key} has negative values, expected variances")


def _equal(state_dict: dict[str, Tensor], first: str, second: str) -> bool:
    a, b = state_dict[first], state_dict[second]
    return a.data_ptr() == b.data_ptr() or torch.equal(a, b)


def _some(items: list[str], count: int = 3) -> str:
    return ", ".join(items[:count]) + (", ..." if len(items) > count else "")


def _verify_hash_in_name(path: Path, data: bytes) -> None:
    found = _HASH_IN_NAME.search(path.stem)
    if found is None or _DATE.fullmatch(found[1]):
        return
    digest = hashlib.sha256(data).hexdigest()
    if not digest.startswith(found[1]):
        raise TensorsimError(
            f"{path}: its SHA-256 begins with {digest[:8]}, expected {found[1]} as its name says; "
            "the file is damaged or was changed, download it again"
        )


def _read_safetensors(path: Path, data: bytes) -> dict[str, Tensor]:
    from safetensors import SafetensorError
    from safetensors.torch import load

    try:
        return load(data)
    except (SafetensorError, ValueError, KeyError) as error:
        raise TensorsimError(f"{path}: damaged or not a safetensors file ({error})") from error


def _read_pickle(path: Path, data: bytes) -> Any:
    reader = SimpleNamespace(
        __name__="tensorsim.weights",
        Unpickler=_TensorUnpickler,
        load=lambda file, **options: _TensorUnpickler(file, **options).load(),
    )
    try:
        # torch.load would hand a TorchScript archive, which is a program too, to torch.jit.load.
        if data.startswith(b"PK\x03\x04"):
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                unpacked = sum(record.file_size for record in archive.infolist())
            if unpacked > _MAX_COMPRESSION * len(data):
                raise TensorsimError(
                    f"it unpacks from {len(data)} to {unpacked} bytes, and torch does not compress weights"
                )
            records = torch._C.PyTorchFileReader(io.BytesIO(data)).get_all_records()
            if "constants.pkl" in records:
                raise TensorsimError("it is a TorchScript program, expected a file of weights")
        return torch.load(io.BytesIO(data), map_location="cpu", pickle_module=reader, weights_only=False)
    except TensorsimError as error:
        raise TensorsimError(f"{path}: {error}") from None
    except Exception as error:  # a damaged pickle can raise anything
        raise TensorsimError(
            f"{path}: damaged or not a file of weights ({type(error).__name__}: {first_line(error)})"
        ) from error
