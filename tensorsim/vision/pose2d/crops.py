"""Crops of people: an upright affine warp of each box, as top-down pose networks expect it, and its inverse.

Pixel centres are at integers, in images and in crops. The crop of a box with centre c keeps the aspect ratio
of the crop size (W, H): the padded box is enlarged along its short side to (s W, s H), and crop pixel x'
shows

    x = s (x' - (W, H) / 2) + c

which is the transform of the simple-baselines, HRNet and DARK code ("plain", as against UDP's).
"""

import numpy as np
import torch
from torch import Tensor, nn

from tensorsim.errors import (
    TensorsimError,
    check_finite,
    check_floating,
    check_min_rank,
    check_positive,
    check_rank,
    check_size,
    is_exporting,
)

#: Of boxes with larger scales (pixels of the image per pixel of the crop) OpenCV would read many rows for nothing.
LARGEST_SCALE = 6.0


def crop_transform(boxes: Tensor, height: int, width: int, padding: float) -> tuple[Tensor, Tensor]:
    """Scale and offset of the crops of boxes: image point = scale * crop point + offset.

    Args:
        boxes: (..., 4) ``xyxy`` pixels.
        height: of the crop.
        width: of the crop.
        padding: the box is enlarged by this factor about its centre first.

    Returns:
        scale (..., 1), image pixels per crop pixel, and offset (..., 2), the image point of crop point (0,
        0).
    """
    low, high = boxes[..., :2], boxes[..., 2:]
    crop_size = torch.tensor([width, height], dtype=boxes.dtype, device=boxes.device)
    scale = padding * ((high - low) / crop_size).amax(-1, keepdim=True)
    return scale, (low + high) / 2 - scale * crop_size / 2


def crop_to_image(points: Tensor, boxes: Tensor, height: int, width: int, padding: float) -> Tensor:
    """Points (N, J, 2) of crops to pixels of the image, for the boxes (N, 4) of :func:`crop_transform`."""
    scale, offset = crop_transform(boxes, height, width, padding)
    return scale.unsqueeze(-2) * points + offset.unsqueeze(-2)


def sample_bilinear(images: Tensor, index: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Bilinear samples of images on one rectangular grid per index, black outside, as ``cv2.warpAffine``.

    Only the four neighbours of each sample are read: neither an image per grid nor a float copy of integer
    images is made.

    Args:
        images: (B, C, H, W), of any number type.
        index: (N,) int64, the image of each grid.
        u: (N, w) horizontal positions in pixels, floating point.
        v: (N, h) vertical positions.

    Returns:
        (N, C, h, w) in the type of ``u``, laid out channels last.
    """
    # Equal to kornia.geometry.warp_affine, which takes many times as long: it needs a float image per crop. Rows of the
    # part of the image that a grid covers are copied whole, which is quick where channels are last in memory.
    height, width = images.shape[2], images.shape[3]
    pixels = images.permute(0, 2, 3, 1)
    left, top = u.floor(), v.floor()
    crops = [u.new_zeros(0, v.shape[1], u.shape[1], images.shape[1])]
    for n in range(index.shape[0]):
        if is_exporting():
            first, part = 0, pixels.index_select(0, index[n : n + 1])[0]
        else:
            first = int(left[n].min().clamp(0, width - 1))
            last = int((left[n].max() + 1).clamp(0, width - 1))
            part = pixels[int(index[n]), :, first : last + 1]
        # Pixels and channels as one dimension: torch is slow where the last one has three numbers.
        lines = torch.zeros(1, dtype=u.dtype, device=u.device)
        for down in range(2):
            row = top[n] + down
            weight = (1 - (v[n] - row).abs()) * ((row >= 0) & (row < height))
            line = part.index_select(0, row.clamp(0, height - 1).long()).flatten(1).to(u.dtype)
            lines = torch.addcmul(lines, line, weight[:, None])
        lines = lines.view(v.shape[1], -1, images.shape[1])
        crop = torch.zeros(1, dtype=u.dtype, device=u.device)
        for right in range(2):
            column = left[n] + right
            weight = (1 - (u[n] - column).abs()) * ((column >= 0) & (column < width))
            chosen = lines.index_select(1, column.clamp(0, width - 1).long() - first).flatten(1)
            crop = torch.addcmul(crop, chosen, weight.repeat_interleave(images.shape[1]))
        crops.append(crop.view(1, v.shape[1], -1, images.shape[1]))
    return torch.cat(crops).permute(0, 3, 1, 2)


class BoxCrop(nn.Module):
    """Crops of boxes in a batch of images.

    ``uint8`` images become [0, 1] floats. Differentiable with respect to float images and boxes. Samples are bilinear
    without a low-pass filter, as in the pipelines that pose networks were trained with, so large boxes alias.

    Args:
        size: (H, W) of the crops.
        padding: boxes are enlarged by this factor first.

    Raises:
        TensorsimError: a size or padding that is not positive; ranks that do not fit, images of
            another integer type or without pixels, boxes that are integers, not finite or have no area.
    """

    def __init__(self, size: tuple[int, int] = (256, 192), padding: float = 1.25) -> None:
        super().__init__()
        if len(size) != 2 or min(size) < 1:
            raise TensorsimError(f"BoxCrop: got size {size}, expected (H, W), both positive")
        check_positive(padding, "BoxCrop padding")
        self.height, self.width = size
        self.padding = padding

    def forward(self, images: Tensor, boxes: Tensor, index: Tensor) -> Tensor:
        """Crop each box from its image.

        Args:
            images: (B, C, H, W), floats or ``uint8``.
            boxes: (N, 4) ``xyxy`` pixels.
            index: (N,) int64, the image of each box.

        Returns:
            (N, C, h, w) in the type of float images, for ``uint8`` in that of the boxes; channels last in
            memory.
        """
        check_rank(images, 4, "BoxCrop images", "(B, C, H, W)")
        if images.shape[2] == 0 or images.shape[3] == 0:
            raise TensorsimError(f"BoxCrop images: got shape {list(images.shape)}, expected some pixels")
        if not (images.is_floating_point() or images.dtype == torch.uint8):
            raise TensorsimError(f"BoxCrop images: got dtype {images.dtype}, expected floats or uint8")
        check_boxes(boxes, "BoxCrop boxes")
        check_rank(boxes, 2, "BoxCrop boxes", "(N, 4)")
        if index.dim() != 1 or index.shape[0] != boxes.shape[0] or index.is_floating_point():
            raise TensorsimError(
                f"BoxCrop index: got {index.dtype} of shape {list(index.shape)}, expected integers of shape "
                f"({boxes.shape[0]},), one per box"
            )
        if not is_exporting() and not bool(((index >= 0) & (index < images.shape[0])).all()):
            raise TensorsimError(
                f"BoxCrop index: got a number that belongs to no image, expected 0 to {images.shape[0] - 1}"
            )
        scale, offset = crop_transform(boxes, self.height, self.width, self.padding)
        crops = self.sample(images, index, scale, offset)
        return crops.to(images.dtype) if images.is_floating_point() else crops / 255

    def sample(self, images: Tensor, index: Tensor, scale: Tensor, offset: Tensor) -> Tensor:
        """Crops (N, C, h, w), in the values of the images, of these scales (N, 1) and offsets (N, 2)."""
        u = scale * torch.arange(self.width, dtype=scale.dtype, device=scale.device) + offset[:, 0:1]
        v = scale * torch.arange(self.height, dtype=scale.dtype, device=scale.device) + offset[:, 1:2]
        return sample_bilinear(images, index, u, v)


class OpenCVBoxCrop(BoxCrop):
    """:class:`BoxCrop` by OpenCV for 8-bit images on the CPU, equal to a hundredth of a grey level, in half the time.

    Other images, boxes in float64, with gradients, or more than :data:`LARGEST_SCALE` times as large as the crop, and
    OpenCV before 5.0, which rounds positions to 1/32 pixel, are left to :class:`BoxCrop`. It cannot be scripted.
    """

    def sample(self, images: Tensor, index: Tensor, scale: Tensor, offset: Tensor) -> Tensor:
        """See :meth:`BoxCrop.sample`."""
        import cv2

        suits = images.dtype == torch.uint8 and images.device.type == "cpu" and images.shape[1] == 3
        exact = scale.dtype == torch.float32 and int(cv2.__version__.split(".")[0]) >= 5
        if not (suits and exact) or offset.requires_grad or bool((scale > LARGEST_SCALE).any()):
            return super().sample(images, index, scale, offset)
        crops = scale.new_zeros(len(index), self.height, self.width, 3)
        # The part of the picture that holds both neighbours of every sample.
        size = torch.tensor([images.shape[3], images.shape[2]])
        corner = offset + scale * torch.tensor([self.width - 1, self.height - 1])
        first = offset.floor().clamp(min=0).minimum(size)
        last = corner.floor().clamp(min=-2).minimum(size) + 2
        parts = torch.cat([index[:, None], first, last], dim=1).int().tolist()
        for n, (image, x, y, x_end, y_end) in enumerate(parts):
            part = images[image, :, y:y_end, x:x_end].permute(1, 2, 0).numpy()
            if part.size:
                step, (right, down) = float(scale[n]), (offset[n] - first[n]).tolist()
                to_part = np.array([[step, 0.0, right], [0.0, step, down]])
                how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
                crop = cv2.warpAffine(part.astype(np.float32), to_part, (self.width, self.height), flags=how)
                crops[n] = torch.from_numpy(crop)
        return crops.permute(0, 3, 1, 2)


def check_boxes(boxes: Tensor, name: str) -> None:
    """Refuse anything but finite floating point ``xyxy`` boxes (..., 4) with an area."""
    check_floating(boxes, name)
    check_min_rank(boxes, 1, name, "(..., 4) xyxy")
    check_size(boxes, -1, 4, name, "(..., 4) xyxy")
    check_finite(boxes, name)
    if not is_exporting() and not bool((boxes[..., 2:] > boxes[..., :2]).all()):
        raise TensorsimError(f"{name}: got a box without area, expected xyxy with x1 < x2 and y1 < y2")
