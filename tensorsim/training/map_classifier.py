"""The recipe of a classifier for your own classes: cross-entropy on a data set made by ``tensorsim dataset build``."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.data import DataLoader

from tensorsim.data.sets.reading import MapDataset, collate_maps
from tensorsim.data.sets.transforms import RandomShift, SpecAugment
from tensorsim.errors import TensorsimError, check_choice
from tensorsim.recognition.confusion import confusion
from tensorsim.recognition.labels import LabelSet
from tensorsim.training.classifier import LEARNING_RATE, NETWORKS
from tensorsim.training.loop import Batch, Recipe, decay_groups
from tensorsim.training.order import shuffled
from tensorsim.weights import load_state_dict


class PictureToLabel(nn.Module):
    """Maps of a data set to logits: resized to the input size of the network.

    Args:
        network: pictures (B, C, size, size) in [0, 1] -> logits (B, classes).
        size: height and width of the input.

    Shapes: maps (B, C, H, W) in [0, 1] -> (B, classes). Differentiable.
    """

    def __init__(self, network: nn.Module, size: int) -> None:
        super().__init__()
        self.network, self.size = network, size

    def forward(self, maps: Tensor) -> Tensor:
        """Maps (B, C, H, W) to logits (B, classes)."""
        return self.network(F.interpolate(maps, [self.size, self.size], mode="bilinear", antialias=False))


def transfer(net: nn.Module, weights: dict[str, Tensor]) -> list[str]:
    """Copy the weights whose shapes fit into a network; returns the names of its other tensors, which are unchanged.

    For other classes, all but the last layer is copied.

    Raises:
        TensorsimError: fewer than half of the network's values fit.
    """
    own = net.state_dict()
    fitting = {k: v for k, v in weights.items() if k in own and v.shape == own[k].shape}
    if sum(own[k].numel() for k in fitting) < 0.5 * sum(v.numel() for v in own.values()):
        raise TensorsimError(
            "--init: got weights of another network, expected those of the network being trained"
        )
    net.load_state_dict(own | fitting)
    return [name for name in own if name not in fitting]


class MapRecipe(Recipe):
    """Adam, coupled L2 1e-4 on weights, a tenth of the rate after half of the steps, as for the shipped classifiers.

    All classes have equal weight, whatever their numbers of samples. Training maps are shifted slightly in speed and
    time, and masked by SpecAugment.

    Args:
        folder: folder of the data set, with a validation part.
        network: a name in ``tensorsim.training.classifier.NETWORKS``.
        labels: classes to train on; None: all.
        output, radars: see :class:`~tensorsim.data.MapDataset`.
        size: height and width of the network's pictures; None takes that of its authors.
        init: weights of the same network to start from; layers of another shape are newly initialised.
        seed: seed of weights, order and augmentation.
        learning_rate: learning rate of the first half.
        masks: largest parts of rows and columns that are masked.

    Raises:
        TensorsimError: no such data set, or one without a training or validation part; see :class:`MapDataset`.
    """

    def __init__(
        self,
        folder: Path,
        network: str = "spgnet",
        labels: Sequence[str] | None = None,
        output: str | None = None,
        radars: Sequence[str] | None = None,
        size: int | None = None,
        init: Path | None = None,
        seed: int = 0,
        learning_rate: float = LEARNING_RATE,
        masks: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        check_choice(network, NETWORKS, "network")
        self.training = MapDataset(folder, "train", output, radars, labels)
        self.validation = MapDataset(folder, "validation", output, radars, self.training.labels)
        self.seed, self.labels = seed, LabelSet(self.training.labels)
        kind, usual = NETWORKS[network]
        self.size = usual if size is None else size
        torch.manual_seed(seed)
        net = PictureToLabel(kind(len(self.labels), len(self.training.names)), self.size)
        self.augment = nn.Sequential(RandomShift(2, 4), SpecAugment(*masks)).train()
        self.weights = self.training.class_weights()
        self.learning_rate = learning_rate
        settings: dict[str, Any] = {
            "data": self.training.digest, "network": network, "labels": list(self.labels), "size": self.size,
            "maps": list(self.training.names), "seed": seed,
            "learning_rate": learning_rate, "masks": list(masks),
        }  # fmt: skip
        super().__init__(net, settings, self._metadata(kind.__name__))
        some = torch.stack([self.training[k]["map"].mean() for k in range(min(200, len(self.training)))])
        net.network.get_buffer("mean").fill_(float(some.mean()))
        if init is not None:
            # Weight files of recognisers hold only the network.
            found = load_state_dict(init)
            prefixed = {k if k.startswith("network.") else f"network.{k}": v for k, v in found.items()}
            self.new_layers = transfer(net, prefixed)

    def _metadata(self, network: str) -> dict[str, str]:
        outputs = self.training.recipe.outputs
        return {
            "network": network,
            "maps": ",".join(self.training.names),
            "map_size": str(self.size),
            "class_names": self.labels.to_text(),
            "speed_m_s": repr(outputs.picture_speed_m_s),
            "range_db": repr(outputs.picture_range_db),
        }

    def sample(self, index: int) -> dict[str, Any]:
        """Map (C, H, W), label and id of the sample."""
        return self.training[shuffled(index, len(self.training), self.seed)]

    def collate(self, samples: list[dict[str, Any]]) -> Batch:
        """Maps and labels of samples."""
        batch = collate_maps(samples)
        return {"map": batch["map"], "label": batch["label"]}

    def loss(self, net: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """Cross-entropy over augmented maps, and accuracy."""
        logits = net(self.augment(batch["map"])).float()
        accuracy = (logits.argmax(-1) == batch["label"]).float().mean()
        return {
            "loss": F.cross_entropy(logits, batch["label"], self.weights.to(logits)),
            "accuracy": accuracy,
        }

    def optimiser(self) -> torch.optim.Optimizer:
        """Adam; no L2 on biases and normalisation."""
        return torch.optim.Adam(decay_groups(self.net, 1e-4), lr=self.learning_rate)

    def rate(self, step: int, steps: int) -> float:
        """1, and 0.1 in the second half."""
        return 1.0 if 2 * step < steps else 0.1

    def validate(self, net: nn.Module) -> dict[str, float]:
        """Accuracy and mean loss; the score is the negative loss."""
        logits = logits_of(net, self.validation)
        loss = float(F.cross_entropy(logits, self.validation.targets))
        accuracy = float((logits.argmax(-1) == self.validation.targets).float().mean())
        return {"score": -loss, "loss": loss, "accuracy": accuracy}


@torch.no_grad()
def logits_of(net: nn.Module, maps: MapDataset, batch: int = 64) -> Tensor:
    """Logits (N, classes) of all samples in order, on the CPU."""
    device = next(net.parameters()).device
    loader: DataLoader[dict[str, Any]] = DataLoader(maps, batch, collate_fn=collate_maps)
    return torch.cat([net(part["map"].to(device)).float().cpu() for part in loader])


def confusion_markdown(table: Tensor, labels: Sequence[str]) -> str:
    """A confusion matrix as a table: rows are true, columns predicted."""
    lines = ["| true \\ predicted | " + " | ".join(labels) + " |", "|---|" + "---|" * len(labels)]
    for label, row in zip(labels, table.tolist(), strict=True):
        lines.append(f"| {label} | " + " | ".join(str(count) for count in row) + " |")
    return "\n".join(lines) + "\n"


def write_outcome(recipe: MapRecipe, best: Path) -> None:
    """Write the results of the best weights next to them: confusion matrix, and the network as TorchScript and ONNX.

    If it was trained on pictures of a single radar at their own size, ``recognizer.safetensors`` is written too, for
    :class:`~tensorsim.recognition.ActivityRecognizer` and ``tensorsim simulate --classifier``.
    """
    from tensorsim.export import to_onnx, to_torchscript
    from tensorsim.files import write_text
    from tensorsim.weights import load_strict, save_weights

    folder, net = best.parent, recipe.net
    assert isinstance(net, PictureToLabel)
    load_strict(net, load_state_dict(best), best)
    net = net.cpu().eval()
    maps = recipe.validation
    table = confusion_markdown(confusion(logits_of(net, maps), maps.targets), list(recipe.labels))
    write_text(folder / "confusion.md", f"Part validation, {len(maps)} samples.\n\n{table}")
    print(table, end="")
    to_torchscript(net, folder / "picture_to_label.pt")
    example = torch.stack([maps[0]["map"]] * 2)
    to_onnx(net, folder / "picture_to_label.onnx", (example,), {0: {0: "batch"}})
    outputs = maps.recipe.outputs
    if maps.names[0].endswith(".picture") and len(maps.names) == 1 and outputs.picture_size == recipe.size:
        stated = {k: v for k, v in recipe.metadata.items() if k not in ("maps", "map_size")}
        save_weights(
            net.network,
            folder / "recognizer.safetensors",
            stated | {"inputs": "doppler", "size": str(recipe.size)},
        )
