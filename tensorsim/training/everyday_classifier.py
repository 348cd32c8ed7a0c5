"""The recipe of the activity classifiers for films: cross-entropy on stored pictures of everyday motion."""

import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tensorsim.config import ACTIVITIES
from tensorsim.errors import TensorsimError
from tensorsim.radar.presets import PRESETS
from tensorsim.recognition.calibration import expected_calibration_error, fit_temperature
from tensorsim.recognition.map_image import MapToImage, area_weights, scaled
from tensorsim.recognition.networks import find_classifier
from tensorsim.training.classifier import MASK_STREAM, RANGE_DB, held_out
from tensorsim.training.everyday_maps import EverydayStore
from tensorsim.training.expected_map import noise_rows
from tensorsim.training.loop import Batch, Recipe, decay_groups
from tensorsim.training.maps import SCENES
from tensorsim.training.order import shuffled
from tensorsim.weights import load_state_dict, load_strict, save_weights

#: Level of the added noise, in dB relative to the peak of the picture.
NOISE_DB = (-70.0, -8.0)
#: Largest part of a clip that is cut off at each end, and of the rows and columns that are masked.
CUT, MASKED = 0.08, 0.12
#: Share of the pictures that are folded, and of the walks in which the person arrives late or leaves early.
FOLDED, PASSING = 0.2, 0.4
WALKING = ACTIVITIES.index("S8 Walking")
#: Activities by index, and what each becomes when reversed in time; falling and getting up do not become each other.
REVERSED = {0: 0, 1: 1, 2: 2, 3: 3, 4: 5, 5: 4, 6: 6, 7: 7, 8: 9, 9: 8}
#: Label smoothing: this much of the probability is spread over all classes.
SMOOTHING = 0.05


def folded(power: Tensor) -> Tensor:
    """A power picture (H, W) with both signs of speed added, as from a single-channel radar without range."""
    both = power + power.flip(0)
    return both / both.max().clamp(min=1e-30)


def passing(power: Tensor, late: float, early: float) -> Tensor:
    """A power picture (H, W) without a share of the time at its start (``late``) and end (``early``); peak 1."""
    time = (torch.arange(power.shape[1]) + 0.5) / power.shape[1]
    seen = power * ((time >= late) & (time <= 1 - early))
    return seen / seen.max().clamp(min=1e-30)


def augmented(power: Tensor, activity: int, noise: Tensor, generator: torch.Generator) -> tuple[Tensor, int]:
    """A power picture (H, W) changed to look like another clip, and the activity of that clip.

    Approach and retreat are swapped in half of the cases (every activity is done in every heading), some pictures
    are folded, some walkers arrive late or leave early (which is not a fall), time runs backwards in half of those in
    :data:`REVERSED`, the ends are cut a little, and noise is added.

    Args:
        power: (H, W) with a peak of 1.
        activity: its index.
        noise: (H,) expected power of noise in the rows, with a peak of 1.
        generator: random generator of everything.
    """
    flip, back, first, last, level, fold, passes, late, early = torch.rand(9, generator=generator).tolist()
    if flip < 0.5:
        power = power.flip(0)
    if fold < FOLDED:
        power = folded(power)
    if activity == WALKING and passes < PASSING:
        # Half of them are present from the start, and half until the end.
        power = passing(power, max(0.0, 0.9 * late - 0.45), max(0.0, 0.9 * early - 0.45))
    if back < 0.5 and activity in REVERSED:
        power, activity = power.flip(1), REVERSED[activity]
    width = power.shape[1]
    start = torch.arange(width, dtype=torch.float64)
    columns = area_weights(start, 1.0, CUT * first * width, (1 - CUT * last) * width, width).to(power)
    low, high = NOISE_DB
    floor = 10 ** ((low + (high - low) * level) / 10)
    rough = 1 + 0.08 * torch.randn(power.shape, generator=generator)
    return power @ columns.T + floor * noise[:, None] * rough.clamp(min=0.5), activity


def masked(pictures: Tensor, generator: torch.Generator) -> Tensor:
    """Pictures (B, 1, H, W) with a band of rows and one of columns of each at 0, of random width and place."""
    for dim in (-2, -1):
        size = pictures.shape[dim]
        width = MASKED * size * torch.rand(len(pictures), 1, generator=generator)
        start = (size - width) * torch.rand(len(pictures), 1, generator=generator)
        at = torch.arange(size)
        band = (at >= start) & (at < start + width)
        band = band[:, None, :, None] if dim == -2 else band[:, None, None]
        pictures = pictures.masked_fill(band, 0.0)
    return pictures


class EverydayRecipe(Recipe):
    """Adam with a cosine schedule on pictures of everyday motion.

    Args:
        network: a name of :data:`tensorsim.recognition.networks.CLASSIFIERS`.
        store: pictures; every fifth group is held out.
        size: height and width of the pictures, a divisor of the store's; None takes the size used by the network's
            authors, at most the store's.
        seed: seed of weights, order and augmentation.
        init: weights to start from.
        learning_rate: peak learning rate.

    Raises:
        TensorsimError: an unknown network, a size that does not divide the store's, or a store without groups for
            training or validation.
    """

    def __init__(
        self,
        network: str,
        store: EverydayStore,
        size: int | None = None,
        seed: int = 0,
        init: Path | None = None,
        learning_rate: float = 1e-3,
    ) -> None:
        classifier = find_classifier(network)
        stored = store.settings.size
        self.size = min(classifier.size, stored) if size is None else size
        if stored % self.size:
            raise TensorsimError(f"size: got {self.size}, expected a divisor of the store's {stored}")
        aside = torch.tensor([held_out(group) for group in store.group.tolist()])
        scenes = torch.arange(len(SCENES))
        # Rows of (clip, scene).
        self.training = torch.cartesian_prod(torch.nonzero(~aside)[:, 0], scenes)
        self.validation = torch.cartesian_prod(torch.nonzero(aside)[:, 0], scenes)
        if len(self.training) == 0 or len(self.validation) == 0:
            raise TensorsimError(
                f"store: got {len(aside)} clips, expected groups for training and validation"
            )
        self.store, self.seed = store, seed
        rows = []
        for scene in SCENES:
            radar = PRESETS[scene].radar
            image = MapToImage.doppler(radar, store.settings.speed_m_s, stored)
            rows.append(noise_rows(radar, image))
        self.noise = torch.stack([row / row.max() for row in rows]).float()
        torch.manual_seed(seed)
        net = classifier.build(len(ACTIVITIES), size=self.size)
        settings: dict[str, Any] = {
            "network": network,
            "size": self.size,
            "seed": seed,
            "clips": len(aside),
            "store_seed": store.settings.seed,
            "learning_rate": learning_rate,
        }
        metadata = {
            "network": type(net).__name__,
            "size": str(self.size),
            "speed_m_s": str(store.settings.speed_m_s),
            "range_db": str(RANGE_DB),
            "either_way": "1",
        }
        super().__init__(net, settings, metadata)
        some = torch.stack([self.sample(index)["picture"] for index in range(200)])
        net.get_buffer("mean").fill_(float(some.mean()))
        if init is not None:
            load_strict(net, load_state_dict(init), init)

    def _input(self, power: Tensor) -> Tensor:
        """Power (H, W) to the network's input (1, size, size)."""
        return scaled(F.avg_pool2d(power[None], power.shape[-1] // self.size), "db", RANGE_DB)

    def sample(self, index: int) -> dict[str, Any]:
        """Picture (1, size, size) and label."""
        clip, scene = self.training[shuffled(index, len(self.training), self.seed)].tolist()
        generator = torch.Generator().manual_seed(self.seed * 1_000_003_139 + index)
        power, label = augmented(
            self.store.picture(clip, scene), int(self.store.activity[clip]), self.noise[scene], generator
        )
        return {"picture": self._input(power), "label": label, "index": index}

    def collate(self, samples: list[dict[str, Any]]) -> Batch:
        """A batch, with bands masked."""
        batch = super().collate(samples)
        seed = self.seed * 1_000_003_139 + samples[0]["index"] + MASK_STREAM
        generator = torch.Generator().manual_seed(seed)
        return {"picture": masked(batch["picture"], generator), "label": batch["label"]}

    def loss(self, net: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """Cross-entropy with smoothed labels, and accuracy."""
        logits = net(batch["picture"]).float()
        accuracy = (logits.argmax(-1) == batch["label"]).float().mean()
        return {
            "loss": F.cross_entropy(logits, batch["label"], label_smoothing=SMOOTHING),
            "accuracy": accuracy,
        }

    def optimiser(self) -> torch.optim.Optimizer:
        """AdamW; no decay of biases and normalisation."""
        return torch.optim.AdamW(decay_groups(self.net, 0.02), lr=self.settings["learning_rate"])

    def rate(self, step: int, steps: int) -> float:
        """A short warm-up, then half a cosine down to a hundredth."""
        rise = min(1.0, (step + 1) / (0.03 * steps + 1))
        return rise * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * step / steps)))

    @torch.no_grad()
    def judged(self, net: nn.Module, fold: bool = False) -> tuple[Tensor, Tensor]:
        """Logits (N, classes) and labels (N,) of the held-out clips, optionally folded, clip by clip in both scenes.

        Logits are averaged over both Doppler directions, as :class:`~tensorsim.recognition.ActivityRecognizer` does.
        """
        powers = [self.store.picture(clip, scene) for clip, scene in self.validation.tolist()]
        pictures = torch.stack([self._input(folded(power) if fold else power) for power in powers])
        like = next(net.parameters())
        both = [(part.to(like), part.to(like).flip(-2)) for part in pictures.split(64)]
        logits = [0.5 * (net(part) + net(other)).float().cpu() for part, other in both]
        return torch.cat(logits), self.store.activity[self.validation[:, 0]]

    def validate(self, net: nn.Module) -> dict[str, float]:
        """Accuracy on filmed, true and folded true motion in each scene; the loss; its negative as the score."""
        logits, labels = self.judged(net)
        right = (logits.argmax(-1) == labels).float()
        right_folded = (self.judged(net, fold=True)[0].argmax(-1) == labels).float()
        loss = float(F.cross_entropy(logits, labels))
        figures = {}
        clips, scenes = self.validation.T
        filmed = self.store.filmed[clips]
        for k, scene in enumerate(SCENES):
            here = scenes == k
            figures[f"{scene} filmed"] = float(right[here & filmed].mean())
            figures[f"{scene} true"] = float(right[here & ~filmed].mean())
            figures[f"{scene} folded"] = float(right_folded[here & ~filmed].mean())
        return {"score": -loss, "loss": loss} | figures


def load_between(net: nn.Module, first: Path, trained: Path, share: float) -> None:
    """Give a network weights interpolated linearly between those before and after a training.

    A network trained further on other data forgets some of the first data; the mean of the weights before and after
    keeps most of both (Wortsman et al., "Robust fine-tuning of zero-shot models", CVPR 2022).

    Args:
        net: the network.
        first: weights at the start.
        trained: weights at the end.
        share: fraction of the way from first to trained, 0 to 1.

    Raises:
        TensorsimError: a share outside of 0 to 1, or weights of another network.
    """
    if not 0 <= share <= 1:
        raise TensorsimError(f"share: got {share}, expected a number from 0 to 1")
    load_strict(net, load_state_dict(first), first)
    start = {name: value.clone() for name, value in net.state_dict().items()}
    load_strict(net, load_state_dict(trained), trained)
    for name, value in net.state_dict().items():
        if value.is_floating_point():
            value.copy_(torch.lerp(start[name], value, share))


def save_calibrated(recipe: EverydayRecipe, path: Path) -> tuple[float, float]:
    """Write the recipe's network with a softmax temperature fitted to the held-out films.

    Returns:
        The temperature, and the expected calibration error on these films with it.
    """
    logits, labels = recipe.judged(recipe.net.eval())
    chosen = recipe.store.filmed[recipe.validation[:, 0]]
    temperature = fit_temperature(logits[chosen], labels[chosen])
    save_weights(recipe.net, path, recipe.metadata | {"temperature": repr(temperature)})
    return temperature, expected_calibration_error((logits[chosen] / temperature).softmax(-1), labels[chosen])
