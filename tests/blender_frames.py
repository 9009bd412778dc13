"""A file of another program as Blender shows it: run by `shown`, in a process of its own."""
import json
import subprocess
import sys

import numpy as np


def shown(path, frames, rate, folder):
    """Vertices (n, N, 3) of the only mesh of an FBX or USD file at some frames, and joints {name: (n, 3)}."""
    subprocess.run([sys.executable, __file__, str(path), json.dumps([*map(float, frames)]), str(rate), str(folder)],
                   check=True, capture_output=True, timeout=200)
    found = np.load(folder / "shown.npz")
    return found["vertices"], {name: found[f"joint {name}"] for name in found["names"]}


def _main(path, frames, rate, folder):
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps, scene.render.fps_base = round(float(rate)), round(float(rate)) / float(rate)
    if path.endswith(".fbx"):
        bpy.ops.import_scene.fbx(filepath=path, anim_offset=0.0)
    else:
        bpy.ops.wm.usd_import(filepath=path)
    (mesh,) = [thing for thing in bpy.data.objects if thing.type == "MESH"]
    armatures = [thing for thing in bpy.data.objects if thing.type == "ARMATURE"]
    vertices, joints = [], {}
    for frame in json.loads(frames):
        scene.frame_set(int(frame), subframe=frame % 1)
        now = bpy.context.evaluated_depsgraph_get()
        body = mesh.evaluated_get(now)
        vertices.append([body.matrix_world @ vertex.co for vertex in body.to_mesh().vertices])
        for armature in armatures:
            placed = armature.evaluated_get(now)
            for bone in placed.pose.bones:
                joints.setdefault(bone.name, []).append(placed.matrix_world @ bone.head)
    np.savez(f"{folder}/shown.npz", vertices=np.array(vertices), names=np.array([*joints], dtype=str),
             **{f"joint {name}": np.array(places) for name, places in joints.items()})


if __name__ == "__main__":
    _main(*sys.argv[1:])
