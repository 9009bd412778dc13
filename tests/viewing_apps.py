"""Apps of `scape view` over small files, and what their page shows."""
import numpy as np
from model_bodies import worm_model

from completion.motion import Motion
from completion.viewing.app import ViewApp
from completion.viewing.files import Files
from scanprep import write_landmarks, write_mesh
from scanprep.geometry.files import PointCloud, write_points
from scanprep.viewer.messages import Message

OPEN = "Boolean(window.program?.figure && program.entries)"
PART = "part3"                       # the last of the worm's chain of two


def write_files(folder, model):
    """A model, a smaller one, a motion, a mesh with landmarks, a cloud; their folder."""
    model.save(folder / "worm.npz")
    worm_model(seed=1, components=1, rings=21).save(folder / "short.npz")
    a_motion(40).save(folder / "wave.npz")
    write_mesh(folder / "body.ply", model.template)
    write_landmarks(folder / "body.landmarks.json", {"head": model.template.vertices[0], "tail": 5})
    write_points(folder / "cloud.xyz", PointCloud(model.template.vertices))
    return folder


def a_motion(count, labels=()):
    t = np.linspace(0, 2 * np.pi, count)
    poses = np.zeros((count, 4, 3))
    poses[:, 1:, 1] = 0.6 * np.sin(t)[:, None]
    poses[:, 0, 0] = 0.1 * t
    residuals = np.full((count, len(labels)), 0.004)
    return Motion(poses, np.c_[t, 0 * t, 0 * t], np.array([0.5, -1.0]), 20.0, residuals, labels)


def app_of(folder, *names, **options):
    where = {name: options.pop(name) for name in ("model", "unit") if name in options}
    over = options.get("over", False)
    return ViewApp(Files(tuple(folder / name for name in names), over=over, **where).entries(), **options)


class Told(list):
    """What an app sends."""

    def __call__(self, message):
        self.append(message)


def ask(app, kind, **fields):
    told = Told()
    app.handle(Message(kind, fields), told)
    return told


def seen(page, pane=0, layer=0):
    """The vertices (N, 3) of a layer in the page, metres in the world."""
    values, origin = page.evaluate(f"(() => {{ const p = program.figure.panes[{pane}];"
                                   f"return [Array.from(p.layers[{layer}].positions), p.origin.toArray()]; }})()")
    return np.array(values).reshape(-1, 3) + origin


def expected(app, model):
    turns, betas = app.controls.turns, app.controls.betas[:model.n_betas]
    return model.vertices(np.array([turns[name] for name in model.skeleton.names]), betas)
