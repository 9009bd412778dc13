"""What `scape prep run` was called with, kept in the set, so that the same can be done again from elsewhere.

`run.json` holds absolute paths, and the settings as `--write-config` prints them.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path

from .. import config_files
from ..geometry import storage
from ..geometry.files import read_mesh
from ..geometry.landmarks import read_template_landmarks
from ..geometry.mesh import Mesh
from .prepare import PrepareConfig
from .scan import Init
from .scans import ScanTask, find_scans

RUN, KIND, VERSION = "run.json", "call of scape prep run", 1
LISTED = 5                    # scans that a line names


@dataclass(frozen=True)
class Call:
    """Scans, template and settings of a set; paths are absolute once they were read."""

    scans: Path
    template: Path
    landmarks: Path | None = None
    template_landmarks: Path | None = None
    subject: str = ""
    config: PrepareConfig = field(default_factory=PrepareConfig)

    def tasks(self) -> list[ScanTask]:
        """The scans as they are now."""
        return find_scans(self.scans, self.landmarks, self.subject)

    def inputs(self, tell: Callable[[str], None]) -> tuple[list[ScanTask], Mesh, dict[str, int]]:
        """Scans, template and its landmarks, as their files are now; told of scans without landmarks."""
        body, tasks = read_mesh(self.template), self.tasks()
        marks, note = _template_marks(self.template, self.template_landmarks, body, tasks, self.config.scan.init)
        if note:
            tell(f"note: {note}")
        return tasks, body, marks

    def write(self, folder: Path) -> None:
        """Keep it in a folder."""
        given = {f.name: getattr(self, f.name) for f in fields(self)}
        paths = {name: value.absolute() for name, value in given.items() if isinstance(value, Path)}
        storage.write_json(folder / RUN, {"kind": KIND, "version": VERSION, **given, **paths,
                                          "config": config_files.write({"config": self.config})})

    @classmethod
    def read(cls, folder: Path) -> Call:
        """That of a set; StorageError for one that does not tell."""
        path = folder / RUN
        if not path.exists():
            raise storage.StorageError(f"{folder}: it does not tell where its scans are, as sets that scape prep run "
                                       "made earlier; run the same command once more")
        with storage.taking_apart(path, f"a {KIND}"):
            told = storage.read_json(path, f"a {KIND}")
            if told.pop("kind") != KIND or told.pop("version") != VERSION:
                raise ValueError(f"kind and version are not those of a {KIND} that is known here")
            config = config_files.parsed(told.pop("config"), path, {"config": PrepareConfig()})["config"]
            assert isinstance(config, PrepareConfig), "settings keep their type"
            paths = {name: told.pop(name) for name in ("scans", "template", "landmarks", "template_landmarks")}
            return cls(**{name: value and Path(value) for name, value in paths.items()},
                       subject=str(told.pop("subject")), config=config)


def _template_marks(template: Path, given: Path | None, body: Mesh, tasks: Sequence[ScanTask], init: Init
                    ) -> tuple[dict[str, int], str]:
    """The landmarks of the template, where any scan is led by landmarks; and what is to be told."""
    without = [task.name for task in tasks if task.landmarks is None]
    if init == "pose":
        return {}, "no landmarks are used; all scans must be near the template's pose"
    if init == "automatic" or (init == "best" and len(without) == len(tasks)):
        return {}, "no landmarks are used; look at the page for scans turned round or mirrored"
    note = (f"no landmarks for {len(without)} of {len(tasks)} scans ({', '.join(without[:LISTED])}); "
            "look at the page for those turned round or mirrored") if without and init == "best" else ""
    return read_template_landmarks(template, body, given), note
