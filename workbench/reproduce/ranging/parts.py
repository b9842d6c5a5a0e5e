"""Parts of the experiment: each is computed by itself, and kept in a file of plain values until it is asked again."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Self

from pydantic import BaseModel, ConfigDict, ValidationError

Curve = tuple[float, ...]
"""One value for each time; NaN where there is none."""


class Part(BaseModel):
    """What one part of the experiment found."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @classmethod
    def kept(cls, folder: Path, identity: str, name: str = "") -> Self | None:
        """The part that lies in a folder, None if it is not there, damaged, or one of another identity.

        `name` tells parts of the same class apart.
        """
        try:
            stored = json.loads(_file(folder, cls, name).read_text("utf-8"))
            if stored["identity"] != _digest(identity):
                return None
            return cls.model_validate(stored["found"])
        except (OSError, ValueError, KeyError, TypeError, ValidationError):
            return None

    def keep(self, folder: Path, identity: str, name: str = "") -> None:
        """Write the part into a folder, all of it or nothing."""
        file = _file(folder, type(self), name)
        file.parent.mkdir(exist_ok=True)
        half = file.with_suffix(".half")
        half.write_text(json.dumps({"identity": _digest(identity), "found": self.model_dump()}), encoding="utf-8")
        half.replace(file)


def _file(folder: Path, part: type[Part], name: str) -> Path:
    return folder / "parts" / f"{name or part.__name__.lower()}.json"


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
