"""Hand-written YAML: small, flat, and without features that cost time or memory, or cause surprises."""

from typing import Any

from tensorsim.exceptions import TensorsimError

#: Limits on the characters of a document and of a value, and on nesting; apart from long file paths, configurations
#: need a tenth of each.
MAX_CHARACTERS = 100_000
MAX_VALUE = 4096
MAX_DEPTH = 20


def load_limited_yaml(text: str, name: str) -> Any:
    """The content of a YAML document.

    Numbers are decimal as in Python (``010`` is ten and ``77e9`` a number, unlike in YAML 1.1); dates, anchors, tags
    and repeated keys are refused. Limits are checked while the text is parsed, before anything is built from it.

    Args:
        text: the document.
        name: name of its file, for messages.

    Raises:
        TensorsimError: text that is not YAML, exceeds the limits above, or uses a refused feature.
    """
    import yaml

    if len(text) > MAX_CHARACTERS:
        raise TensorsimError(f"{name}: got {len(text)} characters, expected at most {MAX_CHARACTERS}")
    try:
        depth = 0
        for event in yaml.parse(text, yaml.SafeLoader):
            line = event.start_mark.line + 1 if event.start_mark else 1
            if isinstance(event, yaml.CollectionStartEvent):
                depth += 1
            elif isinstance(event, yaml.CollectionEndEvent):
                depth -= 1
            if depth > MAX_DEPTH:
                raise TensorsimError(f"{name}: line {line} is nested deeper than {MAX_DEPTH} levels")
            if getattr(event, "anchor", None) or getattr(event, "tag", None):
                raise TensorsimError(
                    f"{name}: line {line} has an anchor, an alias or a tag, expected plain values"
                )
            if isinstance(event, yaml.ScalarEvent) and len(event.value) > MAX_VALUE:
                raise TensorsimError(f"{name}: line {line} has a value of {len(event.value)} characters, "
                                     f"expected at most {MAX_VALUE}")  # fmt: skip
        return yaml.load(text, _loader())
    except (yaml.YAMLError, ValueError) as error:
        if isinstance(error, TensorsimError):
            raise
        raise TensorsimError(f"{name}: not valid YAML: {error}") from None


def dump_limited_yaml(document: Any) -> str:
    """YAML that :func:`load_limited_yaml` reads back unchanged: strings that look like numbers are quoted."""
    import yaml

    class Dumper(yaml.SafeDumper):
        yaml_implicit_resolvers = _loader().yaml_implicit_resolvers

    return str(yaml.dump(document, Dumper=Dumper, sort_keys=False))


def _loader() -> Any:
    """YAML's safe loader with decimal numbers, without dates, and refusing repeated keys."""
    import re

    import yaml

    class Loader(yaml.SafeLoader):
        yaml_implicit_resolvers = {  # noqa: RUF012  # the class attribute of yaml
            first: [pair for pair in pairs if pair[0].rpartition(":")[2] not in ("int", "float", "timestamp")]
            for first, pairs in yaml.SafeLoader.yaml_implicit_resolvers.items()
        }

        def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
            keys = [str(key.value) for key, _ in node.value]
            twice = sorted({key for key in keys if keys.count(key) > 1})
            if twice:
                raise yaml.YAMLError(f"duplicate key {', '.join(twice)}")
            return super().construct_mapping(node, deep)

    decimal = r"[-+]?(\d[\d_]*\.?[\d_]*|\.\d[\d_]*)([eE][-+]?\d+)?"
    Loader.add_implicit_resolver("tag:yaml.org,2002:int", re.compile(r"[-+]?\d[\d_]*$"), list("-+0123456789"))
    Loader.add_implicit_resolver("tag:yaml.org,2002:float", re.compile(decimal + "$"), list("-+.0123456789"))
    Loader.add_constructor("tag:yaml.org,2002:int", lambda _, node: int(node.value))
    Loader.add_constructor("tag:yaml.org,2002:float", lambda _, node: float(node.value))
    return Loader
