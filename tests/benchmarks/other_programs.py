"""What other programs make of our files: their vertices or joints against our exact bodies, in millimetres.

    python tests/benchmarks/other_programs.py --folder DIR [-m MODEL.npz --motion MOTION.npz] [-o FILE]
        [--bpy PYTHON] [--npm DIR]

The motion, else a walk of a synthetic person, is exported as GLB, BVH and, by the command of model/README.md, FBX, a
body at rest as static GLB. Every file is opened in Blender (a Python that has `bpy`, named by `--bpy` or `$BPY`), GLB
in three.js (headless Chromium, skinned on the processor); the Khronos validator checks GLB. `--npm` or `$NPM` is a
folder in which `npm install three gltf-validator` was called. Programs that are not there are left out. The result
holds a row for each file and program; a new file is a new entry of `cases`, a new program one of `PROGRAMS`.
"""
from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
from protocols import machine, write_report

FRAMES = 10


def synthetic_walk(path):
    """The files of the model of synthetic people, and of a walk of two seconds of one of them."""
    from completion.motion import Motion
    from model.built_in import load_built_in_model
    from model.files import BUILT_IN
    from scanprep.synthetic.people import synthesise_walk

    betas = np.random.default_rng(0).normal(0, 0.7, load_built_in_model().n_betas)
    poses, trans = synthesise_walk(120, 60.0)
    Motion(poses, trans, betas, 60.0, np.zeros((len(poses), 0)), ()).save(path)
    return Path(BUILT_IN), path


def cases(model_file, motion_file, folder):
    """Files of a motion: {name: (path, (T, n, 3) metres by the axes of the file, seconds (T,), n names or None)}.

    What is compared with vertices has no names; joints have.
    """
    from dataclasses import replace

    from completion.mocap.files.motion_files import write_glb, write_motion_bvh
    from completion.motion import Motion
    from model.export.bvh import write_bvh
    from model.export.conventions import for_programs
    from model.export.correctives import motion_correctives
    from model.export.glb import write_skinned_glb
    from model.files import load_model
    from model.rig import joint_places, make_rig, subject_rig
    from scanprep.geometry.farthest_points import spread_indices
    from scanprep.geometry.files import write_mesh
    from scanprep.geometry.format_glb import tallest, turn_up
    from scanprep.pictures.camera import guess_upright

    model, motion = load_model(model_file), Motion.load(motion_file)
    subject = model.subject(motion.betas)
    frames = spread_indices(len(motion.poses), FRAMES)
    up = guess_upright(subject.template)[0]
    U, times, exact = turn_up(up).T, frames / motion.rate, motion.vertices(subject, frames)
    found = {}

    def path(name):
        return folder / name

    write_glb(path("animation.glb"), motion, subject)
    found["animation.glb"] = exact @ U, times, None
    rig = make_rig(model, motion.betas, 0 if motion.betas is None else 4)
    rig = replace(rig, correctives=motion_correctives(rig, subject, motion.poses))
    root = "pelvis" if "pelvis" in rig.skeleton.names else rig.skeleton.names[-1]
    names = "mixamo" if "pelvis" in rig.skeleton.names else None
    ready, poses, trans = for_programs(rig, motion.poses, motion.trans, up, root, names)
    write_skinned_glb(path("rerooted.glb"), ready, poses, trans, motion.rate, up)
    found["rerooted.glb"] = exact @ U, times, None
    plain = subject_rig(subject)
    write_skinned_glb(path("skinned.glb"), plain, motion.poses, motion.trans, motion.rate, up)
    found["skinned.glb"] = plain.vertices(motion.poses[frames], motion.trans[frames]) @ U, times, None
    body = subject.template.with_vertices(exact[0])
    write_mesh(path("mesh.glb"), body)
    found["mesh.glb"] = exact[:1] @ turn_up(tallest(body.vertices)).T, times[:1], None
    write_motion_bvh(path("motion.bvh"), motion, subject)
    joints = joint_places(plain.skeleton, motion.poses[frames], motion.trans[frames]) @ U
    found["motion.bvh"] = joints, times, plain.skeleton.names
    write_bvh(path("rerooted.bvh"), ready.skeleton, poses, trans, motion.rate, "cm", up, ready.mesh)
    joints = joint_places(ready.skeleton, poses[frames], trans[frames]) @ U
    found["rerooted.bvh"] = joints, times, ready.skeleton.names
    return {name: (path(name), *rest) for name, rest in found.items()}


def with_fbx(asked, cases, folder):
    """The cases with the FBX file that Blender makes of a GLB, by the command of the documentation."""
    told = (Path(__file__).parents[2] / ".docs/pages/methods/other-models.md").read_text()
    told = re.search(r'--python-expr "(.*?)"', told, re.S)[1].replace("fps = 30", f"fps = {asked.rate:g}")
    told = told.replace("walk.glb", "rerooted.glb").replace("walk.fbx", "rerooted.fbx")
    subprocess.run([asked.bpy, "-c", told], cwd=folder, check=True, stdout=subprocess.DEVNULL,
                   stderr=subprocess.DEVNULL)
    return cases | {"rerooted.fbx": (folder / "rerooted.fbx", *cases["rerooted.glb"][1:])}


def blender(asked, cases, folder):
    """{file: (T, n, 3) metres by the axes of the file} by Blender."""
    jobs = [{"file": str(path.resolve()), "times": times.tolist(), "names": names, "rate": asked.rate,
             "out": str(folder / f"{name}.npy")} for name, (path, _, times, names) in cases.items()]
    (folder / "jobs.json").write_text(json.dumps(jobs))
    reader = Path(__file__).parents[1] / "blender_reader.py"
    subprocess.run([asked.bpy, str(reader), str(folder / "jobs.json")], check=True, stdout=subprocess.DEVNULL,
                   stderr=subprocess.DEVNULL)
    return {name: np.load(folder / f"{name}.npy") for name in cases}


# ---- three.js in a browser

_PAGE = """<script type="importmap">{"imports": {"three": "/three/build/three.module.js"}}</script>
<script type="module">
import * as THREE from "three";
import { GLTFLoader } from "/three/examples/jsm/loaders/GLTFLoader.js";
window.evaluate = async (name, times) => {
  const gltf = await new GLTFLoader().loadAsync("/files/" + name);
  let mesh;
  gltf.scene.traverse((each) => { if (each.isMesh) mesh = each; });
  const mixer = new THREE.AnimationMixer(gltf.scene), out = [], point = new THREE.Vector3();
  for (const clip of gltf.animations) {
    const action = mixer.clipAction(clip);
    action.setLoop(THREE.LoopOnce);
    action.clampWhenFinished = true;
    action.play();
  }
  for (const time of times) {
    mixer.setTime(time);
    gltf.scene.updateMatrixWorld(true);
    const points = [];
    for (let i = 0; i < mesh.geometry.attributes.position.count; i++) {
      mesh.getVertexPosition(i, point).applyMatrix4(mesh.matrixWorld);
      points.push(point.x, point.y, point.z);
    }
    out.push(points);
  }
  return out;
};
window.ready = true;
</script>"""


def three(asked, cases, folder):
    """As `blender`, by three.js."""
    from playwright.sync_api import sync_playwright

    kinds = {".js": "text/javascript", ".glb": "model/gltf-binary"}

    def serve(route):
        name = route.request.url.split("/", 3)[3]
        if not name:
            return route.fulfill(body=_PAGE, content_type="text/html")
        file = asked.npm / "node_modules" / name if name.startswith("three/") else folder / name.removeprefix("files/")
        if not file.is_file():
            return route.fulfill(status=404)
        return route.fulfill(body=file.read_bytes(), content_type=kinds[file.suffix])

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page()
        page.route("**/*", serve)
        page.goto("http://files.test/")
        page.wait_for_function("window.ready")
        found = {name: np.array(page.evaluate("([name, times]) => evaluate(name, times)", [path.name, times.tolist()]))
                 for name, (path, _, times, names) in cases.items() if path.suffix == ".glb"}
        browser.close()
    return {name: points.reshape(len(points), -1, 3) for name, points in found.items()}


_VALIDATE = """const v = require("gltf-validator"), fs = require("fs");
v.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1]))).then((r) => console.log(JSON.stringify(r.issues)));"""


def validated(asked, path):
    """Errors, warnings and the messages of the Khronos validator."""
    done = subprocess.run(["node", "-e", _VALIDATE, str(path)], cwd=asked.npm, check=True, capture_output=True)
    issues = json.loads(done.stdout)
    return {"errors": issues["numErrors"], "warnings": issues["numWarnings"],
            "messages": sorted({each["code"] for each in issues["messages"] if each["severity"] < 2})}


PROGRAMS = {"Blender": (blender, "bpy"), "three.js": (three, "npm")}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-m", "--model", type=Path, help="the one of synthetic people when not given")
    parser.add_argument("--motion", type=Path, help="of that model; a walk when not given")
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--bpy", default=os.environ.get("BPY"), help="a Python that has bpy")
    parser.add_argument("--npm", type=Path, default=os.environ.get("NPM"),
                        help="a folder with node_modules of three and gltf-validator")
    asked = parser.parse_args()
    asked.folder.mkdir(parents=True, exist_ok=True)
    if asked.motion is None:
        asked.model, asked.motion = synthetic_walk(asked.folder / "walk.npz")
    made = cases(asked.model, asked.motion, asked.folder)
    asked.rate = float(np.load(asked.motion)["mocap_frame_rate"])
    if asked.bpy is not None:
        made = with_fbx(asked, made, asked.folder)
    rows = {name: {"size_MB": path.stat().st_size / 1e6} for name, (path, *_) in made.items()}
    for program, (evaluate, needs) in PROGRAMS.items():
        if getattr(asked, needs) is None:
            continue
        for name, points in evaluate(asked, made, asked.folder).items():
            off = 1000 * np.linalg.norm(points - made[name][1], axis=-1)
            rows[name][program] = {"mean_mm": off.mean(), "largest_mm": off.max()}
    for name, (path, *_) in made.items():
        if asked.npm is not None and path.suffix == ".glb":
            rows[name]["Khronos validator"] = validated(asked, path.resolve())
    programs = [name for name, (_, needs) in PROGRAMS.items() if getattr(asked, needs)]
    report = {"machine": machine(), "programs": programs, "files": rows}
    print(json.dumps(report, indent=1, default=float))
    if asked.output:
        write_report(asked.output, report)


if __name__ == "__main__":
    main()
