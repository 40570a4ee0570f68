"""Content-addressed artifact folders: made once, found by what they are made from. Knows nothing of 3D."""

from mv3d_cli.store.artifact import Artifact, damage_of, find_artifact, is_intact, open_artifact
from mv3d_cli.store.cache import cache_dir, maker_of
from mv3d_cli.store.delivery import check_output, deliver
from mv3d_cli.store.digest import digest_of_file, digest_of_folder, digest_of_path
from mv3d_cli.store.disk import ran_out_of_space
from mv3d_cli.store.production import produce
from mv3d_cli.store.recipe import Recipe, canonical_json

__all__ = [
    "Artifact",
    "Recipe",
    "cache_dir",
    "canonical_json",
    "check_output",
    "damage_of",
    "deliver",
    "digest_of_file",
    "digest_of_folder",
    "digest_of_path",
    "find_artifact",
    "is_intact",
    "maker_of",
    "open_artifact",
    "produce",
    "ran_out_of_space",
]
