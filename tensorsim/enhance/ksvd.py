"""Denoising by sparse representation of patches over a dictionary learned from the noisy image itself.

Source: M. Elad, M. Aharon, "Image denoising via sparse and redundant representations over learned dictionaries", IEEE
Transactions on Image Processing 15 (2006). The dictionary is learned by scikit-learn's online method (Mairal et al.,
2009) instead of K-SVD: the same objective, minimised one patch after another.
"""

import importlib.util
import math
import warnings

import torch
from torch import Tensor, nn

from tensorsim.errors import (
    TensorsimError,
    check_count,
    check_finite,
    check_floating,
    check_min_rank,
    check_not_empty,
    check_rank,
)


def noise_deviation(image: Tensor) -> float:
    """Standard deviation of white noise in an image (H, W).

    From the median of the finest diagonal Haar coefficients (Donoho, Johnstone, 1994). Noise that is correlated
    between neighbouring pixels is hardly detected: the estimate for a Doppler-time map at 10 dB, whose columns overlap
    by 90 %, is 0.0002 instead of 0.03, so that :class:`KSVD` leaves such maps practically unchanged.
    """
    height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    x = image[:height, :width]
    diagonal = (x[::2, ::2] - x[::2, 1::2] - x[1::2, ::2] + x[1::2, 1::2]) / 2
    return float(diagonal.abs().median()) / 0.6745


def cosine_dictionary(side: int, atoms: int) -> Tensor:
    """Overcomplete cosine dictionary (atoms, side^2) of norm 1, ``atoms`` a square number: the initial dictionary."""
    count = math.isqrt(atoms)
    place = torch.arange(side, dtype=torch.float64)
    rows = torch.cos(torch.arange(count, dtype=torch.float64)[:, None] * (place + 0.5) * (math.pi / count))
    rows[1:] -= rows[1:].mean(1, keepdim=True)
    rows /= torch.linalg.vector_norm(rows, dim=1, keepdim=True)
    return torch.kron(rows, rows)


def ksvd_denoise(
    image: Tensor,
    sigma: float | None = None,
    side: int = 8,
    atoms: int = 256,
    iterations: int = 10,
    training_patches: int = 10_000,
    seed: int = 0,
) -> Tensor:
    """Denoise an image (H, W) in [0, 1].

    Every patch, less its mean, is approximated by the fewest atoms that give a squared error of at most
    ``side^2 (1.15 sigma)^2`` (orthogonal matching pursuit). Overlapping patches are averaged, together with the noisy
    image with weight ``0.118 / sigma`` (30 over sigma in grey levels in the source). Runs on the CPU in float64 and is
    not differentiable.

    Args:
        image: (H, W), at least ``side`` in both.
        sigma: standard deviation of the noise; None estimates it, see :func:`noise_deviation`.
        side: size of a patch in pixels.
        atoms: size of the dictionary, a square number.
        iterations: passes over the training patches.
        training_patches: maximum number of patches for learning, drawn at random.
        seed: of the draw and of learning.

    Raises:
        TensorsimError: another rank, an image smaller than a patch, NaN, a negative deviation, counts below one, atoms
            that are not a square number, or scikit-learn missing.
    """
    try:
        from sklearn.decomposition import MiniBatchDictionaryLearning, sparse_encode
    except ImportError as error:
        raise TensorsimError(
            f"ksvd_denoise: scikit-learn cannot be imported ({error}); install it with: "
            'pip install "tensorsim[train]"'
        ) from error
    from torch.nn.functional import fold, unfold

    check_floating(image, "ksvd_denoise")
    check_rank(image, 2, "ksvd_denoise", "(H, W)")
    check_finite(image, "ksvd_denoise")
    for name, number in (("side", side), ("iterations", iterations), ("training_patches", training_patches)):
        check_count(number, f"ksvd_denoise.{name}")
    if sigma is not None and not 0 <= sigma < math.inf:
        raise TensorsimError(f"ksvd_denoise: got sigma {sigma}, expected a finite number >= 0 or None")
    if min(image.shape) < side:
        raise TensorsimError(f"ksvd_denoise: got shape {list(image.shape)}, expected at least {side}x{side}")
    if math.isqrt(atoms) ** 2 != atoms or atoms < 4:
        raise TensorsimError(f"ksvd_denoise: got {atoms} atoms, expected a square number from 4")
    noisy = image.detach().cpu().double()
    sigma = noise_deviation(noisy) if sigma is None else sigma
    if sigma == 0:
        return image.detach().clone()
    patches = unfold(noisy[None, None], side)[0].T  # (patches, side^2)
    means = patches.mean(1, keepdim=True)
    centred = (patches - means).numpy()
    tolerance = side**2 * (1.15 * sigma) ** 2
    drawn = torch.randperm(len(centred), generator=torch.Generator().manual_seed(seed))[:training_patches]
    learner = MiniBatchDictionaryLearning(
        n_components=atoms,
        max_iter=iterations,
        batch_size=256,
        fit_algorithm="lars",
        transform_algorithm="omp",
        dict_init=cosine_dictionary(side, atoms).numpy(),
        alpha=1.15 * sigma * side,
        random_state=seed,
    )
    dictionary = learner.fit(centred[drawn.numpy()]).components_
    dictionary /= (dictionary**2).sum(1, keepdims=True) ** 0.5
    # Patches below the tolerance are replaced by their mean: the pursuit would find no atom for them.
    busy = (centred**2).sum(1) > tolerance
    found = torch.zeros_like(patches)
    if busy.any():
        with warnings.catch_warnings():
            # If atoms are nearly alike, the pursuit ends early, with the best fit so far.
            warnings.filterwarnings("ignore", "Orthogonal matching pursuit ended", RuntimeWarning)
            codes = sparse_encode(centred[busy], dictionary, algorithm="omp", alpha=tolerance)
        found[torch.from_numpy(busy)] = torch.from_numpy(codes @ dictionary)
    weight = 0.118 / sigma
    size = (int(noisy.shape[0]), int(noisy.shape[1]))
    total = fold((found + means).T[None], size, side)[0, 0]
    count = fold(torch.ones_like(found).T[None], size, side)[0, 0]
    return ((weight * noisy + total) / (weight + count)).to(image)


class KSVD(nn.Module):
    """:func:`ksvd_denoise` of magnitude maps (..., H, W), each scaled to [0, 1] and back; for comparison.

    Runs scikit-learn, so it cannot be scripted and has no gradient. Takes minutes for a map of 32 000 columns.

    Raises:
        TensorsimError: scikit-learn missing; maps smaller than a patch, empty ones, NaN or infinity.
    """

    def __init__(self) -> None:
        super().__init__()
        if importlib.util.find_spec("sklearn") is None:
            raise TensorsimError(
                'KSVD: scikit-learn cannot be imported; install it with: pip install "tensorsim[train]"'
            )

    def forward(self, maps: Tensor) -> Tensor:
        """Maps (..., H, W) to maps of the same shape, not negative."""
        check_floating(maps, "KSVD")
        check_min_rank(maps, 2, "KSVD", "(..., H, W)")
        check_not_empty(maps, "KSVD")
        check_finite(maps, "KSVD")
        # Detached: only the scaling would have a gradient, which is not that of the whole.
        flat = maps.detach().reshape(-1, maps.shape[-2], maps.shape[-1])
        return torch.stack([self._clean(one) for one in flat]).reshape(maps.shape)

    @staticmethod
    def _clean(one: Tensor) -> Tensor:
        low, high = one.amin(), one.amax()
        if not bool(high > low):
            return one.clone()
        return ksvd_denoise((one - low) / (high - low)).clamp_min(0.0) * (high - low) + low
