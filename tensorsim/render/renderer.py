"""Render people from their joints: video of known motion with exact labels.

Ray-cast bodies of rounded volumes stand in a lit room and cast shadows; lens blur, sensor noise and compression follow.
"""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from tensorsim.config import CameraConfig
from tensorsim.device import one_thread
from tensorsim.errors import (
    TensorsimError,
    check_finite,
    check_floating,
    check_mask,
    check_not_empty,
    check_not_negative,
)
from tensorsim.progress import progress_bar
from tensorsim.render.body import REFERENCE_HEIGHT_M, Body, build_body
from tensorsim.render.cast import View, Volumes, cast
from tensorsim.render.look import Look, Surface, paint
from tensorsim.render.scene import GAMMA, Light, Scene, picture_scene, room_scene

#: COCO's visibility flags.
OUTSIDE, HIDDEN, VISIBLE = 0, 1, 2
#: Depth in metres below the surface up to which a keypoint counts as visible: small on the face, large at the hips.
FLESH_M = (0.05, 0.04, 0.04, 0.05, 0.05) + (0.12,) * 2 + (0.09,) * 4 + (0.18,) * 2 + (0.11,) * 4


class RenderedVideo(NamedTuple):
    """A video of P people and its ground truth.

    Attributes:
        frames: (T, 3, H, W) uint8 RGB.
        boxes: (P, T, 4) ``xyxy`` pixels around the visible part of each person; zeros if nothing is visible.
        masks: (P, T, H, W) bool, the pixels that show each person.
        keypoints: (P, T, 17, 2) COCO keypoints in pixels, visible or not.
        visibility: (P, T, 17) int64, as in COCO: 0 outside the image or absent, 1 hidden, 2 visible.
        keypoints_m: (P, T, 17, 3) the same keypoints in world metres.
        joints: (P, T, 14, 3) world metres, order of ``tensorsim.JOINTS``: the input.
        valid: (P, T) bool, whether the person is in the picture.
        camera: the camera, with focal length and principal point filled in.
    """

    frames: Tensor
    boxes: Tensor
    masks: Tensor
    keypoints: Tensor
    visibility: Tensor
    keypoints_m: Tensor
    joints: Tensor
    valid: Tensor
    camera: CameraConfig


class PersonRenderer:
    """Renders video of people from their joints.

    Appearance, light, room and noise are drawn from the seed of the call.

    Args:
        camera: pinhole camera; None is the default one, at the radar, looking along +y.
        height: height of the image in pixels.
        width: width of the image in pixels.
        blur_px: standard deviation of the lens blur in pixels.
        noise: standard deviation of the sensor noise at mid grey, relative to full scale; lower in shadows.
        jpeg_quality: 1 to 100, for the compression of each frame; None leaves it out.
        shadow_pixels: side of the square shadow map.

    Raises:
        TensorsimError: sizes or settings out of range.
    """

    def __init__(
        self,
        camera: CameraConfig | None = None,
        height: int = 360,
        width: int = 640,
        blur_px: float = 0.6,
        noise: float = 0.012,
        jpeg_quality: int | None = 85,
        shadow_pixels: int = 224,
    ) -> None:
        if height < 16 or width < 16:
            raise TensorsimError(f"PersonRenderer: got {height} x {width} pixels, expected at least 16 x 16")
        for name, value in (("blur_px", blur_px), ("noise", noise)):
            check_not_negative(value, f"PersonRenderer.{name}")
        if jpeg_quality is not None and not 1 <= jpeg_quality <= 100:
            raise TensorsimError(
                f"PersonRenderer.jpeg_quality: got {jpeg_quality}, expected 1 to 100 or None"
            )
        if shadow_pixels < 16:
            raise TensorsimError(f"PersonRenderer.shadow_pixels: got {shadow_pixels}, expected at least 16")
        self.camera = CameraConfig() if camera is None else camera
        self.height, self.width = height, width
        self.blur_px, self.noise, self.jpeg_quality = blur_px, noise, jpeg_quality
        self.shadow_pixels = shadow_pixels

    def __call__(
        self, joints: Tensor, seed: int = 0, background: Tensor | None = None, valid: Tensor | None = None
    ) -> RenderedVideo:
        """Render a video of people from their joints.

        Args:
            joints: (T, 14, 3) of one person or (P, T, 14, 3), world metres, order of ``tensorsim.JOINTS``, the
                floor at z = 0. On a CUDA device the bodies are cast there; frames come back on the CPU.
            seed: the same seed gives the same video.
            background: (3, H, W) image, RGB uint8 or floating point in [0, 1], scaled to cover the frame; None
                generates a room.
            valid: (P, T) bool, frames in which each person is present; None means all. If nobody is ever present,
                the video shows an empty scene.

        Returns:
            :class:`RenderedVideo`: T frames (T, 3, H, W), and boxes, masks, keypoints and visibility of P people, with
            the camera.

        Raises:
            TensorsimError: other shapes, no frames or people, NaN.
        """
        joints = _checked(joints)
        people, times = joints.shape[:2]
        present = torch.ones(people, times, dtype=torch.bool) if valid is None else valid.cpu()
        check_mask(present, [people, times], "valid")
        generator = torch.Generator().manual_seed(seed)
        view = View.of_camera(self.camera, self.height, self.width, joints)
        light = Light.draw(self.camera.yaw_rad, generator)
        looks = [Look.draw(generator) for _ in joints]
        bodies = [build_body(j, k.girth, k.long_hair) for j, k in zip(joints, looks, strict=True)]
        scene = self._scene(joints, view, light, background, generator)
        keypoints_m = torch.stack([body.keypoints for body in bodies])
        keypoints, depth = view.project(keypoints_m)

        frames, masks, visible = [], [], []
        # The many small operations of a frame are slower on several threads.
        with one_thread(), progress_bar("render", times, quiet=True) as bar:
            for t in range(times):
                who = present[:, t].nonzero()[:, 0].tolist()
                linear, owner, front = self._frame(t, who, bodies, looks, view, light, scene)
                frames.append(self._develop(linear, generator))
                masks.append(torch.stack([owner == p for p in range(people)]).unflatten(1, view.size))
                flags = _visibility(keypoints[:, t], depth[:, t], owner, front, view.size)
                visible.append(flags * present[:, t, None].to(flags))
                bar.update(1)
        mask = torch.stack(masks, dim=1)
        boxes = _boxes(mask)
        camera = CameraConfig(
            view.scale, self.camera.horizontal_fov_rad, view.center, self.camera.position_m,
            self.camera.pitch_rad, self.camera.yaw_rad, self.camera.roll_rad,
        )  # fmt: skip
        return RenderedVideo(
            torch.stack(frames),
            boxes,
            mask,
            keypoints,
            torch.stack(visible, dim=1),
            keypoints_m,
            joints,
            mask.flatten(2).any(dim=-1),
            camera,
        )

    def _scene(
        self, joints: Tensor, view: View, light: Light, background: Tensor | None, generator: torch.Generator
    ) -> Scene:
        if background is None:
            everything = torch.cat([joints.flatten(0, 2), view.position[None]])
            return room_scene(view, light, everything.amin(dim=0), everything.amax(dim=0), generator)
        if background.dim() != 3 or background.shape[0] != 3 or background.numel() == 0:
            raise TensorsimError(f"background: got shape {list(background.shape)}, expected (3, H, W) RGB")
        picture = background / 255 if background.dtype == torch.uint8 else background
        check_floating(picture, "background")
        check_finite(picture, "background")
        scale = max(self.height / picture.shape[1], self.width / picture.shape[2])
        size = (math.ceil(picture.shape[1] * scale), math.ceil(picture.shape[2] * scale))
        picture = F.interpolate(picture[None].to(joints), size, mode="bilinear", antialias=True)[0]
        top, left = (size[0] - self.height) // 2, (size[1] - self.width) // 2
        return picture_scene(picture[:, top : top + self.height, left : left + self.width], view, light)

    def _frame(
        self,
        t: int,
        who: list[int],
        bodies: list[Body],
        looks: list[Look],
        view: View,
        light: Light,
        scene: Scene,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Linear RGB (H * W, 3), the person in each pixel (-1: nobody) and the depth of that person."""
        if not who:
            nobody = torch.full_like(scene.depth, -1, dtype=torch.int64)
            return scene.shade + scene.lamp, nobody, torch.full_like(scene.depth, math.inf)
        volumes = Volumes(
            *(torch.cat(rows) for rows in zip(*([x[t] for x in bodies[p].volumes] for p in who), strict=True))
        )
        owner = torch.cat([torch.full_like(bodies[p].part, p) for p in who])
        hits = cast(volumes, owner, view)
        seen = (hits.depth < scene.depth) & (hits.volume >= 0)
        shadows = Shadows.of(volumes, owner, light, self.shadow_pixels)
        colour = scene.shade + scene.lamp * shadows.reach(scene.points)[:, None]

        pixel = seen.nonzero()[:, 0]
        volume = hits.volume[pixel]
        origins, directions = view.origins, view.directions[pixel]
        points = origins + hits.depth[pixel, None] * directions
        shade = colour.new_zeros(pixel.shape[0], 3)
        parts = torch.cat([bodies[p].part for p in who])
        for p in who:
            mine = owner[volume] == p
            shade[mine] = _shade(
                volumes, parts, volume[mine], points[mine], hits.normal[pixel[mine]], directions[mine],
                looks[p], bodies[p].height_m / REFERENCE_HEIGHT_M, light, shadows,
            )  # fmt: skip
        colour[pixel] = shade
        whose = torch.full_like(hits.volume, -1)
        whose[pixel] = owner[volume]
        return colour, whose, torch.where(seen, hits.depth, math.inf)

    def _develop(self, linear: Tensor, generator: torch.Generator) -> Tensor:
        """Lens, sensor and codec: linear (H * W, 3) to (3, H, W) uint8."""
        import cv2

        image = linear.reshape(self.height, self.width, 3).cpu().numpy()
        if self.blur_px > 0:
            image = cv2.GaussianBlur(image, (0, 0), self.blur_px)
        encoded = torch.from_numpy(image).clamp(0, 1) ** (1 / GAMMA)
        if self.noise > 0:
            shot = self.noise * (encoded.clamp(min=0.02) / 0.5).sqrt()
            encoded = encoded + shot * torch.randn(encoded.shape, generator=generator)
        frame = (encoded * 255).round().clamp(0, 255).to(torch.uint8)
        if self.jpeg_quality is not None:
            bgr = frame.flip(-1).numpy()
            code = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, self.jpeg_quality])[1]
            frame = torch.from_numpy(cv2.imdecode(code, cv2.IMREAD_COLOR)).flip(-1)
        return frame.permute(2, 0, 1)


class Shadows(NamedTuple):
    """A depth map of the people as seen from the lamp."""

    view: View
    depth: Tensor

    @classmethod
    def of(cls, volumes: Volumes, owner: Tensor, light: Light, pixels: int) -> "Shadows":
        """Cast the volumes along the light into a square image that just encloses them."""
        ends = torch.cat([volumes.start, volumes.end])
        low, high = ends.amin(dim=0), ends.amax(dim=0)
        side = float((high - low).norm()) + 0.5
        view = View.of_light(light.towards.to(ends), (low + high) / 2, side, pixels)
        # Depth is measured from the plane through the middle of the bodies; rays start well in front of it.
        view = view._replace(origins=view.origins - side * view.axes[2])
        return cls(view, cast(volumes, owner, view).depth - side)

    def reach(self, points: Tensor, bias_m: float = 0.04) -> Tensor:
        """Fraction (...) of the lamp's light that reaches world points (..., 3); edges are soft."""
        pixel, depth = self.view.project(points)
        size = self.view.size[0]
        margin = 2
        near = ((pixel > margin) & (pixel < size - 1 - margin)).all(dim=-1).nonzero()[:, 0]
        column, row = pixel[near].unbind(-1)
        total = torch.zeros_like(column)
        for du in (-1.5, -0.5, 0.5, 1.5):
            for dv in (-1.5, -0.5, 0.5, 1.5):
                stored = self.depth[(row + dv).round().long() * size + (column + du).round().long()]
                total += depth[near] < stored + bias_m
        return torch.ones_like(depth).index_copy(0, near, total / 16)


def _shade(
    volumes: Volumes, parts: Tensor, volume: Tensor, points: Tensor, normal: Tensor, directions: Tensor,
    look: Look, scale: float, light: Light, shadows: Shadows,
) -> Tensor:  # fmt: skip
    """Linear RGB (K, 3) of points on one body: diffuse with a soft terminator, ambient, a little gloss."""
    axes = volumes.axes[volume]
    local = torch.einsum("kij,kj->ki", axes, points - volumes.origin[volume])
    share = local[:, 2].abs() / volumes.length[volume]
    surface = Surface(local, torch.einsum("kij,kj->ki", axes, normal), parts[volume], share, scale)
    coat = paint(look, surface)
    normal = F.normalize(normal + torch.einsum("kji,kj->ki", axes, coat.folds), dim=-1)
    lit = shadows.reach(points + 0.01 * normal)
    towards = light.towards.to(points)
    facing = ((normal @ towards + 0.15) / 1.15).clamp(min=0)
    sky = 0.70 + 0.30 * normal[:, 2:]
    albedo = coat.albedo**GAMMA
    half = F.normalize(towards - F.normalize(directions, dim=-1), dim=-1)
    gloss = coat.gloss * ((normal * half).sum(-1).clamp(min=0)) ** 20 * lit
    irradiance = (facing * lit)[:, None] * light.key.to(points) + sky * light.ambient.to(points)
    return albedo * irradiance + gloss[:, None] * light.key.to(points)


def _visibility(
    keypoints: Tensor, depth: Tensor, owner: Tensor, front: Tensor, size: tuple[int, int]
) -> Tensor:
    """COCO flags (P, 17) from pixels (P, 17, 2), their depths and what each pixel of the image shows."""
    height, width = size
    pixel = keypoints.round()
    limit = pixel.new_tensor([width, height])
    inside = ((pixel >= 0) & (pixel < limit)).all(dim=-1) & (depth > 0)
    column, row = pixel.nan_to_num().clamp(min=0).minimum(limit - 1).long().unbind(-1)
    index = row * width + column
    person = torch.arange(len(keypoints), device=owner.device)[:, None]
    flesh = depth.new_tensor(FLESH_M)
    # A keypoint on the outline may round to the background beside it; it still counts as visible.
    seen = ((owner[index] == person) | (owner[index] < 0)) & (depth - front[index] < flesh)
    return torch.where(inside, torch.where(seen, VISIBLE, HIDDEN), OUTSIDE)


def _boxes(masks: Tensor) -> Tensor:
    """Tight boxes (..., 4) of masks (..., H, W); pixels are squares around their centres."""

    def extent(line: Tensor) -> tuple[Tensor, Tensor]:
        first = line.int().argmax(dim=-1)
        last = line.shape[-1] - 1 - line.flip(-1).int().argmax(dim=-1)
        return first - 0.5, last + 0.5

    left, right = extent(masks.any(dim=-2))
    top, bottom = extent(masks.any(dim=-1))
    boxes = torch.stack([left, top, right, bottom], dim=-1).float()
    return boxes * masks.flatten(-2).any(dim=-1)[..., None]


def _checked(joints: Tensor) -> Tensor:
    check_floating(joints, "joints")
    if joints.dim() == 3:
        joints = joints[None]
    if joints.dim() != 4 or joints.shape[2:] != (14, 3):
        raise TensorsimError(
            f"joints: got shape {list(joints.shape)}, expected (T, 14, 3) or (P, T, 14, 3) metres"
        )
    check_not_empty(joints, "joints")
    check_finite(joints, "joints")
    return joints.detach().float()
