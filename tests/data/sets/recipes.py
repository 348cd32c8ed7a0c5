"""Small recipes for tests."""

from typing import Any

from tensorsim.data.sets.recipe import DatasetRecipe, RadarView, SourceConfig, SplitConfig, StorageConfig


def small_recipe(**changes: Any) -> DatasetRecipe:
    """Two people who sit down or walk for one second, seen through a wall: four samples in three shards."""
    fields: dict[str, Any] = {
        "name": "small",
        "duration_s": 1.0,
        "motion_hz": 60.0,
        "sources": (SourceConfig(classes=("walking", "sitting down"), people=2),),
        "radars": (RadarView("front", "through-wall"),),
        "split": SplitConfig(shares=(0.5, 0.5, 0.0)),
        "storage": StorageConfig(shard_samples=2),
    }
    return DatasetRecipe(**fields | changes)
