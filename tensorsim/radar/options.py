"""The arguments of a simulator: configurations, options by name, modules in place of them, and their conflicts."""

from typing import Any

from torch import nn

from tensorsim.config import ProcessingConfig, RadarConfig, SceneConfig, WallConfig
from tensorsim.config.documents import suggestion
from tensorsim.errors import TensorsimError
from tensorsim.radar.synthesis.echo import EchoSynthesizer

#: Fields of a scene that an EchoSynthesizer is made from.
_ECHO_FIELDS = (
    "floor", "multipath", "leakage", "wall_echo", "wall_paths", "incidence", "polarization", "bounces", "direct",
    "paths", "wall_attenuation",
)  # fmt: skip
#: Options that a module given in place of them would leave without effect.
_REPLACED = {
    "echo": _ECHO_FIELDS,
    "doppler": ("window_s", "overlap", "integration"),
    "ridges": ("ridge_count",),
}


def configured(
    radar: RadarConfig | SceneConfig,
    wall: WallConfig | None,
    processing: ProcessingConfig | None,
    options: dict[str, Any],
) -> tuple[SceneConfig, ProcessingConfig]:
    """Scene and processing of the arguments of a simulator; a part comes from a configuration or from options."""
    of_scene = {name: value for name, value in options.items() if name in SceneConfig.__dataclass_fields__}
    of_processing = {k: v for k, v in options.items() if k in ProcessingConfig.__dataclass_fields__}
    unknown = sorted(options.keys() - of_scene.keys() - of_processing.keys())
    if unknown:
        known = [*SceneConfig.__dataclass_fields__, *ProcessingConfig.__dataclass_fields__]
        raise TensorsimError(
            f"RadarSimulator: got the option {unknown[0]!r}{suggestion(unknown[0], known)}, expected fields of "
            "SceneConfig and ProcessingConfig"
        )
    if isinstance(radar, SceneConfig):
        if wall is not None or of_scene:
            given = sorted(of_scene) + ["wall"] * (wall is not None)
            raise TensorsimError(
                f"RadarSimulator: got a SceneConfig and {', '.join(given)}, expected one or the other"
            )
        scene = radar
    else:
        scene = SceneConfig(radar, wall, **{"multipath": False} | of_scene)
    if processing is None:
        return scene, ProcessingConfig(**of_processing)
    if of_processing:
        raise TensorsimError(
            f"RadarSimulator: got a ProcessingConfig and {', '.join(sorted(of_processing))}, expected one or the other"
        )
    return scene, processing


def refuse_conflicts(
    ready: dict[str, nn.Module | None],
    options: dict[str, Any],
    wall: WallConfig | None,
    antenna: nn.Module | None,
    learnable: tuple[str, ...],
) -> None:
    """Refuse options that a module given in their place would leave without effect."""
    given = sorted(options)
    given += [name for name, value in (("antenna", antenna), ("wall", wall)) if value is not None]
    given += ["learnable"] if learnable else []
    for part, module in ready.items():
        more = ("antenna", "learnable", "wall") if part == "echo" else ()
        without_effect = [name for name in given if name in _REPLACED[part] + more]
        if module is not None and without_effect:
            raise TensorsimError(
                f"{part}: got a ready one and {', '.join(without_effect)}, expected one or the other"
            )


def echo_of(
    scene: SceneConfig, pulse_chunk: int, antenna: nn.Module | None, learnable: tuple[str, ...]
) -> EchoSynthesizer:
    """The echo of a scene."""
    switches = {name: getattr(scene, name) for name in _ECHO_FIELDS} | {"multipath": scene.has_multipath}
    return EchoSynthesizer(
        scene.radar, scene.wall, pulse_chunk=pulse_chunk, antenna=antenna, learnable=learnable, **switches
    )
