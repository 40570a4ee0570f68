"""What an artifact is made from, and the key that follows from it."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import PurePath
from typing import Any

STEP_NAME = re.compile(r"[a-z0-9][a-z0-9_-]*")


@dataclass(frozen=True)
class Recipe:
    """A step, its settings and the content of its inputs: the same recipe is the same artifact.

    `inputs` maps a label to a content digest. `sources` maps the same labels to the paths as the user gave
    them: they go into the manifest and not into the key. `version` is bumped by hand when results change.
    """

    step: str
    version: int
    config: Mapping[str, Any]
    inputs: Mapping[str, str]
    weights: str | None = None
    sources: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self):
        if not STEP_NAME.fullmatch(self.step):
            raise ValueError(f"a step's name is lower-case letters, digits, - and _; got {self.step!r}")

    @property
    def key(self) -> str:
        """sha256 of the canonical JSON of the recipe. Raises TypeError or ValueError as that does."""
        return key_of(self.step, self.version, self.config, self.inputs, self.weights)


def key_of(step: str, version: int, config: Mapping[str, Any], inputs: Mapping[str, str], weights: str | None) -> str:
    """The key of a recipe given by its parts, 64 hexadecimal digits."""
    parts = {"step": step, "step_version": version, "config": config, "inputs": inputs, "weights": weights}
    return hashlib.sha256(canonical_json(parts).encode("ascii")).hexdigest()


def canonical_json(value: object) -> str:
    """The one JSON text of a value: sorted keys, no spaces, ASCII, tuples as lists.

    Raises TypeError for what JSON does not know, such as paths, and ValueError for floats not finite.
    """
    return json.dumps(plain(value), sort_keys=True, separators=(",", ":"), allow_nan=False)


def plain(value: object, name: str = "value") -> Any:
    """The value as dicts, lists, strings, numbers and None. Raises as `canonical_json`, naming the place."""
    match value:
        case None | bool():
            return value
        case str():
            return str.__str__(value)
        case int():
            return int(value)
        case float():
            if not math.isfinite(value):
                raise ValueError(f"{name} is {value}; only finite numbers can be part of a key")
            return float(value)
        case PurePath():
            raise TypeError(
                f"{name} is the path {value}: a key depends on content, so give the digest of what is there"
            )
        case Mapping():
            if not all(isinstance(key, str) for key in value):
                raise TypeError(f"{name} has keys that are not strings")
            return {str.__str__(key): plain(item, f"{name}.{key}") for key, item in value.items()}
        case list() | tuple():
            return [plain(item, f"{name}[{index}]") for index, item in enumerate(value)]
    raise TypeError(f"{name} is a {type(value).__name__}, which JSON does not know")
