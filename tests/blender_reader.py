"""What Blender makes of GLB, BVH and FBX files, for tests and benchmarks; in a Python that has `bpy`.

    python tests/blender_reader.py JOBS.json      where bpy has a Python of its own: [{file, times, names, rate, out}]
"""
import json
import sys
from pathlib import Path

import numpy as np


def evaluated(path, times, names=None, rate=24.0):
    """Vertices of the one mesh, or the joints of these names: (T, n, 3) metres, with y up as in the file.

    `rate` is that of the frames in FBX.
    """
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps, scene.render.fps_base = round(rate), round(rate) / rate
    file, ending, first = str(Path(path).resolve()), Path(path).suffix, 0.0
    if ending == ".glb":
        bpy.ops.import_scene.gltf(filepath=file, disable_bone_shape=True)
    elif ending == ".fbx":
        bpy.ops.import_scene.fbx(filepath=file, anim_offset=0.0)
    else:
        bpy.ops.import_anim.bvh(filepath=file, global_scale=0.01, update_scene_fps=True)
        first = 1.0                                                        # the frame that BVH begins at
    out = []
    for time in times:
        frame = first + time * scene.render.fps / scene.render.fps_base
        scene.frame_set(int(np.floor(frame)), subframe=float(frame - np.floor(frame)))
        out.append(_vertices(bpy) if names is None else _heads(bpy, names))
    return np.array(out) @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])    # Blender has z up


def _vertices(bpy):
    (thing,) = (each for each in bpy.data.objects if each.type == "MESH")
    thing = thing.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = thing.to_mesh()
    points = np.empty(3 * len(mesh.vertices))
    mesh.vertices.foreach_get("co", points)
    M = np.array(thing.matrix_world)
    return points.reshape(-1, 3) @ M[:3, :3].T + M[:3, 3]


def _heads(bpy, names):
    (thing,) = (each for each in bpy.data.objects if each.type == "ARMATURE")
    thing = thing.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return [thing.matrix_world @ thing.pose.bones[name].head for name in names]


if __name__ == "__main__":
    for job in json.loads(Path(sys.argv[1]).read_text()):
        np.save(job["out"], evaluated(job["file"], job["times"], job["names"], job["rate"]))
