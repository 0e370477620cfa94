from .check import DatasetCheck, check_dataset
from .dataset import Dataset
from .episode import Episode
from .generation import generate
from .recipe import Recipe, load_recipe

__all__ = [
    "Dataset",
    "DatasetCheck",
    "Episode",
    "Recipe",
    "check_dataset",
    "generate",
    "load_recipe",
]
