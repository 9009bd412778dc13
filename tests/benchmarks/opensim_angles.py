"""OpenSim's inverse kinematics on the TRC of a recording, beside the motion that our own solver found.

    python tests/benchmarks/opensim_angles.py RECORDING.c3d --folder FOLDER [-o FILE]

Needs `opensim`. `scape mosh` finds person and motion in the recording. An OpenSim model is built of the person: a body
for every part, joints of three rotations at our joint centres with the sequences of the README, the markers of the
layout where they are on the person at rest. OpenSim's InverseKinematicsTool follows motion.trc with it; every marker
counts the same and nothing else does. Told are its marker errors, those of our motion over the same markers, and how
far its angles are from ours in motion.mot; angles.png shows both. That both mean the same by an angle is told by how
far the feet of OpenSim's model are turned against the body's when it takes the angles of motion.mot.
"""
from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import opensim
from protocols import machine, write_report

from completion.__main__ import main as scape
from completion.cli import read_model
from completion.mocap.files.motion_files import joint_centres
from completion.mocap.joint_angles import Joint, SegmentAxes, anatomical_angles, anatomy, rest_joints
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.pose.marked_body import MarkedBody
from completion.motion import Motion
from model.linear import Subject
from scanprep.geometry.rotations import log

COMPARED = ("hip_flexion", "hip_adduction", "knee_angle", "ankle_angle", "arm_flex", "elbow_flex")
AXES = {0: (1, 0, 0), 1: (0, 1, 0), 2: (0, 0, 1)}


def build(subject: Subject, layout: MarkerLayout, wanted: list[str], start: dict[str, float]) -> opensim.Model:
    """The person as an OpenSim model, with those markers of the layout that are wanted; `start` are default places."""
    skeleton, joints = subject.skeleton, rest_joints(subject)
    found = anatomy(skeleton.names, skeleton.parents, joints)
    segment = {part: name for name, part in found.parts.items()}
    frames = [found.frames.get(segment.get(j, ""), found.axes) for j in range(len(joints))]
    origins = joints.copy()
    origins[0] = joints[list(found.hips)].mean(axis=0)
    model = opensim.Model()
    bodies = [opensim.Body(name, 1.0, opensim.Vec3(0), opensim.Inertia(1, 1, 1)) for name in skeleton.names]
    for j, body in enumerate(bodies):
        model.addBody(body)
        p = skeleton.parents[j]
        place = np.zeros(3) if p < 0 else frames[p].T @ (origins[j] - origins[p])
        model.addJoint(_joint(found, segment, j, p, body, model.getGround() if p < 0 else bodies[p], place))
    part, places = _markers(subject, layout)
    for label, j, place in zip(layout.labels, part, places, strict=True):
        if label in wanted:
            model.addMarker(opensim.Marker(label, bodies[j], _vector(frames[j].T @ (place - origins[j]))))
    model.finalizeFromProperties()
    for coordinate in model.updCoordinateSet():
        coordinate.setRangeMin(-20)
        coordinate.setRangeMax(20)
        coordinate.setDefaultValue(start.get(coordinate.getName(), 0.0))
    model.finalizeConnections()
    return model


def _joint(found: SegmentAxes, segment: dict[int, str], j: int, parent: int, body: Any, above: Any, place: np.ndarray
           ) -> Any:
    """Three rotations about z, x and y, with our names and signs where the two parts make a joint of the table."""
    named = [joint for joint in found.joints() if joint.sequence == "zxy" and joint.distal == segment.get(j)
             and joint.proximal == ("ground" if parent < 0 else segment.get(parent))]
    told = named[0] if named else Joint(*[(f"part{j}_z", f"part{j}_x", f"part{j}_y")], "", "", "zxy", (1, 1, 1), False)
    transform = opensim.SpatialTransform()
    for i, (name, axis, sign) in enumerate(zip(told.angles, (2, 0, 1), told.signs, strict=True)):
        signed = sign * (-1 if told.mirrored and axis != 2 else 1) * np.array(AXES[axis])
        _coordinate(getattr(transform, f"upd_rotation{i + 1}")(), name, signed)
    if parent < 0:
        for i, name in enumerate(("pelvis_tx", "pelvis_ty", "pelvis_tz")):
            _coordinate(getattr(transform, f"upd_translation{i + 1}")(), name, np.array(AXES[i]))
    zero = opensim.Vec3(0)
    return opensim.CustomJoint(f"joint{j}", above, _vector(place), zero, body, zero, zero, transform)


def _coordinate(axis: Any, name: str, direction: np.ndarray) -> None:
    axis.setCoordinateNames(opensim.ArrayStr(name, 1))
    axis.setAxis(_vector(direction))
    axis.set_function(opensim.LinearFunction(1.0, 0.0))


def _vector(values: np.ndarray) -> Any:
    return opensim.Vec3(*map(float, values))


def _markers(subject: Subject, layout: MarkerLayout) -> tuple[np.ndarray, np.ndarray]:
    """The part (L,) that carries each marker, and where it is (L, 3) on the person at rest, metres."""
    body, J = MarkedBody(subject, layout, 0.3, 0.3), len(subject.skeleton.parents)
    places = body.positions(body.body.join(np.zeros((1, J, 3)), np.zeros((1, 3))))[0]
    return subject.skeleton.part_of_vertex(subject.template)[layout.nearest], places


def solve(model: opensim.Model, trc: Path, folder: Path) -> dict[str, np.ndarray]:
    """Columns of the motion that OpenSim finds, and of its marker errors, metres."""
    model.printToXML(str(folder / "model.osim"))
    tool = opensim.InverseKinematicsTool()
    tool.setName("opensim")
    tool.set_model_file(str((folder / "model.osim").resolve()))
    tool.setMarkerDataFileName(str(trc.resolve()))
    tool.setResultsDir(str(folder.resolve()))
    tool.setOutputMotionFileName(str((folder / "opensim.mot").resolve()))
    tool.set_report_errors(True)
    tool.set_accuracy(1e-6)
    times = opensim.TimeSeriesTableVec3(str(trc)).getIndependentColumn()
    tool.setStartTime(times[0])
    tool.setEndTime(times[-1])
    tool.run()
    return columns(folder / "opensim.mot") | columns(folder / "opensim_ik_marker_errors.sto")


def turned(model: opensim.Model, subject: Subject, motion: Motion, ours: dict[str, np.ndarray], ground: np.ndarray
           ) -> float:
    """Degrees by which the feet of OpenSim's model, in our angles, are turned against those of the body: at most."""
    skeleton = subject.skeleton
    found = anatomy(skeleton.names, skeleton.parents, rest_joints(subject))
    R, state, most = skeleton.part_rotations(motion.poses), model.initSystem(), 0.0
    for t in range(0, len(R), 20):
        for coordinate in model.updCoordinateSet():
            name = coordinate.getName()
            if name in ours:
                value = float(ours[name][t])
                coordinate.setValue(state, value if name.startswith("pelvis_t") and name != "pelvis_tilt" else
                                    np.radians(value), False)
        model.realizePosition(state)
        for side in "rl":
            foot = found.parts[f"foot_{side}"]
            M = model.getBodySet().get(skeleton.names[foot]).getTransformInGround(state).R()
            theirs = np.array([[M.get(i, k) for k in range(3)] for i in range(3)])
            mine = ground.T @ R[t, foot] @ found.frames[f"foot_{side}"]
            most = max(most, float(np.degrees(np.linalg.norm(log(mine.T @ theirs)))))
    return most


def columns(path: Path) -> dict[str, np.ndarray]:
    """A table of OpenSim, read by it."""
    table = opensim.TimeSeriesTable(str(path))
    return {name: table.getDependentColumn(name).to_numpy() for name in table.getColumnLabels()}


def draw(path: Path, ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray], rate: float) -> None:
    """Both sides of every compared angle over time."""
    import matplotlib
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, panes = plt.subplots(len(COMPARED), 2, figsize=(12, 2.1 * len(COMPARED)), sharex=True)
    for row, name in zip(panes, COMPARED, strict=True):
        for pane, side in zip(row, "rl", strict=True):
            key = f"{name}_{side}"
            pane.plot(np.arange(len(ours[key])) / rate, ours[key], label="motion.mot")
            pane.plot(np.arange(len(theirs[key])) / rate, theirs[key], "--", label="OpenSim")
            pane.set_title(key, fontsize=9)
            pane.set_ylabel("°")
    panes[0, 0].legend()
    figure.tight_layout()
    figure.savefig(path, dpi=80)


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("-o", "--output", default="opensim_angles.json")
    args = parser.parse_args()
    opensim.Logger.removeFileSink()                          # opensim.log, in the folder where one stands
    if scape(["mosh", str(args.recording), "-o", str(args.folder / "mosh")]):
        raise SystemExit("no motion was found")
    trc = next((args.folder / "mosh").glob("*/*/motion.trc"))
    motion, (model, name) = Motion.load(trc.with_name("motion.npz")), read_model(None)
    subject, layout = model.subject(motion.betas), MarkerLayout.load(trc.parent.parent / "layout.json")
    ours = columns(trc.with_name("motion.mot"))
    labels = list(opensim.TimeSeriesTableVec3(str(trc)).getColumnLabels())
    person = build(subject, layout, labels, {k: float(v[0]) for k, v in ours.items() if k.startswith("pelvis_t")
                                             and k != "pelvis_tilt"})
    theirs = solve(person, trc, args.folder)
    told_angles = anatomical_angles(motion, subject, joint_centres(motion, subject))
    draw(args.folder / "angles.png", ours, theirs, motion.rate)
    told = motion.residuals_of_trusted()
    used = [i for i, label in enumerate(motion.labels) if label in layout.labels]
    off = {key: ours[key] - theirs[key] for side in "rl" for key in (f"{each}_{side}" for each in COMPARED)}
    report = {"recording": args.recording.name, "model": name.split(",")[0], "frames": len(told), "markers": len(used),
              "opensim_rms_mm": 1e3 * float(np.sqrt((theirs["marker_error_RMS"] ** 2).mean())),
              "opensim_max_mm": 1e3 * float(theirs["marker_error_max"].max()),
              "ours_rms_mm": 1e3 * float(np.sqrt(np.nanmean(told[:, used] ** 2))),
              "ours_max_mm": 1e3 * float(np.nanmax(told[:, used])),
              "feet_in_our_angles_degrees": turned(person, subject, motion, ours, told_angles.ground),
              "rms_degrees": {key: float(np.sqrt((each ** 2).mean())) for key, each in off.items()},
              "rms_degrees_without_offset": {key: float(each.std()) for key, each in off.items()},
              "range_degrees": {key: float(np.ptp(ours[key])) for key in off}, "machine": machine()}
    for key, value in report.items():
        print(key, value)
    write_report(args.output, report)


if __name__ == "__main__":
    main()
