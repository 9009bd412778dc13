"""`scape`: all commands under one name."""
from __future__ import annotations

import sys

from scanprep.interrupts import leave_at_once

# name -> line of help, function; modules are imported when their command is called
COMMANDS = {
    "demo": ("The whole chain on synthetic scans; ends with a page to open.", "completion.demo.cli:demo"),
    "sample": ("Files to try every command with: raw scans, a half view, a walk.",
               "completion.demo.sample:write_sample"),
    "prep": ("Scans -> registered meshes and a skeleton; also its single stages.", "scanprep.cli:group"),
    "view": ("Meshes, scans, models, motions and results in the browser.", "completion.viewing.cli:view_files"),
    "measure": ("Stature, girths, lengths and widths of bodies; or a body that has them.",
                "completion.measuring.cli:measure_bodies"),
    "pick": ("Landmarks of scans, clicked in the browser.", "scanprep.pipeline.pick:pick_landmarks"),
    "learn": ("Registered meshes -> a body model.", "model.learning.cli:learn"),
    "model": ("Look into a body model and pose it.", "model.cli:group"),
    "complete": ("A partial scan, or several views -> the whole body.", "completion.partial.cli:complete_scan"),
    "label": ("Markers without names -> which point is which marker.",
              "completion.mocap.labelling.cli:label_recordings"),
    "animate": ("Markers -> the person and a moving body.", "completion.mocap.animate.cli:animate_markers"),
    "mosh": ("Markers -> shape, motion and soft tissue; a file, or a folder of people.",
             "completion.mocap.mosh.cli:mosh_markers"),
    "layout": ("Marker sets: look at them, transfer them to other bodies, design them.",
               "completion.mocap.marker_sets.cli:group"),
    "statue": ("One scan -> a layered character that moves, with all its detail.", "model.statue.cli:group"),
    "track": ("Frames of points -> a moving body, without markers.", "completion.tracking.cli:track_frames"),
    "completion": ("What a shell needs to complete these commands and their flags.", "completion.shells:write_shell"),
}


def main(argv: list[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    if argv is None:
        argv = sys.argv[1:]
        leave_at_once()
    if argv in (["--version"], ["-V"]):
        from importlib.metadata import version

        sys.stdout.write(f"scapekit {version('scapekit')}\n")
        return 0
    from scanprep.command_line import dispatch

    return dispatch(COMMANDS, "scape", argv, "From raw 3D body scans to moving people.")


if __name__ == "__main__":
    sys.exit(main())
