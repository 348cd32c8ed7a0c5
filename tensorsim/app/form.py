"""The app's controls, generated from the options of ``simulate``, and the conversion of their values to options."""

from dataclasses import MISSING, dataclass, fields, replace
from typing import Any, Literal, get_args, get_type_hints

from tensorsim.commands.arguments import help_texts
from tensorsim.commands.demo import Demo
from tensorsim.commands.panel import PANEL
from tensorsim.commands.simulate import Simulate
from tensorsim.enhance.choice import DENOISERS
from tensorsim.errors import TensorsimError, check_choice

#: Options in addition to those of the panel, by group.
_MORE = {
    "SCENE": [
        "body",
        "sway",
        "vital_signs",
        "multipath",
        "leakage",
        "wall_echo",
        "wall_paths",
        "integration",
        "motion",
        "people",
        "seed",
    ],
    "CAMERA": [
        "camera_fov",
        "calibrate",
        "position",
        "fps",
        "start",
        "end",
        "stride",
        "flip_test",
        "walking_legs",
        "range_rate",
        "image_size",
    ],
    "MOTION CAPTURE": ["clip", "heading"],
    "PICTURES": ["colormap", "dynamic_range", "hide_ridges", "figure_format", "full_rate", "sound"],
}
_OFF = {"kind": "switch", "choices": (), "default": False}
_ON = {"kind": "switch", "choices": (), "default": True}
#: Attributes of controls that differ from what the command states about their options.
_OTHERWISE: dict[str, dict[str, Any]] = {
    # The app loads no configuration that an unset switch could leave unchanged.
    "sway": _OFF,
    "vital_signs": _OFF,
    "leakage": _OFF,
    "wall_echo": _OFF,
    "calibrate": _ON,
    "flip_test": _ON,
    "walking_legs": _ON,
    "range_rate": _OFF,
    # The command also takes weight files; users of the app must not read files on the machine that runs it.
    "denoiser": {
        "label": "Denoiser",
        "help": "Denoiser for the displayed maps; ksvd takes minutes. Default: none.",
        "kind": "choice",
        "choices": ("", *DENOISERS),
    },
}
#: Kinds of controls that take numbers, and the input that they expect.
_EXPECTED = {
    "number": "a number",
    "integer": "a whole number",
    "numbers": "numbers",
    "integers": "whole numbers",
}
GROUPS = ("VISION", "RADAR", "WALL", "PROCESSING", *_MORE)


@dataclass(frozen=True)
class Control:
    """A control of the form.

    Attributes:
        option: option of :class:`~tensorsim.commands.simulate.Simulate`.
        group: one of :data:`GROUPS`.
        label: label with the unit.
        help: what the option does and its default.
        kind: ``"number"``, ``"integer"``, ``"numbers"``, ``"integers"`` (several, separated by spaces), ``"choice"``,
            ``"switch"`` or ``"text"``.
        choices: values of a choice; the empty one means the default.
        default: initial value of the control.
        count: how many numbers it takes; None for any count.
    """

    option: str
    group: str
    label: str
    help: str
    kind: str
    choices: tuple[str, ...]
    default: Any
    count: int | None = None

    def value_of(self, given: Any) -> Any:
        """The value of the option for the given input; None where the control was left empty.

        Raises:
            TensorsimError: input that is not numeric where numbers are expected, or not one of the choices.
        """
        if self.kind == "switch":
            return bool(given)
        if given is None or (isinstance(given, str) and not given.strip()):
            return None
        if self.kind == "choice":
            check_choice(given, tuple(filter(None, self.choices)), self.label)
        if self.kind not in _EXPECTED:
            return str(given).strip()
        try:
            number = _whole if self.kind.startswith("integer") else float
            if not self.kind.endswith("s"):
                return number(given)
            several = tuple(number(part) for part in str(given).replace(",", " ").split())
            if self.count not in (None, len(several)):
                raise ValueError
            return several
        except (ValueError, OverflowError):
            many = f"{self.count} " if self.count else ""
            raise TensorsimError(
                f"{self.label}: got {given!r}, expected {many}{_EXPECTED[self.kind]}"
            ) from None


def controls() -> list[Control]:
    """The controls in the order of their groups."""
    helps, hints = help_texts(Simulate), get_type_hints(Simulate)
    defaults = {field.name: field.default for field in fields(Simulate)}
    named = [(p.option, p.group, p.name + (f" ({p.unit})" if p.unit else "")) for p in PANEL]
    for group, options in _MORE.items():
        named += [(option, group, option.replace("_", " ").capitalize()) for option in options]
    made = []
    for option, group, label in named:
        kind, choices = _kind(hints[option])
        count = _count(hints[option])
        default = None if defaults[option] is MISSING else defaults[option]
        control = Control(option, group, label, helps[option], kind, choices, default, count)
        made.append(replace(control, **_OTHERWISE.get(option, {})))
    return sorted(made, key=lambda control: GROUPS.index(control.group))


def options_of(values: dict[str, Any]) -> dict[str, Any]:
    """Arguments of the command for control values by option; those left at their default are omitted.

    Raises:
        TensorsimError: see :meth:`Control.value_of`.
    """
    given = {}
    for control in controls():
        value = control.value_of(values.get(control.option, control.default))
        if value is not None and value != control.default:
            given[control.option] = value
    return given


def for_demo(options: dict[str, Any]) -> dict[str, Any]:
    """The same options, checked for use with a generated person.

    Raises:
        TensorsimError: an option that applies to files only.
    """
    unknown = [name for name in options if name not in Demo.__dataclass_fields__]
    if unknown:
        raise TensorsimError(
            f"{unknown[0].replace('_', ' ')} applies only to files, not to a generated person"
        )
    return options


def _kind(hint: Any) -> tuple[str, tuple[str, ...]]:
    """The kind of control for an option of this type, and its choices."""
    members = [member for member in get_args(hint) if member is not type(None)] or [hint]
    if getattr(hint, "__origin__", None) is Literal:
        return "choice", tuple(get_args(hint))
    if getattr(members[0], "__origin__", None) is Literal:
        return "choice", ("", *get_args(members[0]))
    if getattr(members[0], "__origin__", None) is tuple:
        return ("integers" if get_args(members[0])[0] is int else "numbers"), ()
    if members[0] is bool:
        # A switch that may also be left to the scene.
        return ("choice", ("", "on", "off")) if len(get_args(hint)) > 1 else ("switch", ())
    return {float: "number", int: "integer"}.get(members[0], "text"), ()


def _count(hint: Any) -> int | None:
    """How many numbers an option of this type takes, if it takes a fixed count of several; otherwise None."""
    members = [get_args(member) for member in get_args(hint) if getattr(member, "__origin__", None) is tuple]
    return len(members[0]) if members and ... not in members[0] else None


def _whole(given: Any) -> int:
    """A whole number in any notation, such as 3 or 3.0."""
    number = float(given)
    if number != int(number):
        raise ValueError
    return int(number)
