"""Arguments of a simulator: configurations, options by name, modules that replace them, and their conflicts."""

from typing import Any

from torch import nn

from tensorsim.config import ProcessingConfig, RadarConfig, SceneConfig, WallConfig
from tensorsim.config.documents import suggestion
from tensorsim.errors import TensorsimError, check_replaced
from tensorsim.radar.synthesis.echo import EchoSynthesizer

#: Fields of a scene that an EchoSynthesizer is made from.
_ECHO_FIELDS = (
    "floor", "multipath", "leakage", "wall_echo", "wall_paths", "incidence", "polarization", "bounces", "direct",
    "paths", "wall_attenuation",
)  # fmt: skip
#: Options that a module given in place of them would leave without effect.
_REPLACED = {
    "echo": (*_ECHO_FIELDS, "antenna", "learnable", "wall"),
    "mti": ("mti",),
    "doppler": ("window_s", "overlap", "integration"),
    "ridges": ("ridge_count",),
}


def configured(
    radar: RadarConfig | SceneConfig,
    wall: WallConfig | None,
    processing: ProcessingConfig | None,
    options: dict[str, Any],
) -> tuple[SceneConfig, ProcessingConfig]:
    """Scene and processing from the arguments of a simulator: each from a configuration or from options."""
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
    scene: SceneConfig,
    processing: ProcessingConfig,
    options: set[str],
) -> None:
    """Refuse options, and fields of configurations, that would have no effect because a module replaces them.

    Args:
        ready: modules by the name of their argument; None where none was given.
        scene, processing: the configurations; a field counts as given where it differs from the default.
        options: names of the other arguments that were given.
    """
    for part, module in ready.items():
        if module is not None:
            check_replaced(
                part,
                {
                    name: name in options or _differs(scene, name) or _differs(processing, name)
                    for name in _REPLACED[part]
                },
            )
            for name in ("carrier_hz", "slope_hz_per_s", "sample_rate_hz", "prf_hz"):
                theirs, ours = getattr(module, name, None), getattr(scene.radar, name)
                if theirs is not None and theirs != ours:
                    raise TensorsimError(
                        f"{part}: got one for a {name} of {theirs}, expected {ours} as the radar"
                    )


def _differs(config: SceneConfig | ProcessingConfig, name: str) -> bool:
    """Whether a field of a configuration differs from its default; False if there is no such field."""
    if name == "multipath" and isinstance(config, SceneConfig):
        return config.has_multipath
    field = config.__dataclass_fields__.get(name)
    return field is not None and getattr(config, name) != field.default


def echo_of(
    scene: SceneConfig, pulse_chunk: int, antenna: nn.Module | None, learnable: tuple[str, ...]
) -> EchoSynthesizer:
    """The echo of a scene."""
    switches = {name: getattr(scene, name) for name in _ECHO_FIELDS} | {"multipath": scene.has_multipath}
    return EchoSynthesizer(
        scene.radar, scene.wall, pulse_chunk=pulse_chunk, antenna=antenna, learnable=learnable, **switches
    )
