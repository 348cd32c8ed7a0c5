"""From the sources that a recipe names to their clips."""

from tensorsim.data.sets.clips import ClipSource
from tensorsim.data.sets.files import FileClips
from tensorsim.data.sets.generated import GeneratedPeople
from tensorsim.data.sets.recipe import DatasetRecipe, SourceConfig
from tensorsim.data.sets.rendered import RenderedPeople


def open_source(recipe: DatasetRecipe, source: SourceConfig, number: int, cache: str | None) -> ClipSource:
    """The clips of a source.

    Args:
        recipe: the recipe that the source belongs to.
        source: its description.
        number: its position in the recipe.
        cache: folder of the people found in videos; None finds them every time.

    Raises:
        TensorsimError: a folder or table that does not exist or has no clips.
    """
    if source.kind == "generated":
        return GeneratedPeople(recipe, source, number)
    if source.kind == "rendered":
        return RenderedPeople(recipe, source, number, cache)
    return FileClips(recipe, source, number, cache)
