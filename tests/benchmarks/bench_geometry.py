"""Geometry of this package against kornia's: time, difference, and whether kornia's scripts.

python -m tests.benchmarks.bench_geometry
"""

from collections.abc import Callable

import kornia.geometry
import torch
from kornia.geometry.bbox import nms
from torch import Tensor

from tensorsim.body.kinematics import rotation
from tensorsim.config import CameraConfig
from tensorsim.geometry.boxes import non_maximum_suppression
from tensorsim.geometry.camera import back_project, camera_to_world, project
from tensorsim.vision.pose2d.crops import BoxCrop, crop_transform
from tests.benchmarks.timing import medians

Pair = tuple[str, Callable[[], Tensor], Callable[[], Tensor], Callable[..., object]]


def scripts(function: Callable[..., object]) -> bool:
    """Whether TorchScript takes it."""
    try:
        torch.jit.script(function)
    except Exception:  # TorchScript's own, of several kinds
        return False
    return True


def pairs() -> list[Pair]:
    """Name, ours, kornia's, and kornia's function."""
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    angle, axis = 6.0 * uniform(960), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)

    points, pose = uniform(480, 14, 3) + torch.tensor([0.0, 4.0, 0.5]), camera_to_world(CameraConfig())
    focal, center = 500.0, (319.5, 179.5)
    matrix = torch.tensor([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1]], dtype=torch.float64)
    matrices = matrix.expand(480, 14, 3, 3)
    whole = torch.cat([pose, torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)])
    inverse = torch.linalg.inv(whole)[None]
    pixels, depth = project(points, focal, center, pose)
    focals = torch.full((480,), focal, dtype=torch.float64)

    def kornia_project() -> Tensor:
        local = kornia.geometry.transform_points(inverse, points.reshape(1, -1, 3)).reshape(points.shape)
        return kornia.geometry.project_points(local, matrices)

    def kornia_back_project() -> Tensor:
        local = kornia.geometry.unproject_points(pixels, depth[..., None], matrices)
        return kornia.geometry.transform_points(whole[None], local.reshape(1, -1, 3)).reshape(points.shape)

    images = (255 * uniform(8, 3, 720, 1280)).to(torch.uint8)
    corner = 100 * uniform(16, 2)
    boxes = torch.cat([corner, corner + 200 + 250 * uniform(16, 2)], dim=-1)
    index = torch.arange(16) % 8
    crop = BoxCrop()

    def kornia_crop() -> Tensor:
        scale, offset = crop_transform(boxes, 256, 192, 1.25)
        warp = torch.zeros(16, 2, 3, dtype=torch.float64)
        warp[:, 0, 0], warp[:, 1, 1], warp[:, :, 2] = 1 / scale[:, 0], 1 / scale[:, 0], -offset / scale
        return kornia.geometry.warp_affine(images[index].double() / 255, warp, (256, 192), align_corners=True)

    low, score = 500 * uniform(300, 2), uniform(300)
    many = torch.cat([low, low + 100 * uniform(300, 2)], dim=-1)
    one = torch.zeros(1, 300, dtype=torch.int64)

    def own_nms() -> Tensor:
        kept, found = non_maximum_suppression(many[None], score[None], one, one == 0, 0.65, 300)
        return kept[found].double()

    return [
        (
            "rotation matrices",
            lambda: rotation(2, angle),
            lambda: kornia.geometry.axis_angle_to_rotation_matrix(angle[:, None] * axis),
            kornia.geometry.axis_angle_to_rotation_matrix,
        ),
        (
            "projection",
            lambda: project(points, focal, center, pose)[0],
            kornia_project,
            kornia.geometry.project_points,
        ),
        (
            "back-projection",
            lambda: back_project(pixels, depth, focals, torch.tensor(center).double(), pose),
            kornia_back_project,
            kornia.geometry.unproject_points,
        ),
        ("crops", lambda: crop(images, boxes, index), kornia_crop, kornia.geometry.warp_affine),
        ("suppression", own_nms, lambda: nms(many, score, 0.65).double(), nms),
    ]


def main() -> None:
    """Print median times."""
    print(f"{torch.get_num_threads()} threads")
    for name, own, other, function in pairs():
        own_s, other_s = medians([own, other], 7)
        difference = float((own() - other()).abs().max())
        print(
            f"{name:18s} own {own_s * 1e3:9.3f} ms, kornia {other_s * 1e3:9.3f} ms, differ by {difference:.1e}, "
            f"kornia's {'scripts' if scripts(function) else 'does not script'}"
        )


if __name__ == "__main__":
    main()
