"""YAML that people write by hand: small, flat, and without what could take long, take memory or surprise."""

from typing import Any

from tensorsim.errors import TensorsimError

#: Characters of a document, of a value, and nesting; configurations need a tenth of each, but for long paths of files.
MAX_CHARACTERS = 100_000
MAX_VALUE = 4096
MAX_DEPTH = 20


def load_limited_yaml(text: str, name: str) -> Any:
    """The content of a YAML document.

    Numbers are decimal as in Python (``010`` is ten and ``77e9`` a number, unlike in YAML 1.1); dates, anchors, tags
    and repeated keys are refused. Bounds are checked while the text is read, before anything is built from it.

    Args:
        text: the document.
        name: of its file, for messages.

    Raises:
        TensorsimError: text that is not YAML, is larger or deeper than the bounds above, or has what is refused.
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
    """YAML from which :func:`load_limited_yaml` reads the same: text that it would take for a number is quoted."""
    import yaml

    class Dumper(yaml.SafeDumper):
        yaml_implicit_resolvers = _loader().yaml_implicit_resolvers

    return str(yaml.dump(document, Dumper=Dumper, sort_keys=False))


def _loader() -> Any:
    """YAML's safe loader with decimal numbers, without dates, and without equal keys."""
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
                raise yaml.YAMLError(f"twice the key {', '.join(twice)}")
            return super().construct_mapping(node, deep)

    decimal = r"[-+]?(\d[\d_]*\.?[\d_]*|\.\d[\d_]*)([eE][-+]?\d+)?"
    Loader.add_implicit_resolver("tag:yaml.org,2002:int", re.compile(r"[-+]?\d[\d_]*$"), list("-+0123456789"))
    Loader.add_implicit_resolver("tag:yaml.org,2002:float", re.compile(decimal + "$"), list("-+.0123456789"))
    Loader.add_constructor("tag:yaml.org,2002:int", lambda _, node: int(node.value))
    Loader.add_constructor("tag:yaml.org,2002:float", lambda _, node: float(node.value))
    return Loader
