"""`scape layout`: list marker sets, show them, transfer them to other bodies."""
from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np

from model.files import load_model
from model.fitting.bodies import at_rest
from scanprep.arguments import Place, UsageError
from scanprep.cli import MM, Output, Unit
from scanprep.command_line import dispatch
from scanprep.console import Metric, Outcome, bar
from scanprep.geometry import storage
from scanprep.geometry.files import read_mesh, write_mesh
from scanprep.geometry.landmark_writing import marker_set
from scanprep.geometry.landmarks import read_landmarks, read_template_landmarks, try_match_landmarks
from scanprep.geometry.mesh import Mesh
from scanprep.judgement import Judgement
from scanprep.registration.person import average_person
from scanprep.skeleton.tree import Skeleton
from scanprep.synthetic.landmarks import landmarks as synthetic_landmarks

from ...cli import ModelOrNone, read_model
from .layout import MarkerLayout
from .named import layout_names, layout_summaries, read_layout
from .opensim import opensim_markers
from .symmetry import label_pairs

LayoutArg = Annotated[str, Place("LAYOUT")]

COMMANDS = {
    "list": ("The marker sets that come along.", "completion.mocap.marker_sets.cli:list_layouts"),
    "show": ("A layout on a body: pictures from four sides and a table.",
             "completion.mocap.marker_sets.cli:show_layout"),
    "transfer": ("A layout on another triangulation, by registration.",
                 "completion.mocap.marker_sets.cli:transfer_to"),
    "design": ("Which markers to put on: the set from which bodies are estimated best.",
               "completion.mocap.marker_selection.cli:design"),
}


def group(argv: list[str]) -> int:
    """Run a command of `scape layout`."""
    return dispatch(COMMANDS, "scape layout", argv, "Where on the body the markers sit.")


def list_layouts() -> Outcome:
    """The marker sets that come along, and the bodies they are known on.

    Example: scape layout list
    """
    return Outcome(None, [Metric(name, count, f"markers; {about} On {bodies}.")
                          for name, count, about, bodies in layout_summaries()], judgement=None)


def show_layout(layout: LayoutArg, output: Output, model: ModelOrNone = None, body: Path | None = None,
                unit: Unit | None = None) -> Outcome:
    """A layout on a body: pictures from four sides with the labels, and a table of all markers.

    Example: scape layout show vicon47 -m model.npz -o markers

    Written are layout.png, report.html and layout.json (for --layout of other commands); of a person with a skeleton
    markerset.xml, where each marker sits on the bodies of OpenSim, to begin with in its scale tool.

    Args:
        layout: One of `scape layout list`, or a file.
        output: Folder to write to.
        model: Model of `scape learn`, whose mean person is shown; without it, and without --body, that of the synthetic
            people.
        body: Mesh to show it on, instead of a model.
        unit: Unit of the mesh.
    """
    from scanprep.pictures.shading import save_png

    from .pictures import layout_page, picture_layout

    if model is not None and body is not None:
        raise UsageError("--model and --body: expected one of them")
    # the body, the layout on it, and its picture
    shown, skeleton, kept, name = _body(model, body, unit)
    found = read_layout(layout, shown, kept, skeleton)
    figures = _figures(found, shown)
    picture = picture_layout(shown, found)
    output.mkdir(parents=True, exist_ok=True)
    save_png(output / "layout.png", picture)
    found.save(output / "layout.json")
    # an OpenSim marker set, where the skeleton is a person's
    if skeleton is not None:
        with contextlib.suppress(ValueError):                       # a skeleton without a person's parts
            storage.write_file(output / "markerset.xml", marker_set(opensim_markers(found, shown, skeleton)))
    layout_page(layout, shown, found, picture, {m.name: f"{m.text()} {m.unit}" for m in figures}, skeleton
                ).write(output / "report.html")
    return Outcome(output, [Metric("body", name), *figures], {"layout": layout}, judgement=Judgement())


def transfer_to(layout: LayoutArg, target: Path, output: Output, source: Path | None = None,
                landmarks: Path | None = None, source_landmarks: Path | None = None, unit: Unit | None = None
                ) -> Outcome:
    """A layout on another triangulation: the source body is registered to the target and takes its markers along.

    Example: scape layout transfer vicon47 --target mine.ply -o mine.layout.json

    Without landmarks, places that look alike are sought; they cannot tell how far a smooth limb is rotated about
    itself, so look at the picture beside the output, and name landmarks where it is wrong: ends of the limbs, inner
    and outer sides of knees, elbows, wrists.

    Args:
        layout: One of `scape layout list`, or a file.
        target: Mesh to bring it to, in any pose, or a model file (.npz), whose template it is.
        output: Layout file to write; pictures and the registered source are written beside it.
        source: Mesh that the layout is for; else the average of the synthetic people, for the sets that come along.
        landmarks: Landmarks of the target.
        source_landmarks: Landmarks of the source, of the same names; else the file of its name beside it.
        unit: Unit of the target and its landmarks.
    """
    from scanprep.pictures.shading import save_png

    from .pictures import picture_layout
    from .transfer import UNCERTAIN, transfer_layout

    # source and target bodies, and the layout on the source
    ours = average_person().mesh if source is None else read_mesh(source)
    theirs = at_rest(load_model(target)) if target.suffix.lower() == ".npz" else read_mesh(target, unit)
    if source is None and layout not in layout_names():
        raise ValueError(f"{layout}: expected the mesh that it is for, --source; without one, one of "
                         f"{', '.join(layout_names())}")
    found = read_layout(layout, ours, None)
    pairs = None
    # pairs of landmarks of the same name on both bodies
    if landmarks is not None:
        marks = synthetic_landmarks() if source is None and source_landmarks is None else read_template_landmarks(
            source or Path("average person"), ours, source_landmarks, "--source-landmarks")
        pairs = try_match_landmarks(landmarks, marks, read_landmarks(landmarks, theirs, unit))
    # register and transfer, then write the layout, a picture and the registered source
    with bar("registering") as progress:
        result = transfer_layout(found, ours, theirs, pairs, progress=progress)
    result.layout.save(output)
    save_png(output.with_suffix(".png"), picture_layout(theirs, result.layout))
    write_mesh(output.with_suffix(".registered.ply"), result.registered)
    doubts = [f"{result.uncovered:.0%} of the target is not covered by the source; look at "
              f"{output.with_suffix('.png').name}, and name landmarks if limbs are wrong"]
    return Outcome(output, [
        *_figures(result.layout, theirs), Metric("landmarks", 0 if pairs is None else len(pairs[0])),
        Metric("distance of the registered source, RMS", MM * result.rms, "mm"),
        *([] if pairs is None else [Metric("distance of landmarks, RMS", MM * result.landmark_rms, "mm")]),
        Metric("target not covered", 100 * result.uncovered, "%"),
        Metric("largest distance at a marker", MM * float(result.distances.max()), "mm"),
        Metric("markers without data below them", int((result.confidence < 0.5).sum()))], {"layout": layout},
                   judgement=Judgement.of(check=doubts if result.uncovered > UNCERTAIN else []))


def _body(model: Path | None, body: Path | None, unit: Unit | None
          ) -> tuple[Mesh, Skeleton | None, np.ndarray | None, str]:
    """Return the body to show, its skeleton, the vertices that it kept of the synthetic people, and its name."""
    if body is not None:
        return read_mesh(body, unit), None, None, str(body)
    loaded, name = read_model(model)
    kept, rest = loaded.info.get("people_vertices"), at_rest(loaded)
    skeleton = replace(loaded.skeleton, joints=loaded.joint_regressor @ rest.vertices)
    return rest, skeleton, None if kept is None else np.array(kept), name


def _figures(layout: MarkerLayout, body: Mesh) -> list[Metric]:
    """Return counts of markers and pairs, and the least distance of two markers."""
    from scipy.spatial import cKDTree

    pairs = label_pairs(layout.labels)
    own = np.arange(len(pairs))
    points = layout.place(body)
    metrics = [Metric("markers", len(own)), Metric("pairs of left and right", int((pairs > own).sum())),
               Metric("without a side", int((pairs == own).sum())),
               Metric("without their partner", int((pairs < 0).sum())), Metric("loose", len(layout.loose))]
    if len(own) > 1:
        apart, other = cKDTree(points).query(points, 2)
        i = int(apart[:, 1].argmin())
        metrics.append(Metric(f"least distance ({layout.labels[i]}, {layout.labels[other[i, 1]]})",
                              MM * float(apart[i, 1]), "mm"))
    return metrics
