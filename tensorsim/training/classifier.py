"""The recipe of the activity classifiers: cross-entropy on stored pictures, with new noise for every use."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tensorsim.config import ACTIVITIES
from tensorsim.errors import TensorsimError, check_choice, check_distinct
from tensorsim.recognition.map_image import scaled
from tensorsim.recognition.spgnet import SPGNet
from tensorsim.recognition.spnet import SPNet
from tensorsim.training.loop import Batch, Recipe, decay_groups
from tensorsim.training.maps import MapStore
from tensorsim.training.order import shuffled
from tensorsim.weights import load_state_dict, load_strict

#: Networks by name, each with the picture size used by its authors.
NETWORKS: dict[str, tuple[type[nn.Module], int]] = {"spnet": (SPNet, 224), "spgnet": (SPGNet, 32)}
RANGE_DB = 40.0
LEARNING_RATE = 1.47e-3
#: Offset between the seeds of masks and of other draws for a picture: with equal seeds, the clearest pictures would be
#: masked most. Below 2**32, because the CPU generator uses only the low 32 bits of a seed.
MASK_STREAM = 0x9E3779B1


class Clip(NamedTuple):
    """One clip of a store."""

    scene: str
    person: int
    activity: int


def held_out(person: int) -> bool:
    """Whether a person is held out for validation: every fifth."""
    return person % 5 == 4


def check_drawn(
    snr_db: tuple[float, float],
    masks: tuple[float, float],
    snr_name: str = "snr_db",
    masks_name: str = "masks",
) -> None:
    """Refuse a range of ratios that does not ascend, and masks outside of 0 to 1.

    Raises:
        TensorsimError: refers to them by these names.
    """
    low, high = snr_db
    if not low <= high:
        raise TensorsimError(f"{snr_name}: got {low:g} {high:g}, expected the lower one first")
    if not all(0 <= part <= 1 for part in masks):
        raise TensorsimError(f"{masks_name}: got {masks}, expected parts of a picture from 0 to 1")


def check_ratios(snr_db: Sequence[float], name: str = "snr_db") -> None:
    """Refuse a list of ratios that is empty, or has duplicates or values that are not finite.

    Raises:
        TensorsimError: refers to them by this name.
    """
    if len(snr_db) == 0:
        raise TensorsimError(f"{name}: got no ratios, expected at least one")
    for ratio in snr_db:
        if not math.isfinite(ratio):
            raise TensorsimError(f"{name}: got {ratio:g}, expected finite numbers of dB")
    check_distinct(snr_db, name)


def clips_of(
    store: MapStore, scenes: Sequence[str], people: int | None, validation: bool | None
) -> list[Clip]:
    """Clips of the first ``people`` people of a store (None: all); all of training and validation if ``validation`` is
    None.

    Raises:
        TensorsimError: the store has fewer people, or no clips of this part.
    """
    clips = []
    for scene in scenes:
        there = store.people[scene]
        if people is not None and len(there) < people:
            raise TensorsimError(f"{store.folder}: got {len(there)} people in {scene}, expected {people}")
        for person in there[:people]:
            if validation is None or held_out(person) == validation:
                clips += [Clip(scene, person, activity) for activity in range(len(ACTIVITIES))]
    if not clips:
        raise TensorsimError(f"{store.folder}: got no clips of {', '.join(scenes)}, expected some")
    return clips


def picture(store: MapStore, clip: Clip, snr_db: float, size: int) -> Tensor:
    """A stored clip as the input of a network: (1, size, size) in [0, 1].

    Raises:
        TensorsimError: the store's pictures are not a multiple of ``size``.
    """
    power = store.power(*clip, snr_db=snr_db)
    if power.shape[-1] % size:
        raise TensorsimError(f"picture: got size {size}, expected a divisor of the store's {power.shape[-1]}")
    pooled = F.avg_pool2d(power.unsqueeze(0), power.shape[-1] // size)
    return scaled(pooled, "db", RANGE_DB)


def drawn_snr(seed: int, index: int, snr_db: tuple[float, float]) -> float:
    """The ``index``-th draw of a stream, uniform between the two."""
    generator = torch.Generator().manual_seed(seed * 1_000_003 + index)
    return snr_db[0] + (snr_db[1] - snr_db[0]) * float(torch.rand((), generator=generator))


def masked(pictures: Tensor, largest: tuple[float, float], seed: int) -> Tensor:
    """Pictures (..., C, H, W) with a band of rows and one of columns set to 0, the floor of the picture.

    Source: D. S. Park et al., "SpecAugment: A Simple Data Augmentation Method for Automatic Speech Recognition",
    Interspeech 2019, without its warping of time.

    Args:
        pictures: not changed.
        largest: largest part of the rows and of the columns that a band covers; its width is uniform from 0.
        seed: seed of widths and places; the global random generator is unaffected.
    """
    if largest == (0.0, 0.0):
        return pictures
    from torchaudio.functional import mask_along_axis

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        for axis, part in zip((-2, -1), largest, strict=True):
            dim = pictures.dim() + axis
            pictures = mask_along_axis(pictures, round(part * pictures.shape[dim]), 0.0, dim)
    return pictures


class ClassifierRecipe(Recipe):
    """The paper's protocol: Adam 1.47e-3, coupled L2 1e-4 on weights, a tenth of the rate in the second half.

    Args:
        network: a name of :data:`NETWORKS`.
        store: pictures of at least ``people`` people in each scene.
        scenes: scenes to train on.
        people: number of people; every fifth is held out.
        snr_db: (lowest, highest) ratio, drawn for each picture; (50, 50) is the paper's.
        seed: seed of weights, order and noise.
        init: weights to start from.
        size: height and width of the pictures, a divisor of the store's; None takes that of :data:`NETWORKS`.
        filmed: a second store to train on as well, of motion estimated from films.
        filmed_people: number of people in it.
        learning_rate: learning rate of the first half.
        masks: largest part of the rows (speeds) and of the columns (time) of a picture that is masked in training;
            width and place are drawn each time; (0, 0) masks nothing. See :func:`masked`.

    Raises:
        TensorsimError: an unknown network, a range that does not ascend, masks outside of 0 to 1, or a store with
            too few people.
    """

    def __init__(
        self,
        network: str,
        store: MapStore,
        scenes: Sequence[str],
        people: int,
        snr_db: tuple[float, float] = (10.0, 50.0),
        seed: int = 0,
        init: Path | None = None,
        size: int | None = None,
        filmed: MapStore | None = None,
        filmed_people: int = 40,
        learning_rate: float = LEARNING_RATE,
        masks: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        check_choice(network, NETWORKS, "network")
        check_drawn(snr_db, masks)
        self.snr_db, self.seed, self.masks = snr_db, seed, masks
        stores = [(store, people)] if filmed is None else [(store, people), (filmed, filmed_people)]
        self.training = [(s, clip) for s, n in stores for clip in clips_of(s, scenes, n, validation=False)]
        self.validation = {
            "" if s is store else " films": (s, clips_of(s, scenes, n, validation=True)) for s, n in stores
        }
        kind, usual = NETWORKS[network]
        self.size = usual if size is None else size
        torch.manual_seed(seed)
        net = kind(len(ACTIVITIES))
        settings: dict[str, Any] = {
            "network": network,
            "size": self.size,
            "scenes": list(scenes),
            "people": people,
            "snr_db": list(snr_db),
            "seed": seed,
            "store_seed": store.settings.seed,
            "learning_rate": learning_rate,
            "masks": list(masks),
            "filmed": None if filmed is None else [filmed.settings.seed, filmed_people],
            "films": None if filmed is None else filmed.settings.films,
        }
        metadata = {
            "network": kind.__name__,
            "size": str(self.size),
            "speed_m_s": str(store.settings.speed_m_s),
            "range_db": str(RANGE_DB),
        }
        super().__init__(net, settings, metadata)
        some = [self.sample(index)["picture"].mean() for index in range(200)]
        net.get_buffer("mean").fill_(float(torch.stack(some).mean()))
        if init is not None:
            load_strict(net, load_state_dict(init), init)

    def sample(self, index: int) -> dict[str, Any]:
        """Picture (1, H, W) and label."""
        store, clip = self.training[shuffled(index, len(self.training), self.seed)]
        snr_db = drawn_snr(self.seed, index, self.snr_db)
        seed = self.seed * 1_000_003 + index + MASK_STREAM
        look = masked(picture(store, clip, snr_db, self.size), self.masks, seed)
        return {"picture": look, "label": clip.activity}

    def loss(self, net: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """Cross-entropy and accuracy."""
        logits = net(batch["picture"]).float()
        accuracy = (logits.argmax(-1) == batch["label"]).float().mean()
        return {"loss": F.cross_entropy(logits, batch["label"]), "accuracy": accuracy}

    def optimiser(self) -> torch.optim.Optimizer:
        """Adam; no L2 on biases and normalisation."""
        return torch.optim.Adam(decay_groups(self.net, 1e-4), lr=self.settings["learning_rate"])

    def rate(self, step: int, steps: int) -> float:
        """1, and 0.1 in the second half."""
        return 1.0 if 2 * step < steps else 0.1

    def validate(self, net: nn.Module) -> dict[str, float]:
        """Accuracy in each scene and the mean loss, at fixed random ratios; the score is the negative loss."""
        losses, figures = [], {}
        for name, (store, clips) in self.validation.items():
            logits = logits_of(net, store, clips, self.snr_db, self.size)
            labels = torch.tensor([clip.activity for clip in clips])
            losses.append(float(F.cross_entropy(logits, labels)))
            correct = (logits.argmax(-1) == labels).float()
            for scene in self.settings["scenes"]:
                of_scene = torch.tensor([clip.scene == scene for clip in clips])
                figures[f"accuracy {scene}{name}"] = float(correct[of_scene].mean())
        loss = sum(losses) / len(losses)
        return {"score": -loss, "loss": loss} | figures


def mean_both_ways(net: nn.Module, pictures: Tensor) -> Tensor:
    """Mean logits (N, classes) of pictures (N, C, H, W) and the same pictures with approach and retreat swapped."""
    logits: Tensor = 0.5 * (net(pictures) + net(pictures.flip(-2)))
    return logits


@torch.no_grad()
def logits_of(
    net: nn.Module,
    store: MapStore,
    clips: Sequence[Clip],
    snr_db: tuple[float, float],
    size: int,
    batch: int = 64,
    either_way: bool = False,
) -> Tensor:
    """Logits (N, classes) of N clips, on the CPU. Clip k gets the k-th draw of the ratios for every network.

    ``either_way`` averages over both Doppler directions, as :class:`~tensorsim.recognition.ActivityRecognizer` does.
    """
    parameter = next(net.parameters())
    found = []
    for first in range(0, len(clips), batch):
        pictures = [
            picture(store, clip, drawn_snr(10_007, first + k, snr_db), size)
            for k, clip in enumerate(clips[first : first + batch])
        ]
        x = torch.stack(pictures).to(parameter, memory_format=torch.channels_last)
        logits = mean_both_ways(net, x) if either_way else net(x)
        found.append(logits.float().cpu())
    return torch.cat(found)
