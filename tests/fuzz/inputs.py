"""Inputs of each kind, made from a seed; running one raises :class:`BrokenError` if the program breaks on it."""

import io
import math
import random
import signal
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, NoReturn

import torch
from torch import Tensor

import tensorsim as ts
from tensorsim.cli import parse
from tensorsim.config.limited_yaml import load_limited_yaml
from tensorsim.radar.presets import load_scene_yaml
from tests.fuzz.files import READERS, mutated, originals
from tests.fuzz.stages import SETTINGS, STAGES
from tests.stage import tensors_of

#: No input may take longer.
SECONDS = 20


class BrokenError(AssertionError):
    """An exception that is not ours, numbers that are not finite, or no end."""


def run_stage(draw: random.Random) -> None:
    """A stage with its usual input, changed."""
    name = draw.choice(list(STAGES))
    stage, usual = STAGES[name]
    x = usual()
    finite = True
    for _ in range(draw.randint(1, 2)):
        x, finite = changed(draw, x, finite)
    with torch.no_grad():
        output = stage(x)
    if finite and not all(bool(torch.isfinite(y).all()) for y in tensors_of(output) if y.is_floating_point()):
        raise BrokenError(f"{name}: finite numbers in, and NaN or infinity out")


def changed(draw: random.Random, x: Any, finite: bool) -> tuple[Any, bool]:
    """A tensor of another kind, shape or content, and whether its values are finite."""
    if not isinstance(x, Tensor) or x.is_sparse or x.is_meta:
        return x, finite
    index = draw.randrange(max(1, x.numel()))
    special = draw.choice([math.nan, math.inf, -math.inf])
    extreme = draw.choice([0.0, -1.0, 1e-30, 1e6, -1e6])
    changes: list[Callable[[], Any]] = [
        lambda: None,
        lambda: draw.choice(["x", 1, 1.0, [], {}, (x,), x.tolist]),
        lambda: x.detach().resolve_conj().numpy(),
        lambda: (
            x.to(draw.choice([torch.int64, torch.uint8, torch.bool, torch.float16, torch.float64])).clone()
            if not x.is_complex()
            else x.to(torch.complex128)
        ),
        lambda: x + 0j,
        lambda: x.conj(),
        lambda: x.to("meta"),
        lambda: x.flatten() if x.dim() else x,
        lambda: x[None],
        lambda: x.sum(),
        lambda: x.transpose(0, -1) if x.dim() else x,
        lambda: (
            x.narrow(draw.randrange(x.dim()), 0, draw.randint(0, 1)) if x.dim() and 0 not in x.shape else x
        ),
        lambda: torch.cat([x, x], draw.randrange(x.dim())) if x.dim() else x,
        lambda: x.contiguous().flip(0) if x.dim() else x,
        lambda: torch.zeros_like(x),
        lambda: x[..., :1].expand(x.shape) if x.dim() and x.shape[-1] else x,
    ]
    if x.is_floating_point() or x.is_complex():
        changes += [lambda: x * extreme] * 4
        changes += (
            [lambda: x.reshape(-1).clone().index_fill(0, torch.tensor(index), special).view(x.shape)] * 4
            if x.numel()
            else []
        )
    choice = draw.choice(changes)
    y = choice()
    if isinstance(y, Tensor) and not (y.is_meta or y.is_sparse):
        finite = bool(torch.isfinite(y).all())
    return y, finite


NUMBERS = [
    0,
    1,
    2,
    3,
    7,
    -1,
    0.0,
    0.5,
    1.0,
    2.5,
    -1.0,
    1e-300,
    1e300,
    10**25,
    -(10**25),
    math.nan,
    math.inf,
    -math.inf,
]


def run_settings(draw: random.Random) -> None:
    """A stage or a configuration with some of its numbers changed."""
    make, names = draw.choice(SETTINGS)
    make(**{name: draw.choice(NUMBERS) for name in draw.sample(names, draw.randint(1, len(names)))})


YAML = """carrier_hz: 77e9
prf_hz: 4096
tx_m: [0, 0, 1]
rx_m: [[0, 0, 1], [0.1, 0, 1]]
wall: {loss_tangent: 0.01}
floor: {}
"""
WORDS = [
    *"[]{}#'\"\t\n~é\x00", ": ", "- ", "? ", "&a ", "*a", "<<", "!!int ", "1e999", "9" * 50, ".nan", "2001-01-01",
    "1:30",
    "|\n", "%YAML 1.1\n", "---\n", "...", "[" * 40, "wall", "radar: ",
]  # fmt: skip


def run_yaml(draw: random.Random) -> None:
    """A radar file with words put in, taken out and repeated."""
    text = YAML
    for _ in range(draw.randint(1, 6)):
        at = draw.randrange(len(text) + 1)
        text = text[:at] + draw.choice([*WORDS, ""]) + text[at + draw.choice([0, 0, 1, 5]) :]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "radar.yaml"
        path.write_text(text, encoding="utf-8")
        load_limited_yaml(text, "text")
        load_scene_yaml(path)


def run_file(draw: random.Random) -> None:
    """A file that a reader knows, with its bytes changed."""
    name = draw.choice(list(READERS))
    data = mutated(draw, originals()[name])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(data)
        READERS[name](path)


OPTIONS = [
    "--out", "out", "--fps", "--start", "--end", "--seed", "--scene", "through-wall", "--radar", "--person-height",
    "1.8", "--image-size", "--snr", "--device", "--quiet", "--help", "1e308", "-1", "nan", "0", "", "x", "--",
    "walk.npz", "--stride", "--camera-fov", "--initial-distance",
]  # fmt: skip


def run_command(draw: random.Random) -> None:
    """The words of a command line; an exit with a message is right."""
    command = draw.choice(["simulate", "demo", "check", "models", "evaluate", "simulat", ""])
    words = [command, *draw.choices(OPTIONS, k=draw.randint(0, 8))]
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        try:
            parse(words)
        except SystemExit as stop:
            if stop.code not in (0, 2):
                raise BrokenError(f"{words}: exit status {stop.code}") from None


KINDS: dict[str, Callable[[random.Random], None]] = {
    "stage": run_stage,
    "settings": run_settings,
    "yaml": run_yaml,
    "file": run_file,
    "command": run_command,
}


def run(kind: str, seed: int) -> None:
    """Run one input.

    Raises:
        BrokenError: it is neither taken nor refused in our words; the message has the line that repeats it.
    """
    repeat = f"python -m tests.fuzz {kind} {seed}"
    try:
        with warnings.catch_warnings(), time_limit():
            warnings.simplefilter("ignore")
            KINDS[kind](random.Random(f"{kind} {seed}"))
    except ts.TensorsimError:
        pass
    except BrokenError as error:
        raise BrokenError(f"{repeat}: {error}") from error
    except Exception as error:
        raise BrokenError(f"{repeat}: {type(error).__name__}: {str(error)[:300]}") from error


@contextmanager
def time_limit() -> Iterator[None]:
    """Stop the block when it takes too long."""

    def stop(*_: object) -> NoReturn:
        raise BrokenError(f"it takes more than {SECONDS} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
