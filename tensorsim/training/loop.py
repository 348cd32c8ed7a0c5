"""The training loop of all recipes: seeded, resumable, logged, on one device or several.

A recipe defines what is trained, on which samples and with which loss; the loop does the rest. Samples come from an
endless stream and depend only on their number, and the random state is reset before every step, so an interrupted
run continues to the same result. Several GPUs: ``torchrun --nproc-per-node N -m tensorsim train ...``; each process
takes its share of every batch.
"""

import csv
import io
import math
import os
import pickle
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, distributed, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torch.utils.data import DataLoader, Dataset, default_collate
from tqdm import tqdm

from tensorsim.device import rank_and_processes, usable_device
from tensorsim.errors import TensorsimError, check_count
from tensorsim.files import check_folder, complete_file, write_bytes
from tensorsim.weights import save_weights

Batch = dict[str, Any]


def decay_groups(net: nn.Module, weight_decay: float) -> list[dict[str, Any]]:
    """Parameter groups for an optimiser: weight matrices and kernels decay, biases and normalisation do not."""
    parameters = list(net.parameters())
    return [
        {"params": [p for p in parameters if p.dim() > 1], "weight_decay": weight_decay},
        {"params": [p for p in parameters if p.dim() <= 1], "weight_decay": 0.0},
    ]


class Recipe:
    """The parts of a training run, which subclasses define.

    Attributes:
        net: the network to train.
        settings: everything that must be equal for a run to resume from a checkpoint; the recipe's name is added.
        metadata: strings stored in the weight file for its users.
        processor_s: processor time of the training so far, including that recorded in a checkpoint.
    """

    net: nn.Module
    settings: dict[str, Any]
    metadata: dict[str, str]
    processor_s: float = 0.0

    def __init__(self, net: nn.Module, settings: dict[str, Any], metadata: dict[str, str]) -> None:
        self.net = net
        self.settings = {"recipe": type(self).__name__} | settings
        self.metadata = metadata

    def sample(self, index: int) -> dict[str, Any]:
        """The ``index``-th sample of an endless stream; it depends on the seed and on ``index`` only."""
        raise NotImplementedError

    def collate(self, samples: list[dict[str, Any]]) -> Batch:
        """Collate samples into a batch."""
        return default_collate(samples)

    def loss(self, net: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """Scalars to log; the one called ``loss`` is minimised. ``net`` is the network as wrapped by the loop."""
        raise NotImplementedError

    def optimiser(self) -> torch.optim.Optimizer:
        """The optimiser of ``self.net``."""
        raise NotImplementedError

    def rate(self, step: int, steps: int) -> float:
        """Factor on the learning rate at ``step`` of ``steps``."""
        raise NotImplementedError

    def validate(self, net: nn.Module) -> dict[str, float]:
        """Scores on held-out data; the weights with the largest ``score`` are kept as the best."""
        raise NotImplementedError


@dataclass(frozen=True)
class LoopConfig:
    """Settings of a run.

    Attributes:
        out: folder of ``last.pt`` (to resume from), ``best.safetensors``, ``metrics.csv`` and TensorBoard's events.
        steps: total number of optimiser steps.
        batch: samples per step, over all processes.
        seed: seed of everything random in the loop.
        device: ``"auto"`` takes a GPU if there is one.
        workers: processes that prepare samples; 0 prepares them in the main process.
        precision: ``"bfloat16"`` is mixed precision: convolutions and products in bfloat16, weights in float32.
        checkpoint_every, validate_every, log_every: intervals in steps.
        ema_decay: decay of the moving average of the weights that is validated and saved; 0 uses the weights as they
            are.
        quiet: no progress bar.
        events: write events for TensorBoard in addition to ``metrics.csv``.

    Raises:
        TensorsimError: counts below one, a decay outside of [0, 1), an unknown precision.
    """

    out: Path
    steps: int
    batch: int
    seed: int = 0
    device: str = "auto"
    workers: int = 1
    precision: str = "bfloat16"
    checkpoint_every: int = 200
    validate_every: int = 1000
    log_every: int = 20
    ema_decay: float = 0.999
    quiet: bool = False
    events: bool = True

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "checkpoint_every", "validate_every", "log_every"):
            check_count(getattr(self, name), f"LoopConfig.{name}")
        if self.workers < 0:
            raise TensorsimError(f"LoopConfig: got workers {self.workers}, expected at least 0")
        if not 0 <= self.ema_decay < 1:
            raise TensorsimError(f"LoopConfig: got ema_decay {self.ema_decay}, expected 0 <= decay < 1")
        if self.precision not in ("bfloat16", "float32"):
            raise TensorsimError(
                f"LoopConfig: got precision {self.precision!r}, expected 'bfloat16' or 'float32'"
            )
        check_folder(self.out, "LoopConfig.out")

    def fingerprint(self) -> dict[str, Any]:
        """Settings that must not change when a run is resumed. The number of steps may."""
        return {name: getattr(self, name) for name in ("batch", "seed", "precision", "ema_decay")}


class _Stream(Dataset[Batch]):
    def __init__(self, recipe: Recipe) -> None:
        self.recipe = recipe

    def __getitem__(self, index: int) -> Batch:
        return self.recipe.sample(index)


class _Shares:
    """Numbers of the samples in each step that belong to this process."""

    def __init__(self, first: int, config: LoopConfig, rank: int, processes: int) -> None:
        self.first, self.config, self.rank, self.processes = first, config, rank, processes

    def __len__(self) -> int:
        return self.config.steps - self.first

    def __iter__(self) -> Iterator[list[int]]:
        batch = self.config.batch
        for step in range(self.first, self.config.steps):
            yield list(range(step * batch + self.rank, (step + 1) * batch, self.processes))


class _Log:
    """``metrics.csv`` (step, name, value) and TensorBoard events; removes lines of an older run after ``step``."""

    def __init__(self, out: Path, step: int, events: bool) -> None:
        self.events = _events(out, step) if events else None
        self.path = out / "metrics.csv"
        rows: list[list[str]] = []
        if self.path.is_file():
            with self.path.open(newline="", encoding="utf-8") as file:
                rows = [row for row in csv.reader(file) if len(row) == 3 and row[0].isdecimal()]
            rows = [row for row in rows if int(row[0]) <= step]
        with complete_file(self.path) as scratch, scratch.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([["step", "name", "value"], *rows])

    def write(self, step: int, values: dict[str, float]) -> None:
        with self.path.open("a", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([step, name, f"{value:.6g}"] for name, value in values.items())
        if self.events is not None:
            for name, value in values.items():
                self.events.add_scalar(name, value, step)

    def close(self) -> None:
        if self.events is not None:
            self.events.close()


def _events(out: Path, step: int) -> Any:
    """A writer of TensorBoard events after ``step``."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise TensorsimError(
            f"training logs: TensorBoard cannot be imported ({error}); install it with: "
            'pip install "tensorsim[train]"'
        ) from error
    return SummaryWriter(str(out), purge_step=step + 1)


# A single long function, because the steps of a run share nearly all of its state.
def fit(recipe: Recipe, config: LoopConfig) -> dict[str, float]:
    """Train, from the start or from the last checkpoint in ``config.out``.

    Returns:
        The scores of the best weights, with their ``step``.

    Raises:
        TensorsimError: the checkpoint is damaged or belongs to another run, a loss or score is not finite, or
            TensorBoard is missing.
    """
    rank, processes = rank_and_processes()
    device = _joined(config, processes)
    recipe.net.to(device).to(memory_format=torch.channels_last)  # faster convolutions, especially in bfloat16
    averaged = AveragedModel(
        recipe.net,
        multi_avg_fn=lambda means, new, count: get_ema_multi_avg_fn(_decay(config.ema_decay, int(count)))(
            means, new, count
        ),
        use_buffers=True,
    )
    optimiser = recipe.optimiser()
    base_rates = [group["lr"] for group in optimiser.param_groups]
    config.out.mkdir(parents=True, exist_ok=True)
    last = config.out / "last.pt"
    first, best = 0, {"score": float("-inf"), "step": -1.0}
    if last.is_file():
        first, best = _resume(last, recipe, config, averaged, optimiser)
    started = time.process_time() - recipe.processor_s
    wrapped: nn.Module = recipe.net
    if processes > 1:
        ids = [device.index] if device.type == "cuda" else None
        wrapped = nn.parallel.DistributedDataParallel(recipe.net, device_ids=ids)
    log = _Log(config.out, first, config.events) if rank == 0 else None

    loader = DataLoader(
        _Stream(recipe),
        batch_sampler=_Shares(first, config, rank, processes),
        collate_fn=recipe.collate,
        num_workers=config.workers,
        prefetch_factor=4 if config.workers else None,
    )
    bar = tqdm(total=config.steps, initial=first, disable=config.quiet or rank > 0, unit="step")
    began, trained = time.perf_counter(), 0
    for step, batch in enumerate(_batches(loader), start=first):
        torch.manual_seed(config.seed * 1_000_003 + step * processes + rank)
        factor = recipe.rate(step, config.steps)
        for group, rate in zip(optimiser.param_groups, base_rates, strict=True):
            group["lr"] = rate * factor
        losses = _optimise(recipe, wrapped, optimiser, _to(batch, device), config.precision)
        value = float(losses["loss"].detach())
        if not math.isfinite(value):
            raise TensorsimError(f"fit: the loss of step {step} is {value}; lower the learning rate")
        averaged.update_parameters(recipe.net)

        done, trained = step + 1, trained + config.batch
        bar.update()
        if log and (done % config.log_every == 0 or done == config.steps):
            values = {name: float(value.detach()) for name, value in losses.items()}
            bar.set_postfix({name: f"{value:.4g}" for name, value in values.items()})
            speed = trained / (time.perf_counter() - began)
            log.write(done, values | {"rate": factor, "samples_per_s": speed})
        if done % config.validate_every == 0 or done == config.steps:
            if log:
                figures = _validate(recipe, averaged.module)
                log.write(done, {f"validation/{name}": value for name, value in figures.items()})
                bar.write(f"step {done}: " + ", ".join(f"{k} {v:.4g}" for k, v in figures.items()))
                if not math.isfinite(figures["score"]):
                    raise TensorsimError(
                        f"fit: the score of step {done} is {figures['score']}, expected a number"
                    )
                if figures["score"] > best["score"]:
                    best = figures | {"step": float(done)}
                    save_weights(averaged.module, config.out / "best.safetensors", recipe.metadata)
            if processes > 1:
                distributed.barrier()
        if log and (done % config.checkpoint_every == 0 or done == config.steps):
            recipe.processor_s = time.process_time() - started
            _save(last, done, best, recipe, config, averaged, optimiser)
    bar.close()
    if log:
        log.close()
    if processes > 1:
        distributed.destroy_process_group()
    return best


def _joined(config: LoopConfig, processes: int) -> torch.device:
    """The device of this process, which joins the process group if there are several."""
    device = usable_device(config.device)
    if processes > 1:
        if device.type == "cuda":
            device = torch.device("cuda", int(os.environ["LOCAL_RANK"]))
            torch.cuda.set_device(device)
        distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    if config.batch % processes:
        raise TensorsimError(
            f"fit: got a batch of {config.batch}, expected a multiple of {processes} processes"
        )
    return device


def _optimise(
    recipe: Recipe, net: nn.Module, optimiser: torch.optim.Optimizer, batch: Batch, precision: str
) -> dict[str, Tensor]:
    """One optimiser step; returns the losses before it."""
    recipe.net.train()
    device = next(net.parameters()).device.type
    with torch.autocast(device, torch.bfloat16, enabled=precision == "bfloat16"):
        losses = recipe.loss(net, batch)
    optimiser.zero_grad(set_to_none=True)
    losses["loss"].backward()
    optimiser.step()
    return losses


def _batches(loader: DataLoader[Batch]) -> Iterator[Batch]:
    """Batches; an error in a worker is re-raised without the traceback that torch adds to its message."""
    try:
        yield from loader
    except TensorsimError as error:
        raise TensorsimError(str(error).strip().rpartition("TensorsimError: ")[2]) from error


def _decay(decay: float, count: int) -> float:
    # A short average at first; otherwise the random initial weights would stay in it for long.
    return min(decay, (1 + count) / (10 + count))


def _to(batch: Any, device: torch.device) -> Any:
    if isinstance(batch, Tensor):
        channels_last = batch.ndim == 4 and batch.is_floating_point()
        return batch.to(
            device,
            non_blocking=True,
            memory_format=torch.channels_last if channels_last else torch.preserve_format,
        )
    if isinstance(batch, dict):
        return {key: _to(value, device) for key, value in batch.items()}
    if isinstance(batch, (list, tuple)):
        return [_to(value, device) for value in batch]
    return batch


def _validate(recipe: Recipe, net: nn.Module) -> dict[str, float]:
    was_training = net.training
    net.eval()
    with torch.no_grad():
        figures = recipe.validate(net)
    net.train(was_training)
    return figures


def _save(
    path: Path,
    step: int,
    best: dict[str, float],
    recipe: Recipe,
    config: LoopConfig,
    averaged: AveragedModel,
    optimiser: torch.optim.Optimizer,
) -> None:
    state = {
        "step": step,
        "best": best,
        "loop": config.fingerprint(),
        "recipe": recipe.settings,
        "processor_s": recipe.processor_s,
        "net": recipe.net.state_dict(),
        "averaged": averaged.state_dict(),
        "optimiser": optimiser.state_dict(),
    }
    # Not directly into the file: torch reports a full disk as an internal assertion.
    content = io.BytesIO()
    torch.save(state, content)
    write_bytes(path, content.getbuffer())


def _read(path: Path) -> dict[str, Any]:
    """Read what :func:`_save` wrote."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    # A truncated file fails in the archive, in the pickle or in the tensors, each with its own exception.
    except (OSError, EOFError, RuntimeError, ValueError, KeyError, pickle.UnpicklingError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0][:100]
        raise TensorsimError(
            f"{path}: damaged, training cannot resume from it ({reason}); remove it to start again"
        ) from error
    parts = {"step", "best", "loop", "recipe", "net", "averaged", "optimiser"}
    if not isinstance(state, dict) or not parts <= state.keys():
        raise TensorsimError(f"{path}: not a training checkpoint, expected {', '.join(sorted(parts))} in it")
    return state


def _shapes(weights: dict[str, Tensor]) -> dict[str, tuple[int, ...]]:
    return {name: tuple(value.shape) for name, value in weights.items()}


def _resume(
    path: Path,
    recipe: Recipe,
    config: LoopConfig,
    averaged: AveragedModel,
    optimiser: torch.optim.Optimizer,
) -> tuple[int, dict[str, float]]:
    state = _read(path)
    for there, mine in (
        (state["loop"], config.fingerprint()),
        (state["recipe"], recipe.settings),
        (_shapes(state["net"]), _shapes(recipe.net.state_dict())),
    ):
        differ = [key for key in {**there, **mine} if there.get(key) != mine.get(key)]
        if differ:
            reason = ", ".join(
                f"{key}: {mine.get(key)!r} for {there.get(key)!r}" for key in sorted(differ)[:4]
            )
            raise TensorsimError(
                f"{path}: it belongs to another run ({reason}); choose another folder, or the same settings"
            )
    recipe.processor_s = float(state.get("processor_s", 0.0))
    recipe.net.load_state_dict(state["net"])
    averaged.load_state_dict(state["averaged"])
    optimiser.load_state_dict(state["optimiser"])
    return int(state["step"]), state["best"]
