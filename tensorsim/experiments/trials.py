"""One training of a recogniser and its test, the unit of the experiments; each runs in its own process.

The protocol is the paper's: cross-entropy, Adam with a learning rate of 1.47e-3 and a tenth of it in the second half,
L2 of 1e-4 on weights, batches of 64, 20 epochs, pictures at 50 dB, people split 8:2, the epoch with the lowest
validation loss. In addition, accuracy is measured on people who are in neither part.
"""

import io
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from tqdm import tqdm

from tensorsim.config import ACTIVITIES
from tensorsim.config.documents import digest
from tensorsim.errors import TensorsimError, check_choice
from tensorsim.evaluation.measured.training import predict
from tensorsim.experiments.pictures import INPUTS, SNR_DB, PictureSet
from tensorsim.experiments.work import Work, read_result, write_result
from tensorsim.process import end_with_parent
from tensorsim.recognition.confusion import confusion
from tensorsim.recognition.networks import find_classifier
from tensorsim.training.classifier import LEARNING_RATE, held_out
from tensorsim.training.loop import Batch, LoopConfig, Recipe, decay_groups, fit
from tensorsim.training.order import shuffled
from tensorsim.weights import load_state_dict, load_strict

L2 = 1e-4


@dataclass(frozen=True)
class Trial:
    """A network and what it is trained and tested on.

    Attributes:
        network: a name of :data:`tensorsim.recognition.networks.CLASSIFIERS`.
        scene: name of one of the paper's two presets.
        inputs: a key of :data:`tensorsim.experiments.pictures.INPUTS`.
        clips: clips per class for training and validation; every fifth person is for validation.
        test_clips: test clips per class, of other people.
        size: height and width of the pictures.
        epochs: passes over the training clips.
        batch: clips per step.
        seed: seed of weights and order.
        maps_seed: seed of people, motion and noise.
    """

    network: str
    scene: str
    inputs: str = "doppler"
    clips: int = 300
    test_clips: int = 60
    size: int = 64
    epochs: int = 20
    batch: int = 64
    seed: int = 0
    maps_seed: int = 0

    def check(self) -> None:
        """Raises TensorsimError: an unknown network or input, or counts out of range."""
        find_classifier(self.network)
        check_choice(self.inputs, INPUTS, "inputs")
        if self.clips < 5 or self.test_clips < 1:
            raise TensorsimError(
                f"clips: got {self.clips} to train on and {self.test_clips} to test on, expected at least 5 and 1"
            )
        if self.epochs < 1 or self.batch < 2:
            raise TensorsimError(
                f"epochs, batch: got {self.epochs} and {self.batch}, expected at least 1 and 2"
            )
        if self.size < 32 or self.size % 16:
            raise TensorsimError(f"size: got {self.size}, expected a multiple of 16, at least 32")

    @property
    def name(self) -> str:
        """Name of its folder."""
        return f"{self.network}-{self.scene}-{self.inputs}-seed{self.seed}-{self.training}"

    @property
    def training(self) -> str:
        """Digest of what the training depends on: everything but the number of test clips."""
        return digest(replace(self, test_clips=0))

    def pictures(self, work: Work) -> PictureSet:
        """The pictures that it needs."""
        return PictureSet(work, self.scene, self.size, self.maps_seed)

    def network_module(self) -> nn.Module:
        """The network, with new weights."""
        return find_classifier(self.network).build(len(ACTIVITIES), INPUTS[self.inputs], self.size)


class PaperRecipe(Recipe):
    """The protocol of this module, on pictures (N, C, H, W) with labels (N,) for training and for validation."""

    def __init__(
        self, trial: Trial, net: nn.Module, training: tuple[Tensor, Tensor], validation: tuple[Tensor, Tensor]
    ) -> None:
        self.training, self.validation, self.seed = training, validation, trial.seed
        net.get_buffer("mean").copy_(training[0].mean((0, 2, 3)))
        stated = {"network": type(net).__name__, "size": str(trial.size), "inputs": trial.inputs}
        super().__init__(net, {"trial": trial.training}, stated)

    def sample(self, index: int) -> dict[str, Any]:
        """Picture and label; clips come in a new order in each epoch."""
        chosen = shuffled(index, len(self.training[1]), self.seed)
        return {"picture": self.training[0][chosen], "label": int(self.training[1][chosen])}

    def loss(self, net: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """Cross-entropy."""
        return {"loss": F.cross_entropy(net(batch["picture"]).float(), batch["label"])}

    def optimiser(self) -> torch.optim.Optimizer:
        """Adam; no L2 on biases and normalisation."""
        return torch.optim.Adam(decay_groups(self.net, L2), lr=LEARNING_RATE)

    def rate(self, step: int, steps: int) -> float:
        """1, and 0.1 in the second half."""
        return 1.0 if 2 * step < steps else 0.1

    def validate(self, net: nn.Module) -> dict[str, float]:
        """Accuracy and loss; the score is the negative loss."""
        found = predict(net, self.validation[0], batch=64)
        loss = float(F.cross_entropy(found, self.validation[1]))
        accuracy = float((found.argmax(1) == self.validation[1]).float().mean())
        return {"score": -loss, "loss": loss, "accuracy": accuracy}


def run_trial(trial: Trial, ratios: tuple[float, ...], work: Work) -> dict[str, Any]:
    """Train (or resume), test at every ratio in dB, and keep the result; kept results are not computed again.

    Returns:
        ``validation`` (accuracy), ``training_s`` (processor time), ``epoch`` of the weights, and ``confusion``:
        counts by ratio.
    """
    folder = work.cache / "trials" / trial.name
    path = folder / "result.json"
    result: dict[str, Any] = read_result(path) if path.is_file() else {}
    weights = folder / "best.safetensors"
    if "validation" not in result or not weights.is_file():
        result = _train(trial, folder, work)
        write_result(path, result)
        (folder / "last.pt").unlink(missing_ok=True)
    counts = result["confusion"].setdefault(str(trial.test_clips), {})
    missing = [ratio for ratio in ratios if f"{ratio:g}" not in counts]
    if missing:
        net = trial.network_module().eval()
        load_strict(net, load_state_dict(weights), weights)
        people = range(trial.clips, trial.clips + trial.test_clips)
        for ratio in missing:
            pictures, labels = trial.pictures(work).get(people, trial.inputs, ratio)
            counts[f"{ratio:g}"] = confusion(predict(net, pictures, batch=64), labels).tolist()
        write_result(path, result)
    return result | {"confusion": counts}


def _train(trial: Trial, folder: Path, work: Work) -> dict[str, Any]:
    pictures, labels = trial.pictures(work).get(range(trial.clips), trial.inputs, SNR_DB)
    kept_out = torch.tensor([held_out(person) for person in range(trial.clips)])
    kept_out = kept_out.repeat_interleave(len(ACTIVITIES))
    torch.manual_seed(trial.seed)
    net = trial.network_module()
    recipe = PaperRecipe(
        trial, net, (pictures[~kept_out], labels[~kept_out]), (pictures[kept_out], labels[kept_out])
    )
    epoch = max(1, round(int((~kept_out).sum()) / trial.batch))
    config = LoopConfig(
        folder,
        steps=trial.epochs * epoch,
        batch=trial.batch,
        seed=trial.seed,
        device="cpu",
        workers=0,
        precision="float32",
        checkpoint_every=max(1, trial.epochs * epoch // 4),
        validate_every=epoch,
        ema_decay=0.0,
        quiet=True,
        events=False,
    )
    figures = fit(recipe, config)
    return {
        "validation": figures["accuracy"],
        "training_s": recipe.processor_s,
        "epoch": round(figures["step"] / epoch),
        "confusion": {},
    }


def _one_thread(trial: Trial, ratios: tuple[float, ...], work: Work) -> dict[str, Any]:
    torch.set_num_threads(1)
    try:
        with redirect_stdout(io.StringIO()):  # the loop prints every validation
            return run_trial(trial, ratios, work)
    except TensorsimError as error:
        raise TensorsimError(f"{trial.name}: {error}") from None
    except RuntimeError as error:
        # torch reports a full disk as an error of its archive.
        if "PytorchStreamWriter" in str(error) or "inline_container" in str(error):
            raise TensorsimError(f"{work.cache}: could not write a checkpoint, is the disk full?") from None
        raise


def run_trials(trials: Sequence[Trial], ratios: tuple[float, ...], work: Work) -> list[dict[str, Any]]:
    """Results of all trials in order, ``work.jobs`` at a time, each in its own process.

    Raises:
        TensorsimError: see :class:`Trial`; a training that fails.
    """
    for trial in trials:
        trial.check()
    kept = [_kept(trial, ratios, work) for trial in trials]
    waiting = [k for k, result in enumerate(kept) if result is None]
    found = {k: result for k, result in enumerate(kept) if result is not None}
    for k in waiting:
        trials[k].pictures(work).prepare(trials[k].clips + trials[k].test_clips, trials[k].inputs)
    pool = ProcessPoolExecutor(work.jobs, get_context("spawn"), end_with_parent, max_tasks_per_child=1)
    with tqdm(total=len(waiting), desc="trainings", unit="training", disable=work.quiet) as bar:
        try:
            futures = {pool.submit(_one_thread, trials[k], ratios, work): k for k in waiting}
            for future in as_completed(futures):
                found[futures[future]] = future.result()
                bar.update()
        except BrokenProcessPool:
            raise TensorsimError(
                "a training ended without a result: was it killed, or out of memory?"
            ) from None
        except BaseException:
            for child in active_children():  # otherwise they would train to the end
                child.terminate()
            raise
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
    return [found[k] for k in range(len(trials))]


def _kept(trial: Trial, ratios: tuple[float, ...], work: Work) -> dict[str, Any] | None:
    """The result of a trial if it is complete, else None."""
    path = work.cache / "trials" / trial.name / "result.json"
    result = read_result(path) if path.is_file() else {}
    counts = result.get("confusion", {}).get(str(trial.test_clips), {})
    complete = {f"{ratio:g}" for ratio in ratios} <= set(counts)
    return result | {"confusion": counts} if complete else None
