"""The people in an output of `scape mosh`, for review: read from the files when needed."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from model.body import BodyModel
from model.linear import Subject
from scanprep.geometry import storage
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.pictures.scene import Pane
from scanprep.pictures.shading import Bones, Dots, Heat, Solid

from ...motion import Motion
from ...motion_pictures import facing, mean_over, upwards, worst_frames
from ..files.markers import MarkerSequence, read_markers
from ..labelling.labelled_file import LABELLED, read_labelled
from ..marker_sets.layout import MarkerLayout
from .call import Models
from .pictures import person_in_mean_pose
from .recordings import Actor, Recording


@dataclass(frozen=True)
class WorstFrame:
    """A frame of a recording, its text for the page, and the mean distance of its markers, metres."""

    take: int
    number: int
    told: str
    off: float


@dataclass(frozen=True, eq=False)
class FoundPerson:
    """A person as found by `scape mosh`, in a folder.

    Attributes
    ----------
    recordings : tuple of Recording, those that could be read
    layout : MarkerLayout
        Places of the markers that were found, in the names of the recordings.
    about : dict
        Content of subject.json.
    """

    name: str
    folder: Path
    recordings: tuple[Recording, ...]
    model: BodyModel
    layout: MarkerLayout
    about: dict[str, Any]
    unit: str | None
    rate: float | None

    @property
    def layout_name(self) -> str:
        return str(self.about["layout"])

    @cached_property
    def subject(self) -> Subject:
        return self.model.subject(np.array(self.about["betas"]))

    @cached_property
    def body(self) -> Mesh:
        """The body at rest."""
        return person_in_mean_pose(self.model, np.array(self.about["betas"]))

    @cached_property
    def skin(self) -> Surface:
        """The surface at rest, for nearest points."""
        return Surface(self.body)

    @cached_property
    def places(self) -> dict[str, np.ndarray]:
        """Label -> place (3,), metres, on the body at rest."""
        return dict(zip(self.layout.labels, self.layout.skin_points(self.body.vertices), strict=True))

    @cached_property
    def motions(self) -> list[Motion]:
        """The motion of each recording."""
        return [Motion.load(self.folder / one.name / "motion.npz") for one in self.recordings]

    @cached_property
    def markers(self) -> list[MarkerSequence]:
        """The measured markers of each recording."""
        sequences = list[MarkerSequence]()
        for one in self.recordings:
            labelled = self.folder / one.name / LABELLED
            sequences.append(read_labelled(labelled, one.path, self.unit, self.rate) if labelled.exists()
                             else read_markers(one.path, self.unit, one.who, self.rate))
        return sequences

    @cached_property
    def labels(self) -> list[str]:
        """All labels of the recordings."""
        return list(dict.fromkeys(label for motion in self.motions for label in motion.labels))

    @cached_property
    def off(self) -> dict[str, float]:
        """Label -> mean distance from the simulated marker, metres; NaN for one that was not used."""
        # residuals of each label, over all recordings
        columns: dict[str, list[np.ndarray]] = {}
        for motion in self.motions:
            for label, column in zip(motion.labels, motion.residuals.T, strict=True):
                columns.setdefault(label, []).append(column)
        return {label: float(mean_over(np.concatenate(residuals), 0)) for label, residuals in columns.items()}

    @cached_property
    def names(self) -> list[str]:
        """Labels of markers that have a place or were left out, the worst first."""
        out = [label for label in self.about["left_out"] if label in self.off]
        return [*out, *sorted(set(self.places) - set(out), key=lambda label: -np.nan_to_num(self.off.get(label, 0.0)))]

    @cached_property
    def doubts(self) -> dict[str, list[str]]:
        """Label -> sentences about what was wrong with it."""
        doubts: dict[str, list[str]] = {}
        # what was found of the person: misplaced markers, exchanged names, markers left out
        for label, moved in self.about["misplaced"].items():
            before, left = (1000 * moved[name] for name in ("from_the_layout", "left"))
            doubts.setdefault(label, []).append(f"misplaced by {before:.0f} mm; moved to its real place, "
                                                f"{left:.0f} mm are left")
        for pair in self.about["exchanged"]:
            for label, other in (pair, pair[::-1]):
                doubts.setdefault(label, []).append(f"name swapped with {other} throughout; corrected")
        for label in self.about["left_out"]:
            doubts.setdefault(label, []).append("misplaced, and no place was found: left out")
        # what was found of each recording: distrusted markers and artefacts
        for one, motion in zip(self.recordings, self.motions, strict=True):
            for label in motion.distrusted:
                doubts.setdefault(label, []).append(f"{one.name}: hardly believed")
            path = self.folder / one.name / "artefacts.json"
            told = storage.read_json(path, "a list of artefacts")
            with storage.taking_apart(path, "a list of artefacts"):
                rate = told["rate"]
                lines = [(label, f"exchanged with {other} from {s['begin'] / rate:.2f} to {s['end'] / rate:.2f} s")
                         for s in told["exchanges"] for label, other in (s["labels"], s["labels"][::-1])]
                lines += [(b["label"], f"{b['kind']} by {1000 * b['distance']:.0f} mm from {b['begin'] / rate:.2f} to "
                           f"{b['end'] / rate:.2f} s") for b in told["bad"]]
            for label, line in lines:
                doubts.setdefault(label, []).append(f"{one.name}: {line}")
        return doubts

    @cached_property
    def worst(self) -> list[WorstFrame]:
        """The frames of all recordings with the largest distances, the worst first."""
        every = []
        frames = 6  # frames shown for a person
        for take, (one, motion) in enumerate(zip(self.recordings, self.motions, strict=True)):
            for t in worst_frames(motion, frames).tolist():
                off = float(mean_over(motion.residuals[t], 0))
                if np.isfinite(off):
                    told = f"{one.name}, {t / motion.rate:.2f} s: {1000 * off:.0f} mm"
                    every.append(WorstFrame(take, t, told, off))
        return sorted(every, key=lambda frame: -frame.off)[:frames] or [WorstFrame(0, 0, self.recordings[0].name, 0.0)]

    def pane(self, frame: WorstFrame) -> Pane:
        """Return the body in a frame with the measured markers, coloured by their distance from the simulated ones."""
        motion = self.motions[frame.take]
        vertices = motion.vertices(self.subject, np.array([frame.number]))[0].astype(float)
        body, markers = self.model.template.with_vertices(vertices), self.markers[frame.take]
        measured = dict(zip(markers.labels, markers.positions[frame.number], strict=True))
        # names as they were corrected, then the markers that have a place
        for first, second in self.about["exchanged"]:
            if first in measured and second in measured:
                measured[first], measured[second] = measured[second], measured[first]
        # simulated and measured places of each marker, and a rod between them
        has = {label: place for label, place in zip(self.layout.labels, self.layout.place(body), strict=True)
               if label in measured}
        seen, there = np.array([measured[label] for label in has]), np.array(list(has.values()))
        far = np.linalg.norm(seen - there, axis=1)
        dots = Dots(seen, Heat(far, 0.0, 0.05, "measured marker from where the body has it"), 0.014, name="markers",
                    labels=[f"{label} {1000 * d:.0f}" for label, d in zip(has, far, strict=True)])
        camera = facing(self.subject, motion.poses[frame.number], body.vertices, vertical=upwards(motion, self.subject))
        rods = Bones(there, seen, (0.35, 0.40, 0.48), 0.004, name="from the body")
        return Pane([Solid(body, name="body"), dots, rods], camera, frame.told)


def load_people(folder: Path, actors: Sequence[Actor], models: Models, unit: str | None,
                rate: float | None) -> list[FoundPerson]:
    """Read the people of an output; StorageError for damaged files, ValueError where there are none."""
    people = []
    for actor in actors:
        own = folder / actor.name
        about = storage.read_json(own / "subject.json", "a person that scape mosh found")
        with storage.taking_apart(own / "subject.json", "a person that scape mosh found"):
            # the model of the person's sex, and the keys of subject.json that are needed
            model = models.sexes.get((about["sex"] or {}).get("sex", ""), models.neutral)
            # files of earlier versions have "worn_elsewhere" for "misplaced"
            about |= {"misplaced": about["worn_elsewhere"]} if "worn_elsewhere" in about else {}
            about = {name: about[name] for name in ("betas", "layout", "misplaced", "exchanged", "left_out")}
        layout = MarkerLayout.load(own / "layout.json", len(model.template.vertices))
        readable = tuple(one for one in actor.recordings if (own / one.name / "motion.npz").exists())
        if readable:
            people.append(FoundPerson(actor.name, own, readable, model, layout, about, unit, rate))
    if not people:
        raise ValueError(f"{folder}: expected what scape mosh found of the people, there is none; run it once more")
    return people
