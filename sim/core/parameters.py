"""The base of every parameter model in `sim`, and the vector types they share."""

from __future__ import annotations

import unicodedata
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

Vector3 = tuple[float, float, float]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]
Device = Literal["auto", "cpu", "cuda", "vulkan", "metal"]


class Parameters(BaseModel):
    """Frozen, strict about unknown keys and about NaN; units stand in each field's description."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class KeyRefusedError(ValueError):
    """A rule of a whole table that one of its keys breaks, at `path` from that table."""

    def __init__(self, path: tuple[str | int, ...], message: str) -> None:
        super().__init__(message)
        self.path = path


LONGEST_NAME_LETTERS = 64
LONGEST_NAME_BYTES = 200
"""Of UTF-8: folders and files are called like bodies, and get endings."""


def _short_enough(name: str) -> str:
    if len(name.encode()) > LONGEST_NAME_BYTES:
        raise ValueError(f"must have {LONGEST_NAME_BYTES} bytes at most as UTF-8, got {len(name.encode())}")
    return name


BodyName = Annotated[str, Field(pattern=r"^\p{L}[\p{L}\p{M}\p{N}_-]{0,63}$"), AfterValidator(_short_enough)]
"""A name of a body: letters of any script, as `composed` writes them."""


def composed(value: Any, path: tuple[str | int, ...] = ()) -> Any:
    """A document whose keys and names are in Unicode's normal form C, so that what looks alike is alike.

    Texts that can be no name of a body, such as paths of files, stay as they are.

    Raises:
        KeyRefusedError: two keys of a table differ in nothing else.
    """
    if isinstance(value, str):
        return unicodedata.normalize("NFC", value) if _may_be_name(value) else value
    if isinstance(value, list | tuple):
        return type(value)(composed(child, (*path, index)) for index, child in enumerate(value))
    if not isinstance(value, dict):
        return value
    found: dict[Any, Any] = {}
    for key, child in value.items():
        key_as_c = unicodedata.normalize("NFC", key) if isinstance(key, str) else key
        if key_as_c in found:
            raise KeyRefusedError((*path, key_as_c), "is there twice, once with composed letters and once without")
        found[key_as_c] = composed(child, (*path, key_as_c))
    return found


def _may_be_name(text: str) -> bool:
    return not text.isascii() and all(each in "_-" or unicodedata.category(each)[0] in "LMN" for each in text)
