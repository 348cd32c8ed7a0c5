"""What samples depend on besides the recipe text: the radars and weights that it names, and this package."""

import hashlib
import json
from importlib.metadata import version
from typing import Any

from tensorsim.config.documents import to_document
from tensorsim.data.sets.recipe import DatasetRecipe
from tensorsim.enhance.choice import weights_of_denoiser
from tensorsim.files import sha256_of
from tensorsim.radar.presets import radar_scene


def made_with(recipe: DatasetRecipe) -> dict[str, Any]:
    """The current contents of the presets and files that a recipe names.

    Returns:
        Plain values: ``version`` of the package; ``radars``, by name the fields of each with its wall and floor (None
        if there is none); ``denoisers``, the SHA-256 of the weights of each that has any.

    Raises:
        TensorsimError: a radar or weights that do not exist.
    """
    scenes = {view.name: radar_scene(view.preset) for view in recipe.radars}
    weights = {
        name: weights_of_denoiser(name)
        for name in sorted({recipe.processing.denoiser or "none", *recipe.variations.denoisers})
    }
    found = {
        "version": version("tensorsim"),
        "radars": {
            name: {part: to_document(getattr(scene, part)) for part in ("radar", "wall", "floor")}
            for name, scene in scenes.items()
        },
        "denoisers": {name: sha256_of(path) for name, path in weights.items() if path is not None},
    }
    plain: dict[str, Any] = json.loads(json.dumps(found))
    return plain


def digest(recipe: DatasetRecipe, made: dict[str, Any]) -> str:
    """SHA-256 of a recipe and what it was made with, which identifies the data set.

    Args:
        recipe: the recipe.
        made: see :func:`made_with`.
    """
    text = json.dumps([recipe.to_document(), made], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def difference(there: Any, here: Any, name: str = "") -> str:
    """The first value in which two documents (mappings of mappings, numbers, ...) differ, with its keys, as text."""
    if isinstance(there, dict) and isinstance(here, dict):
        for key in there | here:
            if there.get(key) != here.get(key):
                return difference(there.get(key), here.get(key), f"{name}.{key}" if name else key)
    return f"{name} {there!r} there, {here!r} here"
