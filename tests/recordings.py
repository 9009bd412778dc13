"""A small recording of the worm by two cameras; started as a program it is tracked, with the arguments of `track`."""
import json
import sys
from dataclasses import replace

import numpy as np
from completion_bodies import half_view, worm_with_prior
from test_completion_partial import MARKS
from test_completion_tracking import SETTINGS, motion

from completion.tracking import cli, report
from scanprep.command_line import run
from scanprep.geometry.files import PointCloud, write_points
from scanprep.pictures.page import Page

FRAMES = 9


def write_recording(folder):
    """A model file, frames in which one is left out, and landmarks of the first; returns the bodies."""
    model = worm_with_prior()
    poses, trans = motion(FRAMES)
    model = replace(model, info={**model.info, "landmarks": {f"m{v}": int(v) for v in MARKS}})
    model.save(folder / "model.npz")
    bodies = [model.template.with_vertices(v) for v in model.subject(None).vertices(poses, trans)]
    for i, body in enumerate(bodies):
        for name, side in (("front", [0.2, -1, 0.4]), ("back", [-0.3, 1, 0.3])):
            if i != 5:
                (folder / "frames" / name).mkdir(parents=True, exist_ok=True)
                seen = half_view(body, np.array(side), 700)[0]
                write_points(folder / "frames" / name / f"{i:03d}.ply", PointCloud(seen))
    (folder / "marks.json").write_text(json.dumps({f"m{v}": bodies[0].vertices[v].tolist() for v in MARKS}))
    return bodies


def arguments(folder, output, *more):
    """The command line that tracks a recording."""
    return [str(folder / "frames"), "-m", str(folder / "model.npz"), "-o", str(output), "--landmarks",
            str(folder / "marks.json"), *map(str, more)]


def track_quickly(frames: cli.FramesArg, output: cli.Output, model: cli.ModelOrNone, landmarks: cli.Path,
                  subject: str | None = None, surfaces: bool = False, rate: float = 25.0,
                  smoothing: int = 2, shape_frames: int = 3, *, space: cli.Workspace) -> cli.Outcome:
    """The command with settings that make haste."""
    config = replace(SETTINGS, shape_frames=shape_frames, smoothing=smoothing)
    return cli.track_frames(frames, output, model, rate, landmarks=landmarks, subject=subject, unit="m",
                            surfaces=surfaces, config=config, space=space)


def track(*argv):
    """Exit code of the command."""
    return run(track_quickly, "scape track", list(argv))


def quick_page(motion, *_):
    """In place of the pictures, which take longer than all else."""
    return Page(f"{motion.poses.sum()}")


if __name__ == "__main__":
    report.track_page = quick_page
    sys.exit(track(*sys.argv[1:]))
