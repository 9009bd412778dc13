"""The arguments of `scape mosh`, stored in its output, so that it can run again with a corrected layout."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from model.body import BodyModel
from model.files import load_model
from scanprep.arguments import UsageError
from scanprep.batch.calls import KeptCall

from ...cli import read_model
from .mosh import MoshConfig
from .recordings import Actor, find_actors


@dataclass(frozen=True, eq=False)
class Models:
    """The model and its name, the models of `female` and `male` people, if any, and a character, if any."""

    neutral: BodyModel
    name: str
    sexes: Mapping[str, BodyModel]
    character: BodyModel | None


@dataclass(frozen=True)
class MoshCall(KeptCall):
    """The arguments of `scape mosh`, without those about workers."""

    command: ClassVar[str] = "scape mosh"
    may_be_files: ClassVar[tuple[str, ...]] = ("layout", "subjects")
    markers: tuple[Path, ...]
    model: tuple[Path, ...] = ()
    layout: str | None = None
    subjects: str = "auto"
    retarget_to: Path | None = None
    unit: str | None = None
    rate: float | None = None
    unlabelled: bool = False
    static: Path | None = None
    config: MoshConfig = field(default_factory=MoshConfig)

    def actors(self, output: Path) -> list[Actor]:
        """Return the people of the recordings that are there now."""
        return find_actors(self.markers, self.subjects, output)

    def models(self) -> Models:
        """Load all models that were named; UsageError for a number other than none, one or three."""
        loaded, name = read_model(self.model[0] if self.model else None)
        if len(self.model) not in (0, 1, 3):
            raise UsageError("--model: expected one, or three of both sexes, of women and of men, got "
                             f"{len(self.model)}")
        if self.retarget_to is not None and len(self.model) == 3:
            raise UsageError("--character: a character is made of one model; expected one --model, got 3")
        sexes = dict(zip(("female", "male"), map(load_model, self.model[1:]), strict=True)) if self.model[1:] else {}
        character = None if self.retarget_to is None else load_model(self.retarget_to)
        if character and (character.kind != loaded.kind
                          or character.template.faces.shape != loaded.template.faces.shape):
            raise ValueError(f"{self.retarget_to}: expected a character made of the model, with its "
                             f"{len(loaded.template.faces)} triangles, found {character.kind} with "
                             f"{len(character.template.faces)}")
        return Models(loaded, name, sexes, character)
